"""What a plan says of environments that do what Gymnasium allows, and that those who train seldom want."""

import dataclasses
from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from analysis.objectives import trial_score
from analysis.records import IterationRecord
from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs.checked import CheckedEnvs
from policies.envs.faults import env_failed
from policies.envs.make import check_env, make_vector_env
from policies.errors import EnvFailedError
from policies.packed.envs.make import make_packed_envs
from tune_jobs.plan.env_notes import _on_goals, env_notes
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

NUMBERS = spaces.Box(-9, 9, (3,), np.float32)
BESIDE: dict[str, gym.Space[Any]] = {
    "choice": spaces.Discrete(3), "way": spaces.Dict({"left": NUMBERS, "right": NUMBERS})
}  # fmt: skip


class Walk(gym.Env[Any, Any]):
    """Observes something that differs from the first episode to the next, and refuses an action at times."""

    def __init__(
        self, observations: gym.Space[Any] = NUMBERS, left: float = 0.0, refuses: Exception | None = None
    ) -> None:
        self.observation_space, self.action_space = observations, spaces.Discrete(2)
        self.left, self.refuses = left, refuses
        self.resets = self.steps = 0

    def seen(self) -> Any:
        numbers = np.array([1, 2, 3 + self.left * (self.resets > 1)], np.float32)
        if isinstance(self.observation_space, spaces.Box):
            return numbers
        if isinstance(self.observation_space, spaces.Dict) and "way" in self.observation_space.spaces:
            seen = {"choice": 1, "way": {"left": np.zeros(3, np.float32), "right": numbers}}
            return (
                seen | {"action_mask": np.array([self.resets < 2, 1])}
                if "action_mask" in self.observation_space.spaces
                else seen
            )
        self.observation_space.seed(0)
        return self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.resets, self.steps = self.resets + 1, 0
        return self.seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if self.refuses is not None and self.steps == 3:
            raise self.refuses
        return self.seen(), 1.0, self.steps >= 5, False, {}


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    yield
    gym.registry.pop("ToldWalk-v0", None)


def notes_on(**args: Any) -> list[str]:
    gym.register("ToldWalk-v0", cast("Any", lambda: Walk(**args)))
    spec = load_spec({"env": "ToldWalk-v0", "algorithm": "ppo"})
    return [note for note in env_notes(spec, check_env("ToldWalk-v0", None, "ppo")) if "are made vectors" not in note]


# -- what an episode leaves to the next


@pytest.mark.parametrize(
    ("observations", "place"),
    [
        (NUMBERS, r"[2]"),
        (spaces.Dict(BESIDE), "observation['way']['right'][2]"),
        (spaces.Dict({"action_mask": spaces.MultiBinary(2), **BESIDE}), "observation['way']['right'][2]"),
    ],
    ids=["numbers", "members", "members and a mask"],
)
def test_a_first_observation_that_differs_on_the_same_seed_is_told(observations: gym.Space[Any], place: str) -> None:
    told = [note for note in notes_on(observations=observations, left=0.25) if "reset twice" in note]
    assert len(told) == 1
    assert f"its first observation differs: {place} is 3 and then 3.25." in told[0]


def test_nothing_is_said_of_what_is_rounded_otherwise_or_of_another_mask() -> None:
    assert notes_on(left=1e-6) == []
    gym.registry.pop("ToldWalk-v0")
    told = notes_on(observations=spaces.Dict({"action_mask": spaces.MultiBinary(2), **BESIDE}))
    assert [note for note in told if "reset twice" in note] == []


def test_images_and_what_changes_its_shape_are_told_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def image(self: Walk) -> Any:
        return np.full((4, 5, 3), 7 + (self.resets > 1), np.uint8)

    def other_shape(self: Walk) -> Any:
        return np.zeros(3 - (self.resets > 1), np.float32)

    monkeypatch.setattr(Walk, "seen", image)
    # Bytes as small as these are told besides.
    note, _ = notes_on(observations=spaces.Box(0, 255, (4, 5, 3), np.uint8))[::-1]
    assert "differs: [0, 0, 0] is 7 and then 8." in note
    gym.registry.pop("ToldWalk-v0")
    monkeypatch.setattr(Walk, "seen", other_shape)
    (note,) = notes_on()
    assert "differs: it is of shape (3,) and then (2,)." in note


def test_an_env_that_can_be_reset_only_once_is_left_to_its_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Walk.seen

    def once(self: Walk) -> Any:
        if self.resets > 1:
            raise RuntimeError("no more")
        return seen(self)

    monkeypatch.setattr(Walk, "seen", once)
    assert notes_on() == []


# -- masks that are not used


class Masked(Walk):
    """Says which actions are allowed in one way or another, of which none is used without a word."""

    def __init__(self, infos: dict[str, Any] | None = None, **methods: Any) -> None:
        super().__init__(methods.pop("observations", NUMBERS))
        self.infos = infos or {}
        for name, method in methods.items():
            setattr(self, name, method)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return super().reset(seed=seed)[0], self.infos

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], self.infos


def masked(**args: Any) -> list[str]:
    gym.register("ToldWalk-v0", cast("Any", lambda: Masked(**args)))
    env_args = args.pop("env_args", None)
    spec = load_spec({"env": "ToldWalk-v0", "algorithm": "ppo"})
    return [note for note in env_notes(spec, check_env("ToldWalk-v0", env_args)) if "are made vectors" not in note]


MASK = np.array([1, 0], np.int8)
LEGAL = spaces.Dict({"legal": spaces.MultiBinary(2), "n": NUMBERS})


@pytest.mark.parametrize(
    ("args", "place", "setting"),
    [
        ({"infos": {"action_mask": MASK}}, "info['action_mask']", "true"),
        ({"infos": {"board": MASK, "legal_moves": [True, False]}}, "info['legal_moves']", "legal_moves"),
        ({"observations": LEGAL}, "observation['legal']", "legal"),
        ({"valid_action_mask": lambda: MASK}, "valid_action_mask()", "valid_action_mask"),
        ({"get_legal_mask": lambda: MASK}, "get_legal_mask()", "get_legal_mask"),
    ],
    ids=["info", "info of another name", "member", "method", "another method"],
)
def test_what_looks_like_a_mask_is_told_with_the_setting_that_uses_it(
    args: dict[str, Any], place: str, setting: str
) -> None:
    told = masked(**args)
    (note,) = told
    assert note == (
        f"ToldWalk-v0 gives {place}, which seems to say which actions are allowed, and which is not used: "
        f"env.action_mask: {setting} uses it."
    )
    gym.registry.pop("ToldWalk-v0")
    value = True if setting == "true" else setting
    gym.register("ToldWalk-v0", cast("Any", lambda: Masked(**args)))
    info = check_env("ToldWalk-v0", {"action_mask": value})
    assert (info.mask, info.unused_mask) == (place, None)
    assert check_env("ToldWalk-v0", {"action_mask": False}).unused_mask is None


@pytest.mark.parametrize(
    "args",
    [
        {"infos": {"legal_moves": [0, 1, 1], "valid": True, "mask": "none", "moves": MASK}},
        {"observations": spaces.Dict({"legal": spaces.MultiBinary(3), "n": NUMBERS})},
        {"observations": spaces.Dict({"left": spaces.MultiBinary(2), "n": NUMBERS})},
        {"action_mask_of": lambda state: MASK, "mask": lambda: MASK, "valid_actions": lambda: [0]},
        {"valid_action_mask": MASK},
    ],
    ids=["infos", "another length", "another name", "methods of other names or with arguments", "no method"],
)
def test_what_only_resembles_a_mask_is_not_told(args: dict[str, Any]) -> None:
    assert masked(**args) == []


def test_no_property_is_read_that_is_not_called_as_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def reading(name: str) -> property:
        return property(lambda _: read.append(name))

    for name in ("is_valid", "legal", "legal_mask"):
        monkeypatch.setattr(Masked, name, reading(name), raising=False)
    assert masked() == []
    assert read == ["legal_mask"]


# -- choices by the thousand


@pytest.mark.parametrize(
    ("observations", "place", "size"),
    [
        (
            spaces.Dict({"edges": spaces.MultiDiscrete(np.full((2, 50), 40)), "n": NUMBERS}),
            "observation['edges']",
            "4,000",
        ),
        (spaces.Tuple((NUMBERS, spaces.Discrete(3000))), "observation[1]", "3,000"),
        (spaces.Discrete(4000), "observation", "4,000"),
    ],
    ids=["many choices", "one of many values", "alone"],
)
def test_a_member_whose_choices_are_most_of_the_numbers_is_named(
    observations: gym.Space[Any], place: str, size: str
) -> None:
    (note,) = notes_on(observations=observations)
    assert note.startswith(f"{size} numbers of these vectors are the choices of {place}, one for each value")


@pytest.mark.parametrize(
    "observations",
    [
        spaces.Dict({"few": spaces.Discrete(2999)}),
        spaces.Dict({"part": spaces.Discrete(3000), "n": spaces.Box(0, 1, (3001,), np.float32)}),
    ],
    ids=["few", "less than half"],
)
def test_of_few_choices_or_a_small_part_nothing_is_said(observations: gym.Space[Any]) -> None:
    assert notes_on(observations=observations) == []


# -- actions that are refused


class Forgetful(Masked):
    """Says in the first observation alone which actions are allowed."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], {}


def refused_by(error: Exception) -> list[EnvFailedError]:
    """Return what is raised for an env's error by all that step environments."""
    gym.register("ToldWalk-v0", cast("Any", lambda: Walk(refuses=error)))
    rows = CheckedEnvs(make_vector_env("ToldWalk-v0", None, 2), "ToldWalk-v0")
    rows.reset(seed=0)
    packed = make_packed_envs("ToldWalk-v0", None, 2, kind="scalar")
    packed.add("t0000", 0)
    for _ in range(2):
        rows.step(np.zeros(2, np.int64))
        packed.step(np.zeros(2, np.int64))
    with pytest.raises(EnvFailedError) as of_rllib:
        rows.step(np.zeros(2, np.int64))
    packed.step(np.zeros(2, np.int64))
    of_packs = packed.errors["t0000"]
    assert isinstance(of_packs, EnvFailedError)
    policy = RandomPolicy(Walk().observation_space, Walk().action_space, env_id="ToldWalk-v0")
    with pytest.raises(EnvFailedError) as of_episodes:
        evaluate_policy(policy, env_id="ToldWalk-v0", seeds=[0])
    return [of_rllib.value, of_packs, of_episodes.value]


@pytest.mark.parametrize(
    "said",
    ["Illegal move", "Operation 3 is not available", "valid machines are [1]", "3 is forbidden", "inadmissible: 3"],
)
def test_whoever_refuses_an_action_is_told_of_masks(said: str) -> None:
    for failed in refused_by(ValueError(said)):
        assert said in str(failed)
        assert "a mask must say so: see 'Actions that are not always allowed'" in failed.hint


def test_the_kind_of_an_error_counts_and_other_errors_do_not() -> None:
    class InvalidActionError(Exception):
        pass

    assert all("a mask must say so" in failed.hint for failed in refused_by(InvalidActionError()))
    gym.registry.pop("ToldWalk-v0")
    assert not any("mask" in failed.hint for failed in refused_by(ZeroDivisionError("the cart left the track")))
    gym.registry.pop("ToldWalk-v0")
    # What this package raises, as of a mask that is not there, says itself what is wrong.
    gym.register("ToldWalk-v0", cast("Any", lambda: Forgetful({"legal": MASK})))
    with pytest.raises(EnvFailedError, match=r"there is no info\['legal'\] after env step 1") as caught:
        check_env("ToldWalk-v0", {"action_mask": "legal"})
    assert "a mask must say so" not in caught.value.hint
    # Outside of a step there is no action to refuse.
    assert "mask" not in env_failed("It raised an error in reset()", ValueError("an invalid map")).hint


def test_the_section_on_masks_is_called_so() -> None:
    from pathlib import Path

    guide = Path(__file__).parents[2] / "docs" / "guides" / "own-environment.md"
    assert "\n## Actions that are not always allowed\n" in guide.read_text()


# -- goals below what trials are judged by

BY_STEPS = {"type": "steps_to_threshold"}


def notes_of_goals(env_threshold: float | None = 475.0, **fields: Any) -> list[str]:
    spec = load_spec({"env": "CartPole-v1", "algorithm": "ppo", **fields})
    return list(_on_goals(spec, dataclasses.replace(check_env("CartPole-v1", None, "ppo"), threshold=env_threshold)))


@pytest.mark.parametrize("rule", ["evaluation_return", "training_return"])
@pytest.mark.parametrize(
    ("objective", "env_threshold", "whose"),
    [
        (BY_STEPS, 475.0, "CartPole-v1's threshold 475"),
        ({**BY_STEPS, "threshold": 400}, 475.0, "objective.threshold 400"),
        ({**BY_STEPS, "threshold": 400}, None, "objective.threshold 400"),
    ],
)
def test_who_ends_trials_before_the_threshold_that_they_are_judged_by_is_told(
    rule: str, objective: dict[str, Any], env_threshold: float | None, whose: str
) -> None:
    (told,) = notes_of_goals(env_threshold, objective=objective, stop={rule: 195})
    assert told.startswith(f"stop.{rule} 195 is below {whose}, and objective.type is steps_to_threshold: ")
    assert told.endswith(f"Raise stop.{rule} or leave it out, or set objective.threshold to 195.")
    assert notes_of_goals(env_threshold, objective={**BY_STEPS, "threshold": 195}, stop={rule: 195}) == []
    assert notes_of_goals(env_threshold, objective=objective, stop={rule: 475}) == []
    # It counts as one that never reached it, as slow as the worst.
    early, never = (
        [IterationRecord(iteration=1, num_env_steps=5_120, num_episodes=1, time_s=1.0, evaluation_return=value)]
        for value in (200.0, 9.0)
    )
    assert {
        trial_score(rows, "steps_to_threshold", num_env_steps=50_000, threshold=475.0) for rows in (early, never)
    } == {-100_000.0}


def test_by_other_objectives_a_goal_below_the_threshold_is_a_matter_of_training_returns() -> None:
    (told,) = notes_of_goals(stop={"training_return": 195, "evaluation_return": 195})
    assert told == "stop.training_return 195 is below CartPole-v1's threshold 475: trials may end before they solve it."
    assert notes_of_goals(None, stop={"training_return": 195, "evaluation_return": 195}) == []
    population: dict[str, Any] = {"scheduler": "pbt", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 4}
    assert notes_of_goals(objective=BY_STEPS, stop={"evaluation_return": 195}, **population) == []


def test_the_plan_tells_of_such_a_goal() -> None:
    spec = load_spec(
        {"env": "CartPole-v1", "algorithm": "ppo", "objective": BY_STEPS, "stop": {"evaluation_return": 195}}
    )
    (told,) = [note for note in make_plan(spec, Machine(2)).notes if "steps_to_threshold" in note]
    assert told.startswith("stop.evaluation_return 195 is below CartPole-v1's threshold 475")
