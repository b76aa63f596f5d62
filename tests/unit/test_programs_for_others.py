"""The written programs for Stable-Baselines3 train as ours do, or a note says in what they don't."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.spaces import flatten_space
from report_sources import setting, settings_of, source_of
from sweep_folders import make_sweep_folder
from synthetic_sweep import make_sweep

from analysis.page import next_steps
from policies.envs.make import check_env
from policies.foreign_code import ForeignProgram, rllib_program, stable_baselines3_program
from policies.guard import guarded
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.networks.epsilon import EpsilonSchedule

SMALL: dict[str, Any] = {"hidden_sizes": (4,), "learning_starts": 0, "train_batch_size": 1}
OWN = """
import gymnasium
from gymnasium.spaces import Box, Dict, Discrete


class Corridor(gymnasium.Env):
    observation_space, action_space = Box(0, 9, (1,)), Discrete(2)

    def __init__(self, length):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.seen(), {}

    def step(self, action):
        self.place += 1
        return self.seen(), 1.0, self.place >= self.length, False, {}

    def seen(self):
        return self.observation_space.sample()


class Members(Corridor):
    observation_space = Dict(place=Discrete(10), light=Box(0, 1, (2,)))
"""
LATE = {"epsilon_start": 100, "epsilon_decay": 200.0}


@pytest.fixture(autouse=True)
def _logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Stable-Baselines3 makes a folder for each model, of which nobody would take it away.
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))


def for_sb3(values: TrainedHyperparams, num_env_steps: int = 10_000) -> ForeignProgram:
    return stable_baselines3_program(values, env_id="CartPole-v1", env_args={}, num_env_steps=num_env_steps)


def for_rllib(**changes: Any) -> ForeignProgram:
    return rllib_program(DQNHyperparams(**changes), env_id="CartPole-v1", env_args={})


def sb3_model(values: TrainedHyperparams, num_env_steps: int = 10_000, *, trains: bool = True) -> Any:
    pytest.importorskip("stable_baselines3")
    code = for_sb3(values, num_env_steps).code
    names: dict[str, Any] = {}
    # The last line trains.
    exec(code if trains else code.rsplit("\n", 1)[0], names)
    return names["model"]


# -- updates


@pytest.mark.parametrize(
    ("train_freq", "num_envs", "updates_per_env_step", "phase"),
    [
        (4, 1, 0.25, (4, 1)), (4, 1, 0.1, (10, 1)), (4, 8, 0.01, (25, 2)), (10, 4, 0.25, (3, 3)), (4, 1, 0.4, (5, 2)),
        (1, 4, 2.0, (1, 8)), (2, 1, 0.00125, (800, 1)),
    ],
)  # fmt: skip
def test_sb3_makes_as_many_updates(
    train_freq: int, num_envs: int, updates_per_env_step: float, phase: tuple[int, int]
) -> None:
    values = DQNHyperparams(
        **SMALL, train_freq=train_freq, num_envs=num_envs, updates_per_env_step=updates_per_env_step
    )
    model = sb3_model(values, 400)
    assert (model.train_freq.frequency, model.gradient_steps) == phase
    phases = math.ceil(400 / (phase[0] * num_envs))
    # As many as ours, rounded up to whole phases.
    assert model._n_updates == phases * phase[1]
    assert model._n_updates == pytest.approx(phases * phase[0] * num_envs * updates_per_env_step, rel=0.01)


@pytest.mark.parametrize("updates_per_env_step", [1e-7, 0.0837, 0.3, 0.77, 3.21])
def test_a_rate_of_updates_is_kept_and_a_note_tells_of_other_phases(updates_per_env_step: float) -> None:
    values = DQNHyperparams(updates_per_env_step=updates_per_env_step)
    names: dict[str, Any] = {}
    program = for_sb3(values)
    for line in program.code.splitlines():
        if "train_freq" in line or "gradient_steps" in line:
            exec(line.strip(" ,"), names)
    assert names["train_freq"] >= 4
    assert names["gradient_steps"] / names["train_freq"] == pytest.approx(updates_per_env_step, rel=0.01)
    found = [note for note in program.notes if note.startswith("Updates in a training phase: ")]
    assert found == [note for note in for_rllib(updates_per_env_step=updates_per_env_step).notes if "phase: " in note]
    assert len(found) == 1


def test_phases_that_are_ours_have_no_note() -> None:
    values = DQNHyperparams(double_q=False, dueling=False, learning_starts=0)
    assert for_sb3(values).notes == ()
    note = "Updates in a training phase: 1 every 10 env steps, ours 0.4 on average every 4."
    assert note in for_sb3(values.model_copy(update={"updates_per_env_step": 0.1})).notes


# -- target updates


@pytest.mark.parametrize("updates_per_env_step", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("num_envs", [1, 4])
def test_sb3s_soft_target_moves_as_far_as_ours(
    updates_per_env_step: float, num_envs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = DQNHyperparams(**SMALL, tau=0.05, num_envs=num_envs, updates_per_env_step=updates_per_env_step)
    dqn = pytest.importorskip("stable_baselines3.dqn.dqn")
    taus: list[float] = []
    monkeypatch.setattr(dqn, "polyak_update", lambda _, __, tau: taus.append(tau))
    model = sb3_model(values, 80)
    # Each move is followed by one of running statistics, of which there are none.
    kept = math.prod(1 - tau for tau in taus[::2])
    assert kept == pytest.approx((1 - 0.05) ** model._n_updates)
    moves_in_it = updates_per_env_step * max(4, num_envs) > 1
    assert any("target network is updated once" in note for note in for_sb3(values).notes) is moves_in_it


@pytest.mark.parametrize(
    ("changes", "interval", "note"),
    [
        ({}, 500, ""),
        ({"num_envs": 8}, 496, ""),
        ({"target_update_freq": 10, "train_freq": 1, "updates_per_env_step": 1.0}, 10, ""),
        # Ours is updated after an update, of which there is one in four env steps.
        ({"target_update_freq": 10}, 12, ""),
        ({"target_update_freq": 20, "num_envs": 8}, 16, "every 16 env steps, ours every 20."),
        (
            {"target_update_freq": 100, "train_freq": 1000, "updates_per_env_step": 1.0},
            1000,
            "once for each training phase, not 10 times in it.",
        ),
        ({"target_update_freq": 100, "train_freq": 1000, "target_update_unit": "episode"}, 1000, ""),
    ],
)
def test_sb3s_target_is_updated_as_often(changes: dict[str, Any], interval: int, note: str) -> None:
    program = for_sb3(DQNHyperparams(**changes))
    assert f"    target_update_interval={interval},\n" in program.code
    found = [text.removeprefix("The target network is updated ") for text in program.notes if "target network" in text]
    assert found == ([note] if note else [])


# -- exploration


@pytest.mark.parametrize("changes", [{"epsilon_decay": 1000.0}, {"epsilon_decay": 100.0}, LATE, {"epsilon_start": 500}])
def test_sb3s_epsilon_ends_where_ours_does(changes: dict[str, Any]) -> None:
    values = DQNHyperparams(**SMALL, **changes)
    model = sb3_model(values, 250)
    epsilon = EpsilonSchedule.of(values)
    assert model.exploration_rate == pytest.approx(epsilon.at(model.num_timesteps), abs=0.02)
    if "epsilon_start" not in changes:
        assert model.exploration_schedule(0.8) == pytest.approx(epsilon.at(50))
    assert any("epsilon_start is left out" in note for note in for_sb3(values).notes) is ("epsilon_start" in changes)


@pytest.mark.parametrize(
    ("changes", "is_told"), [({}, True), ({"learning_starts": 0}, False), ({"epsilon_start": 1000}, False)]
)
def test_random_actions_before_learning_are_told(changes: dict[str, Any], is_told: bool) -> None:
    notes = for_sb3(DQNHyperparams(**changes)).notes
    assert ("SB3's actions are all random until learning_starts, ours as epsilon says." in notes) is is_told


# -- optimizers


def test_sb3s_optimizer_is_ours() -> None:
    def defaults(values: TrainedHyperparams) -> tuple[str, dict[str, Any]]:
        optimizer = sb3_model(values, trains=False).policy.optimizer
        return type(optimizer).__name__, optimizer.defaults

    name, found = defaults(PPOHyperparams())
    assert (name, found["eps"], found["betas"]) == ("Adam", 1e-8, (0.9, 0.999))
    name, found = defaults(DQNHyperparams(optimizer_epsilon=1e-3, adam_beta1=0.8, adam_beta2=0.99))
    assert (name, found["eps"], found["betas"]) == ("Adam", 1e-3, (0.8, 0.99))
    values = DQNHyperparams(optimizer="rmsprop", optimizer_epsilon=1e-3, rmsprop_rho=0.95, rmsprop_momentum=0.5)
    name, found = defaults(values)
    assert (name, found["eps"], found["alpha"], found["momentum"]) == ("RMSprop", 1e-3, 0.95, 0.5)
    assert not any("rmsprop" in note for note in for_sb3(values).notes)


def test_what_rllibs_optimizer_lacks_is_told() -> None:
    told = "left out: RLlib makes Adam with torch's defaults."
    assert for_rllib(optimizer_epsilon=1e-3).notes == (f"optimizer_epsilon is {told}",)
    assert for_rllib(adam_beta1=0.8, adam_beta2=0.99).notes == (f"adam_beta1, adam_beta2 are {told}",)
    assert for_rllib(optimizer="rmsprop", adam_beta1=0.8).notes == ("RLlib's DQN lacks optimizer rmsprop.",)


def test_a_scale_of_rewards_that_others_lack_is_told() -> None:
    assert for_rllib(reward_scale=0.1).notes == ("RLlib's DQN lacks reward_scale.",)
    scaled = DQNHyperparams(**SMALL, reward_scale=0.1)
    assert "reward_scale" in " ".join(set(for_sb3(scaled).notes) - set(for_sb3(DQNHyperparams(**SMALL)).notes))


def test_dense_layers_that_rllibs_heads_do_not_share_are_told() -> None:
    told = "Each head has hidden_sizes of its own: RLlib's heads share the convolutions alone."
    filters = {"conv_filters": ((4, 3, 2),)}
    assert told in for_rllib(**filters).notes
    assert told not in for_rllib(**filters, dueling=False).notes
    for shares in (False, True):
        values = PPOHyperparams(**filters, vf_share_layers=shares)
        assert (told in rllib_program(values, env_id="E", env_args={}).notes) is shares


# -- RLlib's target updates, which are looked at after each update


def test_rllibs_target_updates_that_are_not_ours_are_told() -> None:
    assert for_rllib(tau=0.1, updates_per_env_step=1.0).notes == ()
    assert for_rllib(target_update_freq=2_000, train_freq=1_000).notes == ()
    assert for_rllib(target_update_freq=100, train_freq=1_000).notes == (
        "The target network is updated once in each training phase, not 10 times.",
    )
    assert for_rllib(target_update_freq=1_500, train_freq=1_000).notes == (
        "The target network is updated every 2000 env steps, ours every 1500.",
    )


# -- observations


@pytest.mark.parametrize(
    ("env_id", "args", "flattened"),
    [
        ("CartPole-v1", {}, False), ("FrozenLake-v1", {}, True), ("Blackjack-v1", {}, True),
        ("Blackjack-v1", {"frame_stack": 2}, True), ("Taxi-v3", {"action_mask": True}, True),
    ],
)  # fmt: skip
def test_whether_observations_were_made_vectors_is_known(env_id: str, args: dict[str, Any], flattened: bool) -> None:
    assert check_env(env_id, args).is_flattened is flattened
    assert guarded.check_env(env_id, args).is_flattened is flattened


@pytest.mark.parametrize(
    "values", [PPOHyperparams(num_envs=2, train_batch_size=32, minibatch_size=16), DQNHyperparams(**SMALL)], ids=type
)
@pytest.mark.parametrize("env_id", ["Blackjack-v1", "FrozenLake-v1"])
def test_sb3_trains_on_observations_that_are_no_vectors(env_id: str, values: TrainedHyperparams) -> None:
    pytest.importorskip("stable_baselines3")
    names: dict[str, Any] = {}
    program = stable_baselines3_program(values, env_id=env_id, env_args={}, num_env_steps=64, flattens=True)
    exec(program.code, names)
    assert names["model"].num_timesteps >= 64
    assert names["model"].observation_space == flatten_space(gym.make(env_id).observation_space)


@pytest.mark.parametrize(
    "values", [PPOHyperparams(num_envs=2, train_batch_size=32, minibatch_size=16), DQNHyperparams(**SMALL)], ids=type
)
@pytest.mark.parametrize(("name", "flattens"), [("Corridor", False), ("Members", True)])
def test_sb3_trains_on_a_class_of_ones_own(
    name: str, flattens: bool, values: TrainedHyperparams, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    (tmp_path / "own_corridor.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    names: dict[str, Any] = {}
    program = stable_baselines3_program(
        values, env_id=f"own_corridor:{name}", env_args={"length": 5}, num_env_steps=64, flattens=flattens
    )
    exec(program.code, names)
    assert names["model"].num_timesteps >= 64
    assert names["env"].get_attr("unwrapped")[0].length == 5
    del gym.registry[f"{name}-v0"]


@pytest.mark.parametrize("env_id", ["CartPole-v1", "my_envs:Maze-v0", "my_envs:deep/Maze-v3"])
def test_what_gymnasium_knows_needs_no_registration(env_id: str) -> None:
    for code in (
        stable_baselines3_program(PPOHyperparams(), env_id=env_id, env_args={}, num_env_steps=64).code,
        rllib_program(PPOHyperparams(), env_id=env_id, env_args={}).code,
    ):
        assert f"({env_id!r}" in code
        assert "register" not in code


def test_images_that_have_to_be_made_first_are_told() -> None:
    told = "The env's own observations are no images, as the convolutions need: wrap it."
    for filters, flattens in ((None, True), (((4, 3, 2),), True), (((4, 3, 2),), False)):
        values = PPOHyperparams(conv_filters=filters)
        for program in (
            stable_baselines3_program(values, env_id="E", env_args={}, num_env_steps=64, flattens=flattens),
            rllib_program(values, env_id="E", env_args={}, flattens=flattens),
        ):
            assert (told in program.notes) is (filters is not None and flattens)
            assert ("FlattenObservation" in program.code) is (filters is None and flattens)
            of_dicts = any("MultiInputPolicy" in note for note in program.notes)
            assert of_dicts is (told in program.notes and "stable_baselines3" in program.code)


def programs_of_a_report(**record: Any) -> list[next_steps.Step]:
    """Those for other libraries, of a sweep whose record says so."""
    made = make_sweep()
    made.sweep = made.sweep.model_copy(update=record)
    best = setting(0, [made.trials[0].trial_id], 1)
    steps = next_steps.section(source_of(made, settings_of(best))).steps
    programs = [step for step in steps if step.title.startswith("The setting in ")]
    assert len(programs) == 2
    return programs


@pytest.mark.parametrize("flattened", [False, True])
def test_the_programs_of_a_report_take_the_envs_observations(flattened: bool) -> None:
    programs = programs_of_a_report(is_flattened=flattened)
    assert ["FlattenObservation" in program.text for program in programs] == [flattened] * 2


def test_a_sweeps_record_says_whether_observations_are_made_vectors(tmp_path: Path) -> None:
    for env_id, flattened in (("CartPole-v1", False), ("FrozenLake-v1", True)):
        store = make_sweep_folder(tmp_path / env_id, env=env_id)
        assert store.read_record().is_flattened is flattened


@pytest.mark.parametrize("masked", [False, True])
def test_the_programs_of_a_report_say_that_they_know_no_mask(masked: bool) -> None:
    programs = programs_of_a_report(is_masked=masked)
    assert ["MaskablePPO" in program.why for program in programs] == [masked] * 2


def test_a_sweeps_record_says_whether_actions_are_masked(tmp_path: Path) -> None:
    for mask in (False, True):
        store = make_sweep_folder(tmp_path / str(mask), env={"id": "Taxi-v3", "action_mask": mask})
        assert store.read_record().is_masked is mask
