"""Sweeps that normalise rewards, interrupted in the middle: resumed trials go on with the statistics that they had.

A resumed trial begins new episodes with other seeds, and so differs from an undisturbed one. Here all episodes are
alike, and an iteration is whole episodes: what is left to differ is what a checkpoint did not carry over.
"""

import hashlib
import threading
from pathlib import Path
from typing import Any

import pytest
from test_sweeps import FAST, eventually, has_checkpoints, launch, make_spec, shorten

from analysis.records import TrialRecord
from policies.return_statistics import FIRST_COUNT, ReturnStatistics
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


def spec(engine: str, pause_s: float = 0.0, **changes: Any) -> dict[str, Any]:
    return make_spec(
        env={"id": "TestLaps-v0", "args": {"pause_s": pause_s}},
        engine=engine,
        hyperparams={**FAST, "normalize_rewards": True},
        checkpoints={"every_iterations": 3, "keep": 1},
        confirm="none",
        **changes,
    )


def interrupted(tmp_path: Path, engine: str) -> tuple[SweepResult, list[int]]:
    """A sweep that was stopped in the middle and resumed, and the iterations at which its trials were stopped."""

    def stop() -> None:
        try:
            eventually(lambda: has_checkpoints(tmp_path, "cut", num_trials=2))
        finally:
            sweeps.stop("cut", storage=tmp_path)

    thread = threading.Thread(target=stop)
    thread.start()
    cut = launch(tmp_path, spec(engine, pause_s=0.0005, stop={"num_env_steps": 1_000_000}), name="cut")
    thread.join()
    assert (cut.interrupted, [trial.status for trial in cut.trials]) == (True, ["paused"] * 2)
    stopped = [trial.num_iterations for trial in cut.trials]
    shorten(SweepStore(cut.folder), max(stopped) + 4)
    resumed = sweeps.resume("cut", storage=tmp_path, progress="none", finish=False)
    assert [trial.status for trial in resumed.trials] == ["completed"] * 2
    return resumed, stopped


def last_statistics(result: SweepResult, trial: TrialRecord) -> ReturnStatistics:
    """Those of a trial's last checkpoint, as training would go on with them."""
    algorithm = sweeps.restore(SweepStore(result.folder).checkpoint_folder(trial.checkpoints[-1]))
    found: ReturnStatistics = algorithm.learner_group._learner.return_statistics
    algorithm.stop()
    return found


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_the_statistics_of_a_resumed_trial_are_of_all_its_env_steps(tmp_path: Path, engine: str) -> None:
    result, stopped = interrupted(tmp_path, engine)
    for trial, iteration in zip(result.trials, stopped, strict=True):
        assert 0 < iteration < trial.num_iterations == trial.checkpoints[-1].iteration
        assert last_statistics(result, trial).count == pytest.approx(FIRST_COUNT + trial.num_env_steps)


def outcome(result: SweepResult, trial: TrialRecord) -> list[Any]:
    """All of a trial's iterations but their times, and its last weights and statistics."""
    store = SweepStore(result.folder)
    rows = [item.model_dump(exclude={"time_s"}) for item in store.trial(trial.trial_id).read_iterations()]
    weights = (store.checkpoint_folder(trial.checkpoints[-1]) / "policy.safetensors").read_bytes()
    return [*rows, hashlib.sha256(weights).hexdigest(), last_statistics(result, trial)]


def test_where_episodes_are_alike_a_pack_goes_on_as_if_it_had_not_been_interrupted(tmp_path: Path) -> None:
    result, _ = interrupted(tmp_path, "packed")
    whole = launch(tmp_path, spec("packed", stop={"num_iterations": result.trials[0].num_iterations}), name="whole")
    for ours, theirs in zip(result.trials, whole.trials, strict=True):
        assert ours.seed == theirs.seed
        assert outcome(result, ours) == outcome(whole, theirs)
