"""Streams of random numbers: what they always were, and derived in one place alone."""

import re
from pathlib import Path

import pytest

from policies import random_streams

ROOT = Path(__file__).parents[2]
# Other values break `extend` and `resume` of the sweeps people already have.
FIRST_DRAWS = {
    "point_values": ((7, 3), [574474088, 2025542799, 180586425]),
    "training_block": ((7, 3), [971863708, 522863141, 1517580820]),
    "evaluation_start": ((7,), [851770634, 1357304660, 1686672938]),
    "confirmation_start": ((7,), [1029798310, 2109522148, 696422871]),
    "mutation": ((7, 3, 2), [775321387, 1295998675, 402332803]),
    "model_draws": ((7, 3), [984636618, 474032873, 1122306505]),
    "objective_weights": ((7, 3), [1199934593, 2052320352, 31729576]),
    "member_draws": ((1024,), [1201366414, 692481805, 1886084579]),
    "member_draws_after": ((1024, 5), [167793277, 141771956, 494356498]),
    "seeded": ((7,), [2029167941, 1342382292, 1469265226]),
    "fixed": ((), [1826701615, 1367864807, 1097657232]),
}
SEEDS = {
    "tpe_seed": ((7, 3), 3453020843),
    "seeds_after": ((1024, 5), (588324540, 741084305)),
    "member_env_seed_after": ((1024, 5), 1323690961),
    "random_actions_seed": ((7,), 16920295385781661272),
}


@pytest.mark.parametrize("name", FIRST_DRAWS)
def test_generators_draw_what_they_always_drew(name: str) -> None:
    arguments, expected = FIRST_DRAWS[name]
    assert getattr(random_streams, name)(*arguments).integers(0, 2**31, 3).tolist() == expected


@pytest.mark.parametrize("name", SEEDS)
def test_seeds_are_what_they_always_were(name: str) -> None:
    arguments, expected = SEEDS[name]
    found = getattr(random_streams, name)(*arguments)
    assert found == expected
    assert all(type(item) is int for item in (found if isinstance(found, tuple) else [found]))


def test_every_stream_is_tested() -> None:
    here = {
        name
        for name, value in vars(random_streams).items()
        if getattr(value, "__module__", "") == "policies.random_streams"
    }
    assert {name for name in here if not name.startswith("_")} == FIRST_DRAWS.keys() | SEEDS.keys()


def test_no_other_module_derives_a_stream() -> None:
    found = [
        path.relative_to(ROOT).as_posix()
        for package in ("policies", "analysis", "tune_jobs")
        for path in (ROOT / package).rglob("*.py")
        if re.search(r"SeedSequence|default_rng|spawn_key|Philox|RandomState", path.read_text(encoding="utf-8"))
    ]
    assert found == ["policies/random_streams.py"]
