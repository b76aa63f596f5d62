"""A trial that goes on while it is repeated: it is compared as it was recorded when the repetition began."""

from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder, train

import tune_jobs
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import reproduce as module


def test_a_trial_that_is_resumed_meanwhile_is_compared_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    ours = store.trial("t0001")
    ours.write_record(ours.read_record().model_copy(update={"status": "paused"}))

    def train_again(folder: str, progress: str) -> None:
        again = SweepStore(Path(folder))
        train(again, "t0001", 6)
        # From its checkpoint of iteration 4 on it has other episodes now, and other weights.
        known = ours.read_iterations()
        ours.keep_iterations(known[:4])
        ours.append_iterations([item.model_copy(update={"training_return": -1.0}) for item in known[4:]])
        ours.write_log("built from checkpoint 000004")
        (ours.checkpoint_folder(6) / "policy.safetensors").write_bytes(b"others")

    monkeypatch.setattr(module, "_train_again", train_again)
    found = tune_jobs.reproduce(store.folder / "trials" / "t0001", progress="none")
    assert found.equal
    assert (found.num_iterations, found.num_compared) == (6, 6)
    assert (found.num_equal_weights, found.num_other_weights) == (2, 0)
    assert "The trial is paused: it was repeated as far as it was recorded." in found.notes
