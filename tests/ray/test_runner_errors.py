"""What an env runner in a process of its own raises ends the trial with the same words as in the trial's process."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch
from ray import cloudpickle
from ray.exceptions import RayTaskError
from rllib_engines import engine
from trials import TRIAL_SEED, make_task, run_trial

from policies.errors import EnvFailedError, NonFiniteWeightsError
from tests.narrowing import present
from tune_jobs.training.protocol import TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["engine"]


def troubled(folder: Path, algorithm: str, num_env_runners: int) -> TrialTask:
    troubles = {str(TRIAL_SEED): {"how": "raise", "at": 30}}
    return make_task(
        folder, algorithm, env_id="TestTrouble-v0", env_args={"troubles": troubles}, num_env_runners=num_env_runners
    )


def error_of_training(engine: RLlibEngine, task: TrialTask) -> EnvFailedError:
    engine.build(task, None)
    with pytest.raises(EnvFailedError) as caught:
        engine.train_iteration()
    return caught.value


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_an_env_that_fails_in_an_env_runner_is_told_with_its_own_words(
    engine: RLlibEngine, tmp_path: Path, algorithm: str
) -> None:
    there = error_of_training(engine, troubled(tmp_path, algorithm, 1))
    here = error_of_training(engine, troubled(tmp_path, algorithm, 0))
    assert "TestTrouble-v0 raised an error in step(): ZeroDivisionError: the cart left the track" in here.message
    # Records tell the class and both texts.
    assert (type(there), there.message, there.hint) == (type(here), here.message, here.hint)
    # Logs tell the traceback of the runner's process too.
    assert isinstance(there.__cause__, RayTaskError)
    assert "in _go_wrong" in str(there.__cause__)


def test_weights_that_are_not_finite_in_an_env_runner_end_the_trial_for_good(
    engine: RLlibEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As failed, without an error that would have it retried."""
    train_iteration = engine.train_iteration

    def ruin(runner: Any) -> None:
        with torch.no_grad():
            next(value for name, value in runner.module.named_parameters() if name.startswith("pi.")).fill_(torch.nan)

    def train_by_ruined_weights() -> Any:
        engine.algorithm.env_runner_group.foreach_env_runner(ruin, local_env_runner=False)
        with pytest.raises(NonFiniteWeightsError, match=r"outputs are NaN or infinite: \d+ weights are too") as caught:
            train_iteration()
        raise caught.value

    monkeypatch.setattr(engine, "train_iteration", train_by_ruined_weights)
    progress = run_trial(make_task(tmp_path, num_env_runners=1), engine)
    assert progress.status == "failed"
    assert present(progress.error).startswith("The policy's outputs are NaN or infinite")


def test_an_error_in_a_call_whose_answer_nobody_awaits_ends_the_next_iteration(
    engine: RLlibEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So it is with new weights: the runner would sample with the old ones."""
    from tune_jobs.training import rllib
    from tune_jobs.training.env_runner import EnvRunner

    class Refusing(EnvRunner):
        refuses = False

        def set_state(self, state: Any) -> None:
            if self.refuses:
                self.refuses = False
                raise ValueError("these weights are not for me")
            super().set_state(state)

    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(rllib, "EnvRunner", Refusing)
    engine.build(make_task(tmp_path, num_env_runners=1), None)

    def refuse(runner: Any) -> None:
        runner.refuses = True

    def train_after_new_weights() -> None:
        # As RLlib sends them.
        group.foreach_env_runner(lambda runner: runner.set_state({}), local_env_runner=False, timeout_seconds=0.0)
        engine.train_iteration()

    group = engine.algorithm.env_runner_group
    group.foreach_env_runner(refuse, local_env_runner=False)
    with pytest.raises(ValueError, match="not for me"):
        train_after_new_weights()


def test_errors_that_are_no_env_runners_stay_as_they_are() -> None:
    from policies.rllib.runner_errors import as_raised_there

    with pytest.raises(ZeroDivisionError) as caught, as_raised_there():
        raise ZeroDivisionError
    assert caught.value.__cause__ is None
