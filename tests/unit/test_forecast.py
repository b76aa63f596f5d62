"""How far a sweep is and how long it still takes, from the records of its trials."""

from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeEngine
from fake_sweeps import BEST
from sweep_folders import chosen, make_sweep_folder
from test_monitor import make_trial

from tests.narrowing import present
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.forecast import caps_of, forecast
from tune_jobs.sweeps.status import list_sweeps, status

CAPS = {f"t{index:04d}": 1_000 for index in range(10)}


def test_progress_counts_the_env_steps_of_ended_trials_and_the_caps_of_the_others() -> None:
    trials = [
        make_trial(0, "completed", steps=400),
        make_trial(1, "failed", steps=10),
        make_trial(2, "running", steps=300),
        make_trial(3),
    ]
    made = forecast(trials, CAPS)
    assert (made.num_env_steps, made.max_env_steps) == (710, 400 + 10 + 1_000 + 1_000)
    assert made.share == pytest.approx(710 / 2_410)


def test_the_last_iteration_may_go_beyond_the_cap() -> None:
    made = forecast([make_trial(0, "running", steps=1_024, time_s=1.0)], CAPS)
    assert (made.max_env_steps, made.share, made.time_left_s) == (1_024, 1.0, 0.0)


def test_the_speed_is_of_the_running_trials_together() -> None:
    """The members of a pack have the times of the whole pack: 100 + 50 env steps in each second of it."""
    trials = [
        make_trial(0, "running", steps=200, time_s=2.0),
        make_trial(1, "running", steps=100, time_s=2.0),
        make_trial(2, "completed", steps=1_000, time_s=0.1),
        make_trial(3, "paused", steps=900, time_s=0.1),
        make_trial(4, "running"),
    ]
    assert forecast(trials, CAPS).env_steps_per_s == pytest.approx(150)


def test_time_left_is_what_the_caps_allow_until_trials_have_ended() -> None:
    trials = [make_trial(0, "running", steps=200, time_s=2.0), make_trial(1)]
    assert forecast(trials, CAPS).time_left_s == pytest.approx((800 + 1_000) / 100)


def test_time_left_is_what_ended_trials_took_in_env_steps() -> None:
    trials = [
        make_trial(0, "completed", steps=500),
        make_trial(1, "stopped", steps=300),
        make_trial(2, "failed", steps=1),
        make_trial(3, "running", steps=100, time_s=1.0),
        # This one takes longer than is usual, so it may take all that it can.
        make_trial(4, "running", steps=600, time_s=6.0),
        make_trial(5),
    ]
    assert forecast(trials, CAPS).time_left_s == pytest.approx((300 + 400 + 400) / 200)


@pytest.mark.parametrize("trials", [[make_trial(0)], [make_trial(0, "running")], [make_trial(0, "running", steps=5)]])
def test_nothing_is_said_before_there_is_a_speed(trials: list[Any]) -> None:
    made = forecast(trials, CAPS)
    assert (made.env_steps_per_s, made.time_left_s) == (None, None)


def test_a_sweep_that_nothing_runs_has_neither_speed_nor_time_left() -> None:
    made = forecast([make_trial(0, "running", steps=500, time_s=5.0)], CAPS, running=False)
    assert (made.env_steps_per_s, made.time_left_s) == (None, None)
    assert forecast([make_trial(0, "completed", steps=5)], CAPS).time_left_s == 0.0


def test_no_trials_are_all_done() -> None:
    made = forecast([], {})
    assert (made.share, made.time_left_s) == (1.0, 0.0)


def spec(**given: Any) -> SweepSpec:
    return SweepSpec.model_validate({"env": "CartPole-v1", "algorithm": "ppo", **given})


@pytest.mark.parametrize(
    ("algorithm", "hyperparams", "expected"),
    [
        ("ppo", {"train_batch_size": 512}, 5_120),
        ("ppo", {"train_batch_size": 8_192}, 50_000),
        ("dqn", {"env_steps_per_iteration": 100}, 1_000),
        ("random", {}, 10_000),
    ],
)
def test_a_trials_cap_is_the_first_of_its_caps(algorithm: str, hyperparams: dict[str, Any], expected: int) -> None:
    trial = make_trial(0).model_copy(update={"hyperparams": hyperparams})
    made = spec(algorithm=algorithm, stop={"num_env_steps": 50_000, "num_iterations": 10})
    assert caps_of(made, [trial]) == {"t0000": expected}


def test_a_record_of_unknown_hyperparameters_has_the_sweeps_cap() -> None:
    trial = make_trial(0).model_copy(update={"hyperparams": {"of_another_version": 1}})
    assert caps_of(spec(stop={"num_env_steps": 50_000}), [trial]) == {"t0000": 50_000}


def test_the_status_of_a_folder(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine", stop={"num_env_steps": 10_000})
    steps = sum(record.num_env_steps for record in store.read_trials())
    found = status(store.folder)
    assert (found.num_env_steps, found.max_env_steps, found.time_left_s) == (steps, steps, None)
    best = found.best
    assert best is not None
    # The better trial of the better point, whose score is the mean of the two seeds.
    assert (best.trial_id, best.iteration, best.score) == ("t0003", 6, 31.0)
    assert best.point == store.trial("t0003").read_record().point
    assert [each.best for each in list_sweeps(tmp_path)] == [best]


def test_the_best_of_a_finished_sweep_is_the_policy_that_was_chosen(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    by_episodes = BEST.model_copy(update={**chosen(store, "t0001"), "selection_score": 12.5})
    store.write_best(by_episodes, FakeEngine().policy())
    best = present(status(store.folder).best)
    assert (best.trial_id, best.iteration, best.score, best.point) == ("t0001", 6, 12.5, BEST.point)
    record = store.read_record()
    store.write_record(record.model_copy(update={"state": "interrupted"}))  # as one that was extended
    assert present(status(store.folder).best).trial_id == "t0003"
    store.write_record(record)
    (store.best_folder / "evaluation.json").write_text("{}")
    assert present(status(store.folder).best).trial_id == "t0003"


def test_the_status_of_a_sweep_of_another_version_is_told_without_a_forecast(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    record = store.read_record()
    store.write_record(record.model_copy(update={"spec": {**record.spec, "of_another_version": {"a": 1}}}))
    found = status(store.folder)
    assert (found.max_env_steps, found.counts) == (None, {"completed": 4})
    assert found.num_env_steps > 0
