"""What `make test` leaves out is there, and so is what is looked at instead."""

import re
from pathlib import Path

import pytest

from tests.slow import SLOW

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("node", SLOW)
def test_a_slow_test_is_there_and_has_another_in_its_place(node: str) -> None:
    file, _, name = node.partition("::")
    text = (ROOT / file).read_text()
    function, _, parameters = name.rstrip("]").partition("[")
    assert re.search(rf"^def {function}\b" if function else "^def test_", text, re.MULTILINE)
    assert all(re.search(rf'["-]{parameter}["-]', text) for parameter in parameters.split("-") if parameter)
    for other in re.findall(r"tests/\S+\.py", SLOW[node]):
        assert (ROOT / other).is_file()
