"""In which order the trials of a run begin: packed and single ones, further seeds behind those of the search."""

import types
from collections.abc import Sequence
from typing import Any

from tune_jobs.ray_tune.run_trials import _Run

NUM = 400
"""Packed trials, single ones, and further seeds of each."""


class Name(str):
    """A trial's id that counts how often ids are looked up."""

    __slots__ = ()
    num_lookups = 0

    def __hash__(self) -> int:
        Name.num_lookups += 1
        return super().__hash__()


def begun(names: Sequence[str], packed: Sequence[str], replicas: Sequence[str]) -> list[tuple[str, list[str]]]:
    """What begins, with no trial that is trained: the folder and the trials of each."""
    found: list[tuple[str, list[str]]] = []
    run: Any = _Run.__new__(_Run)
    run._spec = types.SimpleNamespace(seeds_per_point=1, search=types.SimpleNamespace(has_model=False))
    run._job = types.SimpleNamespace(trial_ids=names, packs=types.SimpleNamespace(trial_ids=packed))
    indexes = dict.fromkeys(names, 0) | dict.fromkeys(replicas, 1)
    run.keeper = types.SimpleNamespace(
        record=lambda name: types.SimpleNamespace(seed_index=indexes[name]), stop_requested=lambda: False
    )
    run._build_scheduler = lambda: None
    run._packs = run._single_trials = lambda trial_ids, folder: found.append((folder, list(trial_ids)))
    run.all_trials()
    return found


def test_packs_begin_before_single_trials_and_further_seeds_last_with_few_lookups_of_each_trial() -> None:
    names = [Name(f"t{number:04d}") for number in range(4 * NUM)]
    packed, replicas = names[1::2], names[2 * NUM :]
    Name.num_lookups = 0
    assert begun(names, packed, replicas) == [
        ("packs", names[1 : 2 * NUM : 2]),
        ("run", names[: 2 * NUM : 2]),
        ("packs-of-replicas", names[2 * NUM + 1 :: 2]),
        ("run-of-replicas", names[2 * NUM :: 2]),
    ]
    assert Name.num_lookups <= 20 * len(names)
