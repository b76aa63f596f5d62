"""Whole sweeps through the Python API, tiny ones: what they leave, and what happens when something goes wrong.

Sweeps whose process is killed are in test_interruption.py.
"""

import itertools
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from analysis.records import TrialRecord
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy
from policies.errors import CannotRunError, NotFoundError, SpecError
from policies.portable.file import read_policy
from tests.narrowing import present
from tune_jobs.spec.seeds import trial_seeds
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

FAST: dict[str, Any] = {
    "hidden_sizes": [8],
    "activation": "tanh",
    "num_envs": 4,
    "train_batch_size": 128,
    "minibatch_size": 64,
    "num_epochs": 2,
}


def make_spec(**changes: Any) -> dict[str, Any]:
    """A sweep of seconds; `env` is a question a step, learnt within 2,000 env steps by a good learning rate."""
    return {
        "env": {"id": "TestTrouble-v0", "args": {}},
        "algorithm": "ppo",
        "hyperparams": FAST,
        "space": {"lr": {"loguniform": [1e-3, 1e-2]}},
        "num_samples": 2,
        "stop": {"num_env_steps": 640},
        "evaluation": {"every_iterations": 2, "num_episodes": 3},
        "checkpoints": {"every_iterations": 2, "keep": 1},
    } | changes


def launch(tmp_path: Path, spec: dict[str, Any], **kwargs: Any) -> SweepResult:
    keywords: dict[str, Any] = {"name": "mine", "finish": False} | kwargs
    return sweeps.launch(spec, storage=tmp_path, progress="none", **keywords)


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its content."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_results_without_gaps(store: SweepStore, trial: TrialRecord) -> None:
    """results.jsonl holds each iteration once, in order, with growing counts."""
    records = store.trial(trial.trial_id).read_iterations()
    assert [record.iteration for record in records] == list(range(1, trial.num_iterations + 1))
    for before, after in itertools.pairwise(records):
        assert before.num_env_steps < after.num_env_steps
        assert before.time_s <= after.time_s
        assert before.num_episodes + len(after.episode_returns) == after.num_episodes
    assert records[-1].num_env_steps == trial.num_env_steps


def eventually(condition: Callable[[], object], timeout_s: float = 600.0) -> None:
    """Wait until something is so. The time-out only keeps a broken test from waiting for ever."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.02)


def has_checkpoints(storage: str | Path, name: str = "mine", num_trials: int = 1) -> bool:
    store = SweepStore(Path(storage) / name)
    return sum(bool(store.trial(f"t000{index}").checkpoints()) for index in range(2)) >= num_trials


# -- a sweep that goes well


@pytest.fixture(scope="module")
def cartpole(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SweepResult]:
    """(storage folder, result) of a finished sweep of two trials; no test may change it."""
    storage = tmp_path_factory.mktemp("storage")
    spec = make_spec(
        env={"id": "CartPole-v1", "args": {"max_episode_steps": 40}},
        hyperparams={**FAST, "train_batch_size": 256},
        stop={"num_env_steps": 1_000},
        name="cartpole",
    )
    return storage, sweeps.launch(spec, storage=storage, progress="none")


def test_a_sweep_leaves_records_checkpoints_best_and_report(cartpole: tuple[Path, SweepResult]) -> None:
    storage, result = cartpole
    folder = storage / "cartpole"
    assert (result.folder, result.exit_code, result.interrupted, result.why_no_best) == (folder, 0, False, None)
    assert result.notes == ()
    assert (result.sweep.state, result.sweep.num_trials) == ("completed", 2)
    assert result.sweep.run_time_s > 0
    assert {"tune-jobs", "ray", "torch", "gymnasium"} <= set(result.sweep.versions)
    store = SweepStore(folder)
    for trial in result.trials:
        assert (trial.status, trial.num_failures, trial.error) == ("completed", 0, None)
        assert present(trial.stop_reason).startswith("num_env_steps")
        # 256 an iteration, and up to 3 more where sub-environments reset.
        assert 1_000 <= trial.num_env_steps < 1_256 + 4
        assert_results_without_gaps(store, trial)
        # Evaluated at 2 and 4; the latest, the best, and no other.
        kept = {record.iteration for record in trial.checkpoints}
        assert kept == {trial.best_iteration, 4}
        assert trial.best_evaluation_return == max(present(r.evaluation_return) for r in trial.checkpoints)
        for record in trial.checkpoints:
            assert verify_checkpoint(folder / record.path) == record
        assert (trial.node, trial.pid) != (None, None)
        assert trial.pid != os.getpid()
        assert present(trial.started_at) < present(trial.ended_at)
        trial_folder = folder / "trials" / trial.trial_id
        assert (trial_folder / "log.txt").is_file()
        assert list((trial_folder / "tensorboard").glob("events.out.tfevents.*"))
        assert trial == store.trial(trial.trial_id).read_record()
    names = {"policy", "before_mp4", "after_mp4", "after_gif", "before_after_mp4", "report"}
    assert set(result.artifacts) == names
    assert all(path.stat().st_size > 0 for path in result.artifacts.values())
    assert (folder / "report" / "trials.csv").is_file()


def test_the_best_is_chosen_by_evaluation_and_confirmed_on_other_seeds(cartpole: tuple[Path, SweepResult]) -> None:
    storage, result = cartpole
    best = present(result.best)
    choice = present(best.choice)
    assert (best.checkpoint, best.selection_score) == (choice.winner.checkpoint, choice.winner.score)
    leader = max(present(trial.best_evaluation_return) for trial in result.trials)
    assert leader == max(present(item.checkpoint.evaluation_return) for item in choice.candidates)
    assert best.confirmation.num_episodes == best.random.num_episodes == 100
    assert set(best.confirmation.seeds).isdisjoint(result.sweep.evaluation_seeds)
    assert best.confirmation.returns != best.random.returns
    policy = load_policy(result.artifacts["policy"])
    assert isinstance(policy, NetworkPolicy)
    assert policy.act(np.zeros(4)) in {0, 1}
    checkpoint = read_policy(result.folder / best.checkpoint.path)
    np.testing.assert_array_equal(policy.portable.network.layers[0].weight, checkpoint.network.layers[0].weight)
    record, _ = sweeps.evaluate("cartpole", storage=storage, num_episodes=5, first_seed=best.confirmation.seeds[0])
    assert record.returns == best.confirmation.returns[:5]


def test_the_best_restores_as_an_algorithm_by_the_sweeps_name(cartpole: tuple[Path, SweepResult]) -> None:
    from policies.rllib.restore import learner_weights

    storage, result = cartpole
    algo = sweeps.restore("cartpole", storage=storage)
    layers = read_policy(result.artifacts["policy"]).network.layers
    weights = learner_weights(algo)
    np.testing.assert_array_equal(weights["pi.weight"], layers[-1].weight)
    iteration = algo.iteration
    algo.train()
    assert algo.iteration == iteration + 1
    assert not np.array_equal(learner_weights(algo)["pi.weight"], layers[-1].weight)
    algo.stop()
    other = sweeps.restore("cartpole/t0001", storage=storage)
    assert other.iteration == result.trials[1].best_iteration
    other.stop()


def test_a_finished_sweep_is_told_the_same_by_every_call(cartpole: tuple[Path, SweepResult]) -> None:
    storage, result = cartpole
    status = sweeps.status("cartpole", storage=storage)
    assert (status.counts, status.alive, status.sweep) == ({"completed": 2}, False, result.sweep)
    assert sweeps.list_sweeps(storage) == [status]
    assert sweeps.trials("cartpole", storage=storage) == result.trials
    assert list(sweeps.dataframe("cartpole", storage=storage)["trial_id"]) == ["t0000", "t0001"]
    assert sweeps.stop("cartpole", storage=storage) is False


def test_a_name_that_is_taken_starts_nothing(cartpole: tuple[Path, SweepResult]) -> None:
    storage, _ = cartpole
    before = snapshot(storage / "cartpole")
    with pytest.raises(SpecError, match="cartpole"):
        launch(storage, make_spec(), name="cartpole")
    assert snapshot(storage / "cartpole") == before
    with pytest.raises(NotFoundError, match="cartpol"):
        sweeps.resume("cartpol", storage=storage)


def test_resuming_a_finished_sweep_changes_no_trial(cartpole: tuple[Path, SweepResult]) -> None:
    storage, result = cartpole
    before = snapshot(result.folder / "trials")
    again = sweeps.resume("cartpole", storage=storage, progress="none", finish=False)
    assert (again.exit_code, again.trials) == (0, result.trials)
    assert snapshot(result.folder / "trials") == before


# -- more trials


def test_extending_adds_the_new_trials_and_touches_no_other(tmp_path: Path) -> None:
    space = {"lr": {"loguniform": [1e-3, 1e-2]}, "gamma": {"grid": [0.9, 0.99]}}
    first = launch(tmp_path, make_spec(num_samples=1, space=space))
    assert [trial.trial_id for trial in first.trials] == ["t0000", "t0001"]
    before = snapshot(first.folder / "trials")
    extended = sweeps.extend("mine", 1, storage=tmp_path, progress="none", finish=False)
    assert [trial.trial_id for trial in extended.trials] == ["t0000", "t0001", "t0002", "t0003"]
    assert [trial.status for trial in extended.trials] == ["completed"] * 4
    after = snapshot(first.folder / "trials")
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[0] for name in set(after) - set(before)} == {"t0002", "t0003"}
    assert (extended.sweep.spec["num_samples"], extended.sweep.num_trials) == (2, 4)
    # The same trials that two samples at once would have been.
    assert len({trial.seed for trial in extended.trials}) == 4
    assert [trial.seed for trial in extended.trials] == list(trial_seeds(0, 4))
    lrs = [trial.point["lr"] for trial in extended.trials]
    assert lrs[0] == first.trials[0].point["lr"]
    assert len(set(lrs)) > 1
    with pytest.raises(SpecError):
        sweeps.extend("mine", 0, storage=tmp_path)


# -- what goes wrong


def test_each_trial_fails_for_itself_and_is_retried(tmp_path: Path) -> None:
    """One trial after the other, in one process until one of them ends it: well, raises always, raises once, dies,
    hangs. Each is tried twice."""
    seeds = trial_seeds(0, 5)
    troubles = {
        str(seeds[1]): {"how": "raise", "at": 6},
        # After its first checkpoints: the retry goes on from there.
        str(seeds[2]): {"how": "raise", "at": 100, "marker": str(tmp_path / "raised")},
        str(seeds[3]): {"how": "exit", "marker": str(tmp_path / "died")},
        str(seeds[4]): {"how": "hang", "at": 70, "marker": str(tmp_path / "hung")},
    }
    # In a pack some would be tried again because others died. Within the timeout a busy machine imports RLlib and
    # builds a trial, too.
    spec = make_spec(
        env={"id": "TestTrouble-v0", "args": {"troubles": troubles}}, num_samples=5, max_retries=1,
        iteration_timeout_s=90, engine="rllib", confirm="none",
    )  # fmt: skip
    told: dict[str, TrialRecord] = {}

    def note(keeper: RecordKeeper, trial_id: str, error: str, **kwargs: Any) -> None:
        failed_as_it_is(keeper, trial_id, error, **kwargs)
        told[trial_id] = keeper.record(trial_id)

    failed_as_it_is = RecordKeeper.failed
    with mock.patch.object(RecordKeeper, "failed", note):
        result = launch(tmp_path, spec, finish=True)
    assert [trial.status for trial in result.trials] == ["completed", "failed", "completed", "completed", "completed"]
    assert [trial.num_failures for trial in result.trials] == [0, 2, 1, 1, 1]
    assert (result.exit_code, result.sweep.state) == (3, "completed")
    failed = result.trials[1]
    assert present(failed.error).startswith(
        "TestTrouble-v0 raised an error in step(): ZeroDivisionError: the cart left the track"
    )
    # And where, from the end of its log.
    assert "tune_jobs_test_envs.py" in present(failed.error)
    assert failed.ended_at is not None
    assert failed.checkpoints == ()
    # In the first iteration: the five steps before it, of four sub-environments each.
    assert (failed.num_iterations, failed.num_env_steps) == (0, 5 * FAST["num_envs"])
    assert failed.time_s > 0
    hung = told["t0004"]
    assert hung.num_env_steps > 60 * FAST["num_envs"]
    first = present(hung.error).splitlines()[0]
    assert "died: an iteration took longer than iteration_timeout_s (90 s). It hung at " in first
    assert re.search(r"/tune_jobs_test_envs\.py:\d+ in _go_wrong\.$", first)
    store = SweepStore(result.folder)
    for trial in result.trials:
        if trial.status == "completed":
            assert trial.error is None
            assert_results_without_gaps(store, trial)
    logs = {trial.trial_id: store.trial(trial.trial_id).log_path.read_text() for trial in result.trials}
    assert logs["t0000"].count("ZeroDivisionError") == 0
    assert logs["t0001"].count("ZeroDivisionError: the cart left the track\n") == 2
    assert logs["t0002"].count("ZeroDivisionError: the cart left the track\n") == 1
    # Where it hung is in the log.
    assert "Timeout (" in logs["t0004"]
    assert "_go_wrong" in logs["t0004"]
    # The winner is one of the others, though the environment cannot be filmed.
    assert present(result.best).checkpoint.trial_id != "t0001"
    assert "report" in result.artifacts
    assert "TestTrouble-v0" in " ".join(result.notes)
    html = result.artifacts["report"].read_text()
    assert "the cart left the track" in html


def test_a_sweep_in_which_all_fails_says_so(tmp_path: Path) -> None:
    spec = make_spec(
        env={"id": "TestTrouble-v0", "args": {"troubles": {str(trial_seeds(0, 1)[0]): {"how": "raise"}}}},
        num_samples=1, max_retries=0,
    )  # fmt: skip
    result = launch(tmp_path, spec, finish=True)
    assert (result.exit_code, result.best) == (3, None)
    assert result.trials[0].num_failures == 1
    assert "the cart left the track" in present(result.why_no_best)
    assert "policy" not in result.artifacts
    assert result.artifacts["report"].is_file()
    # Mended (the env of another machine, say), failed trials can be tried again.
    record = SweepStore(result.folder).read_record()
    record.spec["env"]["args"] = {}
    SweepStore(result.folder).write_record(record)
    assert sweeps.resume("mine", storage=tmp_path, progress="none", finish=False).exit_code == 3
    retried = sweeps.resume("mine", storage=tmp_path, progress="none", finish=False, retry_failed=True)
    assert (retried.exit_code, retried.trials[0].status, retried.trials[0].error) == (0, "completed", None)


# -- going on


def slow_spec(**changes: Any) -> dict[str, Any]:
    """Trials of thousands of iterations, unless they are stopped."""
    return make_spec(
        env={"id": "TestTrouble-v0", "args": {"pause_s": 0.0005}},
        stop={"num_env_steps": 1_000_000},
        num_samples=3,
        checkpoints={"every_iterations": 3, "keep": 1},
        **changes,
    )


def shorten(store: SweepStore, num_iterations: int) -> None:
    """Let the trials of a sweep end soon."""
    record = store.read_record()
    record.spec["stop"]["num_iterations"] = num_iterations
    store.write_record(record)


def test_a_stopped_sweep_goes_on_where_it_was(tmp_path: Path) -> None:
    asked = []

    def ask() -> None:
        eventually(lambda: has_checkpoints(tmp_path, num_trials=2))
        try:
            # Nobody else must run it meanwhile.
            with pytest.raises(CannotRunError, match="Sweep mine is being run by another process"):
                sweeps.resume("mine", storage=tmp_path)
            assert sweeps.status("mine", storage=tmp_path).alive
        finally:
            # Its trials would take hours.
            asked.append(sweeps.stop("mine", storage=tmp_path))

    thread = threading.Thread(target=ask)
    thread.start()
    result = launch(tmp_path, slow_spec(), finish=True)
    thread.join()
    assert asked == [True]
    assert (result.interrupted, result.exit_code, result.sweep.state) == (True, 130, "interrupted")
    # Nothing is chosen before all is done.
    assert (result.best, result.artifacts) == (None, {})
    store = SweepStore(result.folder)
    begun = [trial for trial in result.trials if trial.num_iterations]
    assert len(begun) >= 2
    for trial in begun:
        assert trial.status == "paused"
        # Paused at this very iteration, so nothing is done twice.
        assert trial.checkpoints[-1].iteration == trial.num_iterations
        assert_results_without_gaps(store, trial)
    assert {trial.status for trial in result.trials} <= {"paused", "pending"}
    lines = {trial.trial_id: store.trial(trial.trial_id).results_path.read_text() for trial in begun}

    goal = max(trial.num_iterations for trial in begun) + 3
    shorten(store, goal)
    resumed = sweeps.resume("mine", storage=tmp_path, progress="none", finish=False)
    assert (resumed.exit_code, resumed.interrupted) == (0, False)
    assert [(trial.status, trial.num_iterations) for trial in resumed.trials] == [("completed", goal)] * 3
    for trial in resumed.trials:
        assert_results_without_gaps(store, trial)
        assert store.trial(trial.trial_id).results_path.read_text().startswith(lines.get(trial.trial_id, ""))
    assert resumed.sweep.run_time_s > result.sweep.run_time_s


def test_a_changed_sweep_is_not_gone_on_with(tmp_path: Path) -> None:
    """Another seed draws other points: trials would train on with values they did not begin with."""
    result = launch(tmp_path, make_spec(num_samples=1))
    store = SweepStore(result.folder)
    record = store.read_record()
    record.spec["seed"] = 1
    store.write_record(record)
    before = snapshot(result.folder)
    with pytest.raises(CannotRunError, match="t0000"):
        sweeps.resume("mine", storage=tmp_path, progress="none")
    assert snapshot(result.folder) == before
