"""An RLlib EnvRunner that collects arrays and builds episodes once per fragment.

RLlib's own `SingleAgentEnvRunner` runs two connector pipelines and appends to one Python episode object per
sub-environment at every step; with small networks that is two thirds of a PPO iteration. The default pipelines only
copy Box observations, so this runner steps arrays and cuts them into `SingleAgentEpisode`s when the fragment is done.
The episodes are those that RLlib's runner would return: a test compares the two on equal seeds.

Array shapes: T vector steps, N sub-environments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from gymnasium.wrappers.vector import DictInfoToList
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

from policies.envs.action_bounds import ToBounds
from policies.envs.checked import CheckedEnvs
from policies.envs.make import ALLOWED_MODULES, ATARI_TRAINING, FAILURE_PENALTY, MODULE_FOLDERS, make_vector_env
from policies.envs.modules import allow_modules, look_in
from policies.envs.spaces import observation_dtype
from policies.envs.training_view import TrainingView
from policies.networks.own_modules import check_stateless
from policies.parents import end_with_parent
from policies.replay import NStep, Transitions
from policies.rllib.ruined import check_outputs
from policies.rllib.runner_errors import TellsErrors
from policies.rllib.streams import OWN_ENDS, OWN_REWARDS, Part, Stream, own_ends_of, own_rewards_of

_WEIGHTS_SEQ_NO = "weights_seq_no"
_REWARDS_SPACE = gym.spaces.Box(float("-inf"), float("inf"), (), np.float32)


@dataclass(frozen=True, eq=False)
class Sample:
    """The result of `ArrayEnvRunner.sample_transitions`."""

    transitions: Transitions
    observations: NDArray[Any]
    """The observations that were acted on, shape (B, ...); transitions of several steps are complete only later."""
    num_env_steps: int
    episodes: tuple[tuple[float, int], ...]
    """(undiscounted return, env steps) of each episode that ended."""

    @property
    def num_episodes(self) -> int:
        """The number of episodes that ended."""
        return len(self.episodes)


def _checked(env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Return a vector environment whose values are checked; what training alone sees stays the outermost wrapper."""
    if not isinstance(env, TrainingView):
        return CheckedEnvs(env, env_id)
    env.env = CheckedEnvs(env.env, env_id)
    return env


def _is_actor() -> bool:
    """Whether Ray started this process for an actor; otherwise it is a user's own."""
    return ray.is_initialized() and ray.get_runtime_context().get_actor_id() is not None


class ArrayEnvRunner(TellsErrors, SingleAgentEnvRunner):  # type: ignore[misc]
    """Samples fragments of (T, N) arrays; Box observations, flat or images, actions of the kinds that policies give.

    `finished_episodes` gathers (return, length) of every whole episode, over fragment boundaries, until
    `pop_finished_episodes` takes them: RLlib's own mean covers only the episodes of one iteration.
    """

    def __init__(self, **kwargs: Any) -> None:
        self.env: Any = None
        self.finished_episodes: list[tuple[float, int]] = []
        self._streams: list[Stream] = []
        self._obs: NDArray[Any] | None = None
        self._seed_override: int | None = None
        self._just_ended: NDArray[np.bool_] | None = None
        self._n_step: NStep | None = None
        if kwargs.get("worker_index", 0) and _is_actor():
            # This process must not outlive the Ray that started it, whatever its env does.
            end_with_parent()
        super().__init__(**kwargs)

    def pop_finished_episodes(self) -> list[tuple[float, int]]:
        """Return and forget (undiscounted return, env steps) of the episodes that ended since the last call."""
        finished, self.finished_episodes = self.finished_episodes, []
        return finished

    def reseed(self, seed: int) -> None:
        """Continue with other random numbers: new episodes from the next fragment on, and new exploration.

        The main process seeds its own exploration; env runners in other processes seed theirs here.
        """
        self._seed_override = seed
        if self.worker_index:
            torch.manual_seed(seed + self.worker_index)
        self._needs_initial_reset = True

    def make_env(self) -> None:
        """Create the vector env: vectorised physics where the env has it, else many scalar envs in this process."""
        if self.env is not None:
            self.env.close()
        env_args = dict(self.config.env_config)
        if isinstance(self.config.env_config, EnvContext):
            env_args = dict(self.config.env_config.items())
        # The settings that build_algorithm_config adds beside the env's arguments.
        look_in(env_args.pop(MODULE_FOLDERS, ()))
        allow_modules(env_args.pop(ALLOWED_MODULES, ()))
        penalty, atari_training = env_args.pop(FAILURE_PENALTY, None), env_args.pop(ATARI_TRAINING, None)
        num_envs = self.config.num_envs_per_env_runner
        env = make_vector_env(
            self.config.env, env_args, num_envs, failure_penalty=penalty, atari_training=atari_training
        )
        self.env = DictInfoToList(_checked(env, self.config.env))
        self.num_envs = self.env.num_envs
        space = self.env.single_action_space
        self._to_bounds = ToBounds(space) if isinstance(space, gym.spaces.Box) else None
        self._needs_initial_reset = True

    def make_module(self) -> None:
        """Build the module; see `check_stateless`."""
        super().make_module()
        if self.module is not None:  # RLlib leaves it out where it is not implemented, and the learner says so
            check_stateless(self.module)

    def _reset_arrays(self) -> None:
        """Reset every sub-environment; seeded the first time only, as RLlib does.

        Sub-environment i of worker w gets seed + w * N + i: RLlib's seed + w + i would let neighbouring workers
        share streams.
        """
        seed = None
        base = self.config.seed if self._seed_override is None else self._seed_override
        if self._needs_initial_reset and base is not None:
            seed = int(base) + max(0, (self.worker_index or 0) - 1) * self.num_envs
        observations, _ = self.env.env.reset(seed=seed)
        self._obs = self._as_seen(observations)
        self._just_ended = np.zeros(self.num_envs, dtype=np.bool_)
        self._streams = [Stream() for _ in range(self.num_envs)]
        if self._n_step is not None:
            self._n_step.forget()
        # Drop the chunks of episodes that will never end now.
        self._ongoing_episodes_for_metrics.clear()
        self._needs_initial_reset = False

    def _sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool,
        random_actions: bool = False,
        force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:
        if random_actions:
            # PPO and DQN never ask for random actions.
            raise ValueError("ArrayEnvRunner samples with the policy only, not with random actions")
        if num_timesteps is None:
            # Whole episodes are asked for rarely, and RLlib's own way resets the envs anyway.
            episodes: list[SingleAgentEpisode] = super()._sample(num_episodes=num_episodes, explore=explore)
            return episodes
        if force_reset or self._needs_initial_reset or self._obs is None:
            self._reset_arrays()
        # The count is that of all env runners, in whole rounds of them, as RLlib has it.
        num_runners = self.config.num_env_runners or 1
        before = self.num_env_steps_sampled_lifetime // num_runners * num_runners
        fragment = self._collect(num_timesteps, explore=explore, num_env_steps=before)
        done, ongoing = self._cut(fragment)
        self._done_episodes_for_metrics.extend(done)
        for episode in ongoing:
            self._ongoing_episodes_for_metrics[episode.id_].append(Part(episode))
        num_steps = int(fragment["stepped"].sum())
        self._log_env_steps(metric=self._metrics_num_env_steps_sampled, num_steps=num_steps)
        self._increase_sampled_metrics(num_steps, len(done))
        return done + ongoing

    def sample_transitions(self, num_timesteps: int, *, num_env_steps: int, num_episodes: int) -> Sample:
        """Explore for at least `num_timesteps` env steps and return transitions, without episode objects.

        This is for DQN; the config must hold `hyperparams`.

        Args:
            num_timesteps: Env steps to make.
            num_env_steps: Env steps of the trial so far, over all env runners; epsilon may depend on them.
            num_episodes: Whole episodes of the trial so far, over all env runners; epsilon may depend on them.
        """
        if self._needs_initial_reset or self._obs is None:
            self._reset_arrays()
        if self._n_step is None:
            hyperparams = self.config.hyperparams
            self._n_step = NStep(self.num_envs, hyperparams.n_step, hyperparams.gamma)
        fragment = self._collect(num_timesteps, explore=True, num_env_steps=num_env_steps, num_episodes=num_episodes)
        before = len(self.finished_episodes)
        self._follow_episodes(fragment)
        transitions = self._n_step.transitions(fragment)
        is_whole = self.config.hyperparams.n_step == 1  # then it is the transitions' own array, sent once
        return Sample(
            transitions=transitions,
            observations=transitions.obs if is_whole else fragment["obs"][:-1][fragment["stepped"]],
            num_env_steps=int(fragment["stepped"].sum()),
            episodes=tuple(self.finished_episodes[before:]),
        )

    def _follow_episodes(self, fragment: dict[str, NDArray[Any]]) -> None:
        """Collect the returns of whole episodes, as `_cut` does for episode objects."""
        stepped = fragment["stepped"]
        rewards = np.where(stepped, own_rewards_of(fragment), 0.0)
        ended = own_ends_of(fragment)
        for index, stream in enumerate(self._streams):
            start = 0
            for stop in [*(np.flatnonzero(ended[:, index]) + 1), len(rewards)]:
                stream.num_steps += int(stepped[start:stop, index].sum())
                stream.episode_return += float(rewards[start:stop, index].sum(dtype=np.float64))
                if stop > start and ended[stop - 1, index]:
                    self.finished_episodes.append((stream.episode_return, stream.num_steps))
                    stream.start()
                start = stop

    def _collect(
        self, num_timesteps: int, *, explore: bool, num_env_steps: int = 0, num_episodes: int = 0
    ) -> dict[str, NDArray[Any]]:
        """Step until at least `num_timesteps` env steps are made, and return columns of shape (T, N, ...).

        Args:
            num_timesteps: Env steps to make.
            explore: Whether to explore, or to act greedily.
            num_env_steps: Env steps of the trial so far, for exploration schedules that count them.
            num_episodes: Whole episodes of the trial so far, for those that count episodes.

        Raises:
            Exception: Whatever the environment's step raises.
        """
        self.check_failure()
        assert self._obs is not None  # set by _reset_arrays
        assert self._just_ended is not None
        env = self.env.env
        num_runners = self.config.num_env_runners or 1
        by_episode = getattr(self.module, "epsilon_unit", None) == "episode"
        self.module.eval()
        rows: dict[str, list[NDArray[Any]]] = {"obs": [self._obs]}
        num_steps = num_ended = 0
        with torch.no_grad():
            while num_steps < num_timesteps:
                # The other env runners make steps and end episodes at about the same rate.
                units = (
                    num_episodes + num_ended * num_runners if by_episode else num_env_steps + num_steps * num_runners
                )
                row = self._actions(self._obs, explore=explore, num_units=units)
                to_env = self._for_env(row[Columns.ACTIONS])
                observations, rewards, terminated, truncated, _ = env.step(to_env)
                self._obs = self._as_seen(observations)
                row |= {
                    "rewards": rewards,
                    "terminated": terminated,
                    "truncated": truncated,
                    "stepped": ~self._just_ended,
                }
                if isinstance(env, TrainingView):
                    row[OWN_REWARDS] = env.own_rewards
                    if env.lost_lives is not None:
                        row[OWN_ENDS] = np.logical_or(terminated, truncated)
                        row["terminated"] = np.logical_or(terminated, env.lost_lives)
                # NEXT_STEP autoreset: the step after an episode's last one only resets; it is no env step.
                num_steps += int(row["stepped"].sum())
                self._just_ended = np.logical_or(terminated, truncated)
                num_ended += int(self._just_ended.sum())
                for key, value in row.items():
                    rows.setdefault(key, []).append(value)
                rows["obs"].append(self._obs)
        return {key: np.stack(values) for key, values in rows.items()}

    def _as_seen(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Return observations in the precision that networks and replay memories use, whatever the env's is."""
        return np.asarray(observations, dtype=observation_dtype(self.env.single_observation_space))

    def _actions(self, obs: NDArray[Any], *, explore: bool, num_units: int) -> dict[str, NDArray[Any]]:
        """Make one forward pass and return the actions and what RLlib's learner needs with them, each (N, ...)."""
        batch = {Columns.OBS: torch.from_numpy(np.ascontiguousarray(obs)).to(self._device)}
        # `forward_exploration` would walk the module tree twice a step to switch between eval and train mode, but this
        # runner's module stays in eval mode.
        module = self.module
        out = module._forward_exploration(batch, t=num_units) if explore else module._forward_inference(batch)  # noqa: SLF001
        if Columns.ACTIONS not in out:
            try:
                self._draw(out, explore=explore)
            except (ValueError, RuntimeError):
                # A distribution's: what it says of its parameters names no cause.
                check_outputs(out[Columns.ACTION_DIST_INPUTS], module)
                raise
        return {key: value.cpu().numpy() for key, value in out.items()}

    def _draw(self, out: dict[str, torch.Tensor], *, explore: bool) -> None:
        """Draw actions from a policy's outputs, or take the likeliest."""
        which = "exploration" if explore else "inference"
        dist = getattr(self.module, f"get_{which}_action_dist_cls")().from_logits(out[Columns.ACTION_DIST_INPUTS])
        if not explore:
            dist = dist.to_deterministic()
        out[Columns.ACTIONS] = dist.sample()
        if explore:
            out[Columns.ACTION_LOGP] = dist.logp(out[Columns.ACTIONS])

    def _for_env(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return actions as the env takes them, which it may write into; the stored ones stay as they were drawn."""
        if self._to_bounds is None:
            space = self.env.single_action_space
            # The network's outputs count from 0; RLlib itself ignores that a space may start elsewhere.
            start = space.start if isinstance(space, gym.spaces.Discrete) else 0
            return actions + start
        return self._to_bounds(actions)

    def _try_env_step(self, actions: Any) -> Any:
        """Correct RLlib's actions and step the env; RLlib calls this where whole episodes are asked for.

        RLlib's own pipeline, which these actions come from, ignores the start of a Discrete space, and sends an action
        of a Box unchanged if a bound is infinite or its precision uncommon.
        """
        is_done = self._to_bounds is not None and self._to_bounds.stretches_all
        if not is_done or self.env.single_action_space.dtype not in (np.float32, np.float64):
            actions = self._for_env(np.asarray(actions))
        return super()._try_env_step(actions)

    def _cut(self, fragment: dict[str, NDArray[Any]]) -> tuple[list[SingleAgentEpisode], list[SingleAgentEpisode]]:
        """Cut (T, N) columns into episode chunks: the ended ones in order of their end, then the running ones."""
        done: list[tuple[int, int, SingleAgentEpisode, tuple[float, int] | None]] = []
        ongoing: list[SingleAgentEpisode] = []
        length = len(fragment["stepped"])
        ended, own_ends = np.logical_or(fragment["terminated"], fragment["truncated"]), own_ends_of(fragment)
        for index, stream in enumerate(self._streams):
            start = 0
            for end in np.flatnonzero(ended[:, index]):
                start += not fragment["stepped"][start, index]
                chunk = self._chunk(fragment, stream, index, start, int(end) + 1)
                is_whole = own_ends[end, index]
                done.append((int(end), index, chunk, (stream.episode_return, stream.num_steps) if is_whole else None))
                if is_whole:
                    stream.start()
                else:
                    stream.start_next_life()
                start = int(end) + 1
            if start < length:
                start += not fragment["stepped"][start, index]
            if start < length:
                chunk = self._chunk(fragment, stream, index, start, length)
                ongoing.append(chunk)
                stream.keep_tail(chunk, int(self.config.episode_lookback_horizon))
        done.sort(key=lambda item: item[:2])
        self.finished_episodes.extend(whole for *_, whole in done if whole is not None)
        return [chunk for _, _, chunk, _ in done], ongoing

    def _chunk(
        self, fragment: dict[str, NDArray[Any]], stream: Stream, index: int, start: int, stop: int
    ) -> SingleAgentEpisode:
        """Return the steps [start, stop) of one sub-environment as an episode chunk, with the last chunk's lookback."""
        columns = {
            key: values[start : stop + (key == "obs"), index]
            for key, values in fragment.items()
            if key not in ("stepped", "terminated", "truncated", OWN_REWARDS, OWN_ENDS)
        }
        num_steps = stop - start
        columns[_WEIGHTS_SEQ_NO] = np.full(num_steps, self._weights_seq_no, dtype=np.int64)
        lookback = len(stream.tail.get("rewards", ()))
        if lookback:
            columns = {key: np.concatenate([stream.tail[key], values]) for key, values in columns.items()}
        obs = columns.pop("obs")
        actions, rewards = columns.pop(Columns.ACTIONS), columns.pop("rewards")
        space, action_space = self.env.single_observation_space, self.env.single_action_space
        episode = SingleAgentEpisode(
            id_=stream.episode_id,
            observations=InfiniteLookbackBuffer(obs, lookback, space),
            observation_space=space,
            infos=InfiniteLookbackBuffer([{}] * len(obs), lookback),
            actions=InfiniteLookbackBuffer(actions, lookback, action_space),
            action_space=action_space,
            rewards=InfiniteLookbackBuffer(rewards, lookback, _REWARDS_SPACE),
            extra_model_outputs={key: InfiniteLookbackBuffer(values, lookback) for key, values in columns.items()},
            terminated=bool(fragment["terminated"][stop - 1, index]),
            truncated=bool(fragment["truncated"][stop - 1, index]),
            t_started=stream.num_learner_steps,
            len_lookback_buffer=lookback,
        )
        stream.num_steps += num_steps
        stream.num_learner_steps += num_steps
        stream.episode_return += float(own_rewards_of(fragment)[start:stop, index].sum(dtype=np.float64))
        return episode
