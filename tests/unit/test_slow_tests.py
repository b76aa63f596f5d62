"""What `make test` leaves out is there, and so is what is looked at instead."""

import re
from collections import Counter
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


def test_no_two_files_of_tests_have_one_name() -> None:
    """They lie in no packages, so that pytest imports them by their names alone, and `make test-slow` all at once."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert names["test_slow_tests.py"] == 1
    assert {name for name, number in names.items() if number > 1} == set()
