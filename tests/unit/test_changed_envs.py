"""A sweep goes on in the environment that it began with, and says where that, or its code, is another one by now."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from sweep_folders import MACHINE, SPEC, make_sweep_folder

from analysis.comparison.compare import why_not_comparable
from analysis.records import SweepRecord
from policies.envs.make import EnvInfo, check_env
from policies.errors import CannotRunError
from tune_jobs.plan import sweep_plan
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.search.prior import prior_record
from tune_jobs.spec.file import load_spec, stored_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import changed_code, resume
from tune_jobs.sweeps.adding import add_what_is_missing
from tune_jobs.sweeps.drive import write_new

MAZE = {"env": "Maze"}
CARTPOLE, ACROBOT = (f"gymnasium.envs.classic_control:{name}Env" for name in ("CartPole", "Acrobot"))


@pytest.fixture(autouse=True)
def _mazes(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Of Maze there is one version, until a test registers more; plans are made with what this process knows."""

    def checked(env_id: str, env_args: dict[str, Any], algorithm: Any, **_: object) -> EnvInfo:
        return check_env(env_id, env_args, algorithm)

    monkeypatch.setattr(sweep_plan, "check_env", checked)
    gym.register("Maze-v0", CARTPOLE)
    yield
    for env_id in [env_id for env_id in gym.registry if env_id.startswith("Maze-")]:
        del gym.registry[env_id]


def write_sweep(folder: Path, **spec: Any) -> SweepStore:
    store = SweepStore(folder)
    store.create()
    made = load_spec(SPEC | spec)
    write_new(store, made, make_plan(made, MACHINE), None)
    return store


def extend(store: SweepStore) -> SweepPlan:
    record = store.read_record()
    spec = stored_spec(record)
    return add_what_is_missing(
        store, record, spec.model_copy(update={"num_samples": spec.num_samples + 1}), MACHINE, None
    )


def let_train(store: SweepStore) -> None:
    for trial in store.read_trials():
        changes = {"status": "completed", "num_iterations": 3, "num_env_steps": 3000}
        store.trial(trial.trial_id).write_record(trial.model_copy(update=changes))


# -- ids without a version


def test_a_sweep_goes_on_with_the_version_that_its_id_meant(tmp_path: Path) -> None:
    store = write_sweep(tmp_path / "mine", **MAZE)
    assert store.read_record().spec["env"]["id"] == "Maze-v0"
    let_train(store)
    gym.register("Maze-v1", CARTPOLE, max_episode_steps=7)
    plan = extend(store)
    assert (plan.env.env_id, plan.env.max_episode_steps) == ("Maze-v0", None)
    assert store.read_record().spec["env"]["id"] == "Maze-v0"


def test_an_id_with_its_version_and_without_are_one_environment(tmp_path: Path) -> None:
    short, whole = (
        write_sweep(tmp_path / name, env=env).read_record() for name, env in (("a", "Maze"), ("b", "Maze-v0"))
    )
    assert why_not_comparable([short, whole], ["A", "B"]) == []


@pytest.mark.parametrize("env", ["CartPole", "CartPole-v1"])
def test_a_search_that_begins_with_an_earlier_sweep_of_its_environment_says_nothing_of_another(
    tmp_path: Path, env: str
) -> None:
    store = make_sweep_folder(tmp_path / "first")
    spec = load_spec(SPEC | {"env": env, "search": "gp", "prior": "first", "num_samples": 12})
    prior = prior_record(spec, "first", stored_spec(store.read_record()), store.read_trials())
    assert "The model begins with 2 points of sweep first." in make_plan(spec, MACHINE, prior=[prior]).notes


# -- an environment whose code was changed


def change_code() -> None:
    """What the id means has other observations and actions from now on."""
    del gym.registry["Maze-v0"]
    gym.register("Maze-v0", ACROBOT, max_episode_steps=500)


def test_trials_of_another_environment_are_not_added(tmp_path: Path) -> None:
    store = write_sweep(tmp_path / "mine", **MAZE)
    let_train(store)
    change_code()
    before = store.record_path.read_bytes()
    with pytest.raises(CannotRunError) as caught:
        extend(store)
    assert caught.value.message == (
        "Maze-v0 is not the environment that the trials of sweep mine trained in: its observations are of shape (6,), "
        "and were of shape (4,); its actions are of 3 choices, and were of 2 choices."
    )
    assert store.record_path.read_bytes() == before
    assert len(store.read_trials()) == 4


def test_what_needs_no_training_is_done_with_any_environment(tmp_path: Path) -> None:
    store = write_sweep(tmp_path / "mine", **MAZE)
    let_train(store)
    change_code()
    record = store.read_record()
    add_what_is_missing(store, record, stored_spec(record), MACHINE, None)


def test_an_environment_that_was_mended_before_anything_trained_is_the_sweeps_own(tmp_path: Path) -> None:
    store = write_sweep(tmp_path / "mine", **MAZE)
    change_code()
    extend(store)
    let_train(store)
    assert len(extend(store).trials) == 8


def test_a_sweep_of_which_no_shapes_are_known_goes_on_and_knows_them_then(tmp_path: Path) -> None:
    store = write_sweep(tmp_path / "mine", **MAZE)
    let_train(store)
    store.write_record(store.read_record().model_copy(update={"env_spaces": {}}))
    extend(store)
    assert store.read_record().env_spaces == {"observations": "shape (4,)", "actions": "2 choices"}


# -- the commit of a user's own code


@pytest.mark.parametrize(
    ("commits", "modules", "is_told"),
    [
        (("a" * 40, "b" * 40), ("my_envs",), True),
        (("a" * 40, "a" * 40), ("my_envs",), False),
        # Of installed packages the repository says nothing.
        (("a" * 40, "b" * 40), (), False),
        ((None, "b" * 40), ("my_envs",), False),
        (("a" * 40, None), ("my_envs",), False),
    ],
)
def test_who_goes_on_at_another_commit_is_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    commits: tuple[str | None, str | None],
    modules: tuple[str, ...],
    *,
    is_told: bool,
) -> None:
    began, here = commits
    store = make_sweep_folder(tmp_path / "mine")
    changes = {"git_commit": began, "allowed_modules": modules}
    store.write_record(store.read_record().model_copy(update=changes))
    monkeypatch.setattr(changed_code, "git_commit", lambda: here)
    plans: list[SweepPlan] = []

    def run(_: SweepStore, plan: SweepPlan, **__: object) -> SweepRecord:
        plans.append(plan)
        return store.read_record()

    monkeypatch.setattr(resume, "run_sweep", run)
    resume.go_on(store, None, num_samples=1, finish=False, progress="none")
    told = [note for note in plans[0].notes if "at commit" in note]
    assert len(told) == is_told
    for note in told:
        assert f"begun at commit {'a' * 12}, and the working directory is at {'b' * 12} now" in note
        assert "trains with my_envs as that is now" in note


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("CartPole", "CartPole-v1", True), ("CartPole-v1", "CartPole", True), ("CartPole-v0", "CartPole-v1", False),
        ("CartPole", "CartPoleSwingUp-v1", False), ("my_envs:Maze", "my_envs:Maze-v12", True),
    ],
)  # fmt: skip
def test_an_id_of_an_earlier_record_may_lack_its_version(
    tmp_path: Path, first: str, second: str, *, expected: bool
) -> None:
    record = write_sweep(tmp_path / "mine").read_record()
    records = [
        record.model_copy(update={"spec": {**record.spec, "env": {**record.spec["env"], "id": each}}})
        for each in (first, second)
    ]
    assert (why_not_comparable(records, ["A", "B"]) == []) is expected
