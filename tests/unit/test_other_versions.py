"""Sweeps and policies of older and newer versions: what is read, what is refused, and that nothing of them is lost."""

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import make_portable
from store_parts import SWEEP, TRIAL, make_best, make_iteration, make_sweep, make_trial
from stores import Harness
from sweep_folders import MACHINE, SPEC, make_sweep_folder

import tune_jobs
from analysis.comparison.repetition import Changed, first_difference, same_numbers
from analysis.records import FORMAT_VERSION
from policies.acting.evaluate import evaluate_policy
from policies.envs.make import check_env
from policies.errors import CheckpointError, SpecError
from policies.portable.file import describe_space, read_policy, save_policy
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.process.ran_with import versions
from tune_jobs.spec.file import load_spec, stored_spec
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import resume
from tune_jobs.sweeps.adding import add_what_is_missing
from tune_jobs.sweeps.repeating import plan_of_repetition

POPULATION = {
    "algorithm": "dqn",
    "space": {"lr": {"loguniform": [1e-4, 1e-2]}, "target_update_unit": {"choice": ["env_step", "episode"]}},
    "scheduler": "pbt",
    "seeds_per_point": 1,
}
"""What 0.1.0 launched."""


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return make_sweep_folder(tmp_path / "mine")


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def files(store: SweepStore) -> dict[Path, bytes]:
    """Every file but those of locks."""
    found = (path for path in store.folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path: path.read_bytes() for path in found}


def unfinished(store: SweepStore) -> None:
    """Let a trial wait to go on."""
    (trial, *_) = store.read_trials()
    store.trial(trial.trial_id).write_record(trial.model_copy(update={"status": "paused"}))


# -- what another version wrote stays


@pytest.mark.parametrize("key", [SWEEP, TRIAL])
def test_what_a_newer_version_added_stays_where_its_file_is_written_again(
    harness: Harness, sweep: Sweep, trial: Trial, key: str
) -> None:
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())
    harness.put("mine", key, json.dumps(json.loads(harness.content("mine", key)) | {"mood": ["good"]}).encode())
    sweep.write_record(sweep.read_record().model_copy(update={"num_trials": 9}))
    trial.write_record(trial.read_record().model_copy(update={"status": "paused"}))
    sweep.settle()
    found = json.loads(harness.content("mine", key))
    assert found["mood"] == ["good"]
    assert found["num_trials" if key == SWEEP else "status"] == (9 if key == SWEEP else "paused")


@pytest.mark.parametrize(
    "go_on",
    [
        lambda place: tune_jobs.resume(place, progress="none"),
        lambda place: tune_jobs.extend(place, num_samples=2, progress="none"),
        lambda place: tune_jobs.replicate(place, progress="none"),
    ],
    ids=["resume", "extend", "replicate"],
)
def test_a_sweep_whose_spec_is_not_known_is_left_as_it_is(store: SweepStore, go_on: Callable[[Path], object]) -> None:
    # Its driver was killed.
    trial = store.trial("t0001").read_record()
    store.trial("t0001").write_record(trial.model_copy(update={"status": "running"}))
    job = {"id": "mine-1", "address": "http://head:8265"}
    rewrite(store.record_path, lambda data: data.update(state="running", mood="good", job=job))
    rewrite(store.record_path, lambda data: data["spec"].update(mood={"is": "good"}))
    before = files(store)
    with pytest.raises(CheckpointError, match=r"spec\.mood: there is no field 'mood' here"):
        go_on(store.folder)
    assert files(store) == before


def test_a_record_says_by_its_format_whose_spec_it_has(harness: Harness, store: SweepStore, sweep: Sweep) -> None:
    """0.1.0 reads formats up to 2. It would write sweep.json again without what it does not know."""
    assert store.read_record().format_version == 3
    store.write_record(store.read_record().model_copy(update={"format_version": 2}))
    spec = stored_spec(store.read_record())
    add_what_is_missing(store, store.read_record(), spec, MACHINE, None)
    # Nothing is left, and the spec is as it was.
    assert store.read_record().format_version == 2
    unfinished(store)
    add_what_is_missing(store, store.read_record(), spec, MACHINE, None)
    assert store.read_record().format_version == 3
    # These have not changed since.
    sweep.write_record(make_sweep())
    sweep.write_best(make_best())
    assert json.loads(harness.content("mine", "best/evaluation.json"))["format_version"] == 2
    manifest = store.trial("t0003").checkpoint_folder(6) / "manifest.json"
    assert json.loads(manifest.read_text())["format_version"] == 2


# -- masks of actions, which 0.1.0 did not ask environments for


class Masking(gym.Env[Any, Any]):
    """Has a method that says which actions are allowed."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (3,), np.float32), gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.left = 5
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return np.zeros(3, np.float32), 1.0, not self.left, False, {}

    def action_masks(self) -> Any:
        return np.array([True, False])


@pytest.fixture
def _masking() -> Iterator[None]:
    gym.register("OldMasking-v0", cast("Any", Masking))
    yield
    gym.registry.pop("OldMasking-v0")


@pytest.mark.usefixtures("_masking")
def test_a_policy_of_before_masks_acts_without_one(tmp_path: Path) -> None:
    path = save_policy(make_portable("OldMasking-v0", action_mask=False), tmp_path)

    def as_before(data: dict[str, Any]) -> None:
        del data["env_args"]["action_mask"], data["observation_space"]["mask"]

    rewrite(path, as_before)
    policy = tune_jobs.load_policy(tmp_path)
    env = policy.make_env()
    assert policy.act(env.reset(seed=0)[0]) in (0, 1)
    assert evaluate_policy(policy, env_id=policy.env_id, env_args=policy.env_args, seeds=[3]).returns == (5.0,)


@pytest.mark.usefixtures("_masking")
def test_a_policy_of_now_has_the_arguments_that_it_was_saved_with(tmp_path: Path) -> None:
    space = describe_space(check_env("OldMasking-v0", None).observation_space)
    masked = make_portable("OldMasking-v0", hidden=(4,), action_mask=False)
    for made in (make_portable("CartPole-v1"), dataclasses.replace(masked, env_args={}, observation_space=space)):
        path = save_policy(made, tmp_path)
        assert "mask" in json.loads(path.read_text())["observation_space"]
        again = read_policy(path)
        assert (again.env_args, again.observation_space) == ({}, made.observation_space)


def test_a_sweep_of_before_masks_goes_on_without_one(store: SweepStore) -> None:
    assert stored_spec(store.read_record()).env.action_mask is None
    rewrite(store.record_path, lambda data: data["spec"]["env"].pop("action_mask"))
    assert stored_spec(store.read_record()).env.action_mask is False


# -- rules that came later


@pytest.mark.parametrize(
    ("spec", "wrong"),
    [({"resources": {"num_gpus": 2}}, "resources.num_gpus"), (POPULATION, "space.target_update_unit")],
)
def test_what_is_refused_of_new_sweeps_alone_is_read(store: SweepStore, spec: dict[str, Any], wrong: str) -> None:
    with pytest.raises(SpecError, match=wrong):
        load_spec(SPEC | spec)
    rewrite(store.record_path, lambda data: data["spec"].update(load_spec(SPEC).model_dump(mode="json") | spec))
    record = store.read_record()
    found = stored_spec(record)
    assert (found.resources.num_gpus, "target_update_unit" in found.space) == (
        spec.get("resources", {}).get("num_gpus", 0),
        spec is POPULATION,
    )


def test_nothing_more_trains_by_a_rule_that_is_refused_now(store: SweepStore) -> None:
    rewrite(store.record_path, lambda data: data["spec"]["resources"].update(num_gpus=2))
    record, trials = store.read_record(), store.read_trials()
    spec, machine = stored_spec(record), dataclasses.replace(MACHINE, num_gpus=4.0)
    assert add_what_is_missing(store, record, spec, machine, None).gpus_per_trial == 2
    with pytest.raises(SpecError, match=r"^mine: resources\.num_gpus: 2 is not allowed"):
        plan_of_repetition(spec, trials[0], record, machine)
    unfinished(store)
    before = files(store)
    with pytest.raises(SpecError, match=r"^mine: resources\.num_gpus: 2 is not allowed"):
        add_what_is_missing(store, record, spec, machine, None)
    assert files(store) == before


# -- numbers that one version writes down and another does not


def test_what_one_version_lacks_of_the_learners_numbers_is_no_difference() -> None:
    def made(**learner: float) -> list[Any]:
        return [make_iteration(number, learner=learner) for number in (1, 2)]

    recorded, now = made(loss=0.5, kl=0.0), made(loss=0.5, entropy=0.6)
    for pair in ((recorded, now), (now, recorded)):
        assert first_difference(*pair, may_lack_evaluation=False) is None
        assert same_numbers(*pair, are_evaluated_alike=True)
    other = [recorded[0], make_iteration(2, learner={"kl": 0.0})]
    assert first_difference(recorded, other, may_lack_evaluation=False) == (
        2,
        (Changed("learner/loss", "0.5", "None"),),
    )
    assert not same_numbers(recorded, other, are_evaluated_alike=True)


# -- who goes on with a sweep is told


@pytest.mark.parametrize(
    ("began", "format_version", "words"),
    [
        ("0.0.9", FORMAT_VERSION, "tune-jobs 0.0.9"),
        (None, FORMAT_VERSION, None),
        ("mine", FORMAT_VERSION, None),
        # That of a release, before the number was raised.
        ("mine", 2, f"an earlier tune-jobs ({versions()['tune-jobs']})"),
        (None, 2, "an earlier tune-jobs (no number)"),
    ],
)
def test_a_sweep_that_another_version_began_is_told(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, began: str | None, format_version: int, words: str | None
) -> None:
    here = versions()["tune-jobs"]
    found = {} if began is None else {"tune-jobs": here if began == "mine" else began}
    changes = {"versions": found, "format_version": format_version}
    unfinished(store)
    plans: list[SweepPlan] = []

    class SeenError(Exception):
        pass

    def run(_: SweepStore, plan: SweepPlan, **__: object) -> None:
        plans.append(plan)
        raise SeenError

    monkeypatch.setattr(resume, "run_sweep", run)
    calls: list[Callable[[], object]] = [
        lambda: resume.go_on(store, None, finish=False, progress="none"),
        lambda: resume.replicate(store, None, lambda: None, finish=False, progress="none"),
    ]
    for go_on in calls:
        store.write_record(store.read_record().model_copy(update=changes))
        with pytest.raises(SeenError):
            go_on()
    told = [[note for note in plan.notes if "was begun with" in note] for plan in plans]
    assert [len(notes) for notes in told] == [int(words is not None)] * 2
    assert all(f"begun with {words}, and what is left of it trains as tune-jobs {here}" in note
               for notes in told for note in notes)  # fmt: skip
