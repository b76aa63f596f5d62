"""ArrayEnvRunner gives the episodes that RLlib's own runner gives, to the last bit."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from policies.envs import modules
from policies.errors import EnvError
from policies.hyperparams import Algorithm, DQNHyperparams, PPOHyperparams

if TYPE_CHECKING:
    from policies.rllib.env_runner import ArrayEnvRunner

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

SEED = 5 * 1024
MODULE = "default_policy"
# (env id, env args, num_envs, how RLlib makes its vector env). Fragments end in the middle of episodes in all of them.
ENVS: dict[str, tuple[str, dict[str, Any], int, str]] = {
    "cartpole": ("CartPole-v1", {}, 4, "vector_entry_point"),
    "cartpole-one": ("CartPole-v1", {"sutton_barto_reward": True}, 1, "vector_entry_point"),
    "pendulum": ("Pendulum-v1", {}, 3, "sync"),
    "acrobot-truncated": ("Acrobot-v1", {"max_episode_steps": 9}, 3, "sync"),
    "ticks": ("TestTicks-v0", {"end": 4}, 3, "sync"),
}
CASES = [pytest.param("ppo", env, id=env) for env in ENVS]


@pytest.fixture(autouse=True)
def _nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What other tests of this process allowed would be among the env's arguments, which RLlib's runner hands on."""
    monkeypatch.setattr(modules, "_allowed", set())


def make_config(algorithm: Algorithm, env: str) -> Any:
    from policies.rllib.config import build_algorithm_config

    env_id, env_args, num_envs, _ = ENVS[env]
    kwargs = {"hidden_sizes": (16,), "activation": "tanh", "num_envs": num_envs}
    hyperparams = (
        PPOHyperparams(**kwargs)
        if algorithm == "ppo"
        else DQNHyperparams(**kwargs, epsilon_initial=0.5, epsilon_final=0.5, gamma=0.5)
    )
    return build_algorithm_config(hyperparams, env_id=env_id, env_args=env_args, seed=SEED)


def make_runners(algorithm: Algorithm, env: str) -> tuple[ArrayEnvRunner, Any]:
    """(ours, RLlib's), with the same weights and seeds."""
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    from policies.rllib.env_runner import ArrayEnvRunner

    config = make_config(algorithm, env)
    ours = ArrayEnvRunner(config=config, worker_index=0)
    theirs_config = config.copy(copy_frozen=False).env_runners(
        env_runner_cls=SingleAgentEnvRunner, gym_env_vectorize_mode=ENVS[env][3]
    )
    if env == "ticks":
        # RLlib sends 0, 1, 2 whatever the space's start is; the env would refuse them.
        theirs_config = theirs_config.environment(env_config={**ENVS[env][1], "start": 0})
    theirs = SingleAgentEnvRunner(config=theirs_config, worker_index=0)
    theirs.module.set_state(ours.module.get_state())
    return ours, theirs


def sample(runner: Any, sizes: Sequence[int], **kwargs: Any) -> list[Any]:
    """Episode lists of several fragments, with the exploration of one seed."""
    torch.manual_seed(1)
    fragments = []
    for size in sizes:
        fragments.append(runner.sample(num_timesteps=size, **kwargs))
        # As Algorithm does between two fragments: the count moves epsilon on.
        runner.num_env_steps_sampled_lifetime += sum(len(chunk) for chunk in fragments[-1])
        runner.get_metrics()
    return fragments


def by_stream(episodes: Sequence[Any], ids: dict[str, int]) -> list[tuple[int, Any]]:
    """Episodes with ids replaced by numbers in order of first sight: ids are random."""
    return [(ids.setdefault(episode.id_, len(ids)), episode) for episode in episodes]


def assert_equal_episodes(ours: Any, theirs: Any) -> None:
    # The whole object, lookback included: what the learner can see of it.
    assert ours.t_started == theirs.t_started
    assert len(ours) == len(theirs)
    assert (ours.is_terminated, ours.is_truncated) == (theirs.is_terminated, theirs.is_truncated)
    assert set(ours.extra_model_outputs) == set(theirs.extra_model_outputs)
    pairs = {
        "observations": (ours.observations, theirs.observations),
        "actions": (ours.actions, theirs.actions),
        "rewards": (ours.rewards, theirs.rewards),
    } | {key: (ours.extra_model_outputs[key], theirs.extra_model_outputs[key]) for key in ours.extra_model_outputs}
    for name, (mine, other) in pairs.items():
        assert mine.lookback == other.lookback, name
        rows, other_rows = np.asarray(mine.data), np.asarray(other.data)
        assert rows.shape == other_rows.shape, name
        # RLlib turns discrete actions into int32 on the way; the learner takes any whole numbers.
        kinds = (rows.dtype, other_rows.dtype)
        assert rows.dtype == other_rows.dtype or kinds == (np.dtype(np.int64), np.dtype(np.int32)), name
        np.testing.assert_array_equal(rows, other_rows, err_msg=name)
    assert len(ours.infos.data) == len(theirs.infos.data)


@pytest.mark.parametrize(("algorithm", "env"), CASES)
def test_episodes_are_those_of_rllibs_runner(algorithm: Algorithm, env: str) -> None:
    # Sizes that are no multiples of the sub-environments, one of less than an episode, one of a single step.
    sizes = [50, 1, 33, 64, 7]
    ours, theirs = make_runners(algorithm, env)
    mine, others = sample(ours, sizes, explore=True), sample(theirs, sizes, explore=True)
    my_ids: dict[str, int] = {}
    other_ids: dict[str, int] = {}
    num_ended = num_continued = 0
    for fragment, (my_list, other_list) in enumerate(zip(mine, others, strict=True)):
        my_pairs, other_pairs = by_stream(my_list, my_ids), by_stream(other_list, other_ids)
        # Equal numbers: the same chunks belong to one episode, in the same order.
        assert [number for number, _ in my_pairs] == [number for number, _ in other_pairs], fragment
        for (_, my_episode), (_, other_episode) in zip(my_pairs, other_pairs, strict=True):
            assert_equal_episodes(my_episode, other_episode)
            num_ended += my_episode.is_done
            num_continued += my_episode.t_started > 0
    # The case would prove nothing if no episode ended in, or went on over, a fragment.
    assert num_continued > 0
    assert num_ended > 0 or env == "pendulum"  # 200 steps an episode
    assert ours.num_env_steps_sampled_lifetime == theirs.num_env_steps_sampled_lifetime


def test_greedy_sampling_too() -> None:
    ours, theirs = make_runners("ppo", "pendulum")
    mine, others = (sample(runner, [20, 30], explore=False) for runner in (ours, theirs))
    for my_list, other_list in zip(mine, others, strict=True):
        for my_episode, other_episode in zip(my_list, other_list, strict=True):
            # Nothing is learned from greedy episodes, so their probabilities are left out.
            assert not np.any(other_episode.extra_model_outputs.pop("action_logp").data)
            assert_equal_episodes(my_episode, other_episode)


def test_random_actions_are_refused() -> None:
    ours, _ = make_runners("ppo", "ticks")
    with pytest.raises(ValueError, match="random actions"):
        ours.sample(num_timesteps=10, random_actions=True)


@pytest.mark.parametrize(("algorithm", "env"), CASES)
def test_the_batches_that_reach_the_learner_are_equal(algorithm: Algorithm, env: str) -> None:
    """Both episode lists through the Algorithm's own learner connector, over two fragments."""
    config = make_config(algorithm, env)
    algo = config.build_algo()
    learner = algo.learner_group._learner
    sizes = [60, 40]
    ours, theirs = make_runners(algorithm, env)
    weights = learner.module[MODULE].get_state(inference_only=True)
    for runner in (ours, theirs):
        runner.module.set_state(weights)
    mine, others = sample(ours, sizes, explore=True), sample(theirs, sizes, explore=True)
    for my_list, other_list in zip(mine, others, strict=True):
        my_batch, other_batch = (train_batch(algo, algorithm, episodes) for episodes in (my_list, other_list))
        assert set(my_batch) == set(other_batch)
        for column, value in my_batch.items():
            np.testing.assert_array_equal(np.asarray(value), np.asarray(other_batch[column]), err_msg=column)
    expected = {"advantages", "value_targets", "action_logp"}
    assert expected <= set(my_batch)
    algo.stop()


def train_batch(algo: Any, algorithm: Algorithm, episodes: Sequence[Any]) -> dict[str, Any]:
    """The batch of one module that the loss is computed from."""
    from ray.rllib.core.learner.training_data import TrainingData

    learner = algo.learner_group._learner
    return dict(learner._make_batch_if_necessary(TrainingData(episodes=episodes))[MODULE])


@pytest.mark.parametrize("env", [env for env in ENVS if env != "pendulum"])
def test_transitions_for_replay_are_those_of_rllibs_episodes(env: str) -> None:
    """Equal seeds, equal weights: each step that RLlib's runner put into an episode, once, and nothing else."""
    sizes = [50, 1, 33, 64, 7]
    ours, theirs = make_runners("dqn", env)
    expected = []
    for fragment in sample(theirs, sizes, explore=True):
        for episode in fragment:
            obs, actions, rewards = episode.get_observations(), episode.get_actions(), episode.get_rewards()
            for step in range(len(episode)):
                last = step == len(episode) - 1 and episode.is_terminated
                row = (*obs[step], actions[step], rewards[step], *obs[step + 1], 0.0 if last else 0.5)
                expected.append(tuple(np.float32(value) for value in row))
    torch.manual_seed(1)
    found, num_steps, num_episodes = [], 0, 0
    for size in sizes:
        drawn = ours.sample_transitions(size, num_env_steps=num_steps, num_episodes=num_episodes)
        num_steps, num_episodes = num_steps + drawn.num_env_steps, num_episodes + drawn.num_episodes
        rows = drawn.transitions
        columns = (rows.obs, rows.actions[:, None], rows.rewards[:, None], rows.next_obs, rows.discounts[:, None])
        found += [tuple(row) for row in np.concatenate(columns, axis=1, dtype=np.float32)]
    assert sorted(found) == sorted(expected)
    assert num_steps == len(expected)
    whole = ours.pop_finished_episodes()
    assert len(whole) == num_episodes > 0
    assert sum(length for _, length in whole) <= num_steps
    # A second runner, sampled as PPO samples: the same whole episodes.
    others, _ = make_runners("dqn", env)
    sample(others, sizes, explore=True)
    assert np.array(sorted(others.pop_finished_episodes())) == pytest.approx(np.array(sorted(whole)))


def test_epsilon_is_the_share_of_random_actions() -> None:
    ours, _ = make_runners("dqn", "cartpole")
    with torch.no_grad():
        for name, weight in ours.module.named_parameters():
            if name.startswith("af"):
                # Action 0 is always the greedy one.
                weight.copy_(torch.tensor([1.0, 0.0]) if weight.ndim == 1 else torch.zeros_like(weight))
    torch.manual_seed(0)
    actions = ours.sample_transitions(6_000, num_env_steps=0, num_episodes=0).transitions.actions
    # Half the actions are random, half of those differ from the greedy one; the standard deviation is 0.006.
    assert np.mean(actions == 1) == pytest.approx(0.25, abs=0.03)


def test_no_transition_leads_from_the_end_of_an_episode_to_the_start_of_the_next() -> None:
    """The env counts: within an episode, each observation has one tick more than the one before."""
    ours, _ = make_runners("ppo", "ticks")
    num_ends = 0
    for fragment in sample(ours, [40, 40, 40], explore=True):
        for chunk in fragment:
            ticks, episode, stream = chunk.get_observations().T
            assert list(np.diff(ticks)) == [1.0] * (len(ticks) - 1)
            assert len(set(episode)) == 1
            assert len(set(stream)) == 1
            assert ticks[0] == chunk.t_started
            np.testing.assert_allclose(chunk.get_rewards(), ticks[1:] + episode[1:] / 1000, rtol=1e-6)
            # 7 is the time limit; the env itself ends after 4, 5 or 6 steps.
            num_ends += chunk.is_terminated
            assert chunk.is_terminated == (ticks[-1] >= 4 + episode[-1] % 3)
    assert num_ends > 10


def test_every_env_step_is_in_exactly_one_chunk() -> None:
    ours, _ = make_runners("ppo", "ticks")
    seen = []
    num_steps = 0
    for fragment in sample(ours, [13, 1, 29, 5], explore=True):
        for chunk in fragment:
            _, episode, stream = chunk.get_observations(0)
            seen += [(stream, episode, chunk.t_started + step) for step in range(len(chunk))]
            num_steps += len(chunk)
    assert len(set(seen)) == len(seen) == num_steps == ours.num_env_steps_sampled_lifetime
    # No gaps: of each episode of each sub-environment, steps 0 to the last one.
    last_steps: dict[tuple[float, float], int] = {}
    for stream, episode, step in seen:
        last_steps[stream, episode] = max(step, last_steps.get((stream, episode), 0))
    assert len(seen) == sum(last + 1 for last in last_steps.values())


def test_returns_are_of_whole_episodes_over_fragment_boundaries() -> None:
    """Fragments of 5 vector steps, episodes of 4 to 7: nearly all are cut. RLlib's own count sees the chunks."""
    ours, _ = make_runners("ppo", "ticks")
    finished = []
    for _ in range(12):
        ours.sample(num_timesteps=15, explore=True)
        finished += ours.pop_finished_episodes()
    assert ours.pop_finished_episodes() == []
    # end 4, plus 0, 1 or 2 by the number of the episode, whose number is in the rewards.
    assert len(finished) > 15
    for episode_return, length in finished:
        assert isinstance(length, int)
        assert length in {4, 5, 6}
        number = (episode_return - length * (length + 1) / 2) / length * 1000
        assert number == pytest.approx(round(number), abs=0.05)
        assert length == 4 + round(number) % 3


def test_episodes_are_counted_in_the_order_of_their_ends() -> None:
    """Or the last 100 of an iteration with more would be those of the last sub-environments, early ones among them."""
    ours, _ = make_runners("ppo", "ticks")
    chunks = ours.sample(num_timesteps=90, explore=True)
    returns = [chunk.get_rewards().sum() for chunk in chunks if chunk.is_done]
    assert [total for total, _ in ours.pop_finished_episodes()] == pytest.approx(returns)
    numbers = [chunk.get_observations(0)[1] for chunk in chunks if chunk.is_done]
    assert numbers == sorted(numbers)


def test_truncated_episodes_are_whole_too() -> None:
    ours, _ = make_runners("ppo", "acrobot-truncated")
    for _ in range(8):
        ours.sample(num_timesteps=12, explore=True)
    finished = ours.pop_finished_episodes()
    assert len(finished) >= 6
    assert set(finished) == {(-9.0, 9)}


def test_a_reset_on_request_drops_the_running_episodes() -> None:
    ours, _ = make_runners("ppo", "ticks")
    ours.sample(num_timesteps=8, explore=True)
    ours.pop_finished_episodes()
    chunks = ours.sample(num_timesteps=9, explore=True, force_reset=True)
    assert [chunk.t_started for chunk in chunks] == [0, 0, 0]
    assert all(chunk.observations.lookback == 0 for chunk in chunks)


def test_whole_episodes_can_be_asked_for() -> None:
    ours, _ = make_runners("ppo", "cartpole")
    episodes = ours.sample(num_episodes=3, explore=True)
    assert len(episodes) == 3
    assert all(episode.is_done and episode.t_started == 0 for episode in episodes)


def test_seeds_make_the_episodes() -> None:
    def observations(**reseed: int) -> NDArray[Any]:
        ours, _ = make_runners("ppo", "cartpole")
        for value in reseed.values():
            ours.reseed(value)
        return np.concatenate([chunk.get_observations() for chunk in sample(ours, [40], explore=True)[0]])

    first = observations()
    np.testing.assert_array_equal(first, observations())
    np.testing.assert_array_equal(first, observations(seed=SEED))
    assert not np.array_equal(first[0], observations(seed=SEED + 1)[0])


def test_neighbouring_env_runners_share_no_environment_seed() -> None:
    """RLlib gives worker w, sub-environment i the seed s + w + i: worker 2's first is worker 1's second."""
    from policies.rllib.env_runner import ArrayEnvRunner

    config = make_config("ppo", "ticks").env_runners(num_env_runners=2)
    streams = []
    for worker_index in (1, 2):
        runner = ArrayEnvRunner(config=config, worker_index=worker_index)
        streams += [chunk.get_observations(0)[2] for chunk in runner.sample(num_timesteps=6, explore=True)]
    assert len(set(streams)) == len(streams) == 6
    # Made in a user's own process, as here, it does not tie that to the process's parent.
    assert "end with parent" not in [thread.name for thread in threading.enumerate()]


def test_what_the_environment_raises_is_raised() -> None:
    from policies.rllib.config import build_algorithm_config
    from policies.rllib.env_runner import ArrayEnvRunner

    env_args = {"troubles": {str(SEED): {"how": "raise", "at": 5}}}
    config = build_algorithm_config(PPOHyperparams(num_envs=2), env_id="TestTrouble-v0", env_args=env_args, seed=SEED)
    runner = ArrayEnvRunner(config=config, worker_index=0)
    words = r"TestTrouble-v0 raised an error in step\(\): ZeroDivisionError: the cart left the track"
    with pytest.raises(EnvError, match=words) as caught:
        runner.sample(num_timesteps=40, explore=True)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
