"""What trials' processes are forked from is begun before a sweep is planned, by what its file may ask for."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.sweeps import resume as resuming
from tune_jobs.sweeps import verbs as sweeps

SPEC = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"uniform": [1e-4, 1e-2]}}, "num_samples": 2}


class Begun:
    """In the place of a process from which those of trials are forked."""

    def __init__(self, forked: str) -> None:
        self.forked = forked
        self.ended: list[bool] = []

    def close(self, *, at_once: bool = False) -> None:
        self.ended.append(at_once)


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Begun]:
    """Those that were begun, in a process that has not joined Ray."""
    all_of_them: list[Begun] = []

    def begin(forked: str) -> Begun:
        all_of_them.append(Begun(forked))
        return all_of_them[-1]

    monkeypatch.setattr("tune_jobs.ray_tune.forks._begin", begin)
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    return all_of_them


def test_packs_are_begun_before_the_plan_and_ended_where_that_is_refused(begun: list[Begun], tmp_path: Path) -> None:
    with pytest.raises(SpecError):
        sweeps.launch({**SPEC, "env": "Nowhere-v0"}, storage=tmp_path, progress="none")
    assert [each.ended for each in begun] == [[True]]


RUNNERS = {"engine": "rllib", "resources": {"num_env_runners": 1}}
FORKED = [
    ({}, "packs"), ({"engine": "rllib"}, "trials"), (RUNNERS, "trials"),
    # Ray has libraries use as many threads.
    ({"engine": "rllib", "resources": {"num_cpus": 2}}, None),
    ({"algorithm": "random", "space": {}}, None),
]  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str | None]:
    """What a Ray was to fork, of those that were asked for and did not start."""
    all_of_them: list[str | None] = []

    def connect(*_: object, forked: str | None, **__: object) -> None:
        all_of_them.append(forked)
        raise CannotRunError("no Ray")

    monkeypatch.setattr("tune_jobs.ray_tune.cluster.connect", connect)
    return all_of_them


@pytest.mark.parametrize(("settings", "forked"), FORKED)
def test_what_is_forked_is_begun_by_what_may_come_and_is_what_comes(
    begun: list[Begun], asked: list[str | None], tmp_path: Path, settings: dict[str, Any], forked: str | None
) -> None:
    with pytest.raises(CannotRunError, match="no Ray"):
        sweeps.launch({**SPEC, **settings}, name="new", storage=tmp_path, progress="none")
    assert asked == [forked]
    assert [each.forked for each in begun] == [forked] * (forked is not None)


def test_what_is_planned_without_packs_is_not_forked_as_one(
    begun: list[Begun], asked: list[str | None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeps, "make_plan", lambda *args, **kwargs: replace(make_plan(*args, **kwargs), packs=None))
    with pytest.raises(CannotRunError, match="no Ray"):
        sweeps.launch(SPEC, name="new", storage=tmp_path, progress="none")
    assert ([each.forked for each in begun], asked) == (["packs"], ["trials"])


def test_nothing_is_begun_where_nothing_may_come(
    begun: list[Begun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = {**SPEC, "env": "Nowhere-v0"}
    with pytest.raises(SpecError):
        sweeps.launch({**refused, "engine": "rllib", "resources": {"num_cpus": 2}}, storage=tmp_path, progress="none")
    with monkeypatch.context() as patched:
        patched.setattr("tune_jobs.sweeps.verbs.machine_here", lambda: Machine(2, num_gpus=1))
        with pytest.raises(SpecError):
            sweeps.launch(refused, storage=tmp_path, progress="none")
    joined: Any = type(sys)("ray")
    joined.is_initialized = lambda: True
    monkeypatch.setattr("tune_jobs.sweeps.verbs.machine_here", lambda: Machine(2))
    monkeypatch.setitem(sys.modules, "ray", joined)
    with pytest.raises(SpecError):
        sweeps.launch(refused, storage=tmp_path, progress="none")
    assert begun == []


def test_packs_are_begun_ahead_of_a_resume_that_has_something_to_train(
    begun: list[Begun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    monkeypatch.setattr(resuming, "run_sweep", lambda *_, **__: [list(each.ended) for each in begun])
    assert cast("Any", sweeps.resume(store.folder, progress="none")) == []
    assert cast("Any", sweeps.extend(store.folder, 1, progress="none")) == [[]]
    assert [each.ended for each in begun] == [[True]]
    trial = store.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"status": "paused"}))
    assert cast("Any", sweeps.resume(store.folder, progress="none")) == [[True], []]
