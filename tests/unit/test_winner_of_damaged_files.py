"""A policy that was chosen and confirmed, and whose checkpoint was damaged since."""

from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder

from tests.narrowing import present
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.policy_choice import confirmed_best


@pytest.mark.parametrize("file", ["policy.safetensors", "manifest.json"])
def test_a_winner_whose_checkpoint_was_damaged_since_is_not_taken_for_confirmed(tmp_path: Path, file: str) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    sweeps.best(store.folder, num_episodes=2)
    best = present(confirmed_best(store))
    damaged = store.checkpoint_folder(best.checkpoint) / file
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert confirmed_best(store) is None
    damaged.write_bytes(whole)
    assert confirmed_best(store) == best
