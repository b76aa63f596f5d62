"""Seeded greedy episodes of any policy.

Episode i is exactly this: `env.reset(seed=seeds[i])`, then greedy actions until the episode terminates, is truncated or
reaches the cap on its steps. Its return and length depend on nothing else: neither on the episodes evaluated beside it
nor on their order, so the same seed gives the same episode in a trial, on the command line and in a video.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, Self, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.acting.classic_players import CartPolePlayer, RowsPlayer, Starts
from policies.acting.policy import Action, NetworkPolicy, Policy
from policies.acting.running import Running, step_together
from policies.envs import calls
from policies.envs.classic_rows import ClassicRows
from policies.envs.faults import close_env
from policies.envs.flat import FlatBox
from policies.envs.make import make_env
from policies.envs.masks import MaskedBox
from policies.envs.own_actions import Choices, Numbers
from policies.envs.own_process import OWN_PROCESS
from policies.envs.together import stepper_of
from policies.errors import EnvError, EnvFailedError, SpecError

EndedBy = Literal["terminated", "truncated", "cap"]
"""How an episode ended: in a state that ends it, by a limit of the env, or at the cap on its steps."""

MAX_EPISODE_STEPS = 10_000
"""The cap for an env without a time limit."""
MAX_ENVS = 16
"""The most environments that are open at once, so that networks get batches."""
_MAX_PROCESSES = 4
"""The same of envs that are in processes of their own: starting one takes longer than batches gain."""
_KINDS = (MaskedBox, FlatBox, Numbers, gym.spaces.Box, gym.spaces.Discrete)
"""The spaces of which an env may have classes of its own, behind those made here, which are Boxes too."""


@dataclass(frozen=True)
class Episodes:
    """Episodes in the order of their seeds."""

    seeds: tuple[int, ...]
    returns: tuple[float, ...]
    """The undiscounted sum of each episode's rewards."""
    lengths: tuple[int, ...]
    """The number of env steps of each episode."""

    @property
    def mean_return(self) -> float:
        """The mean of the episodes' returns."""
        return math.fsum(self.returns) / len(self.returns)


class Moment(NamedTuple):
    """One moment of an episode: after the reset, or after a step."""

    num_env_steps: int
    """Env steps so far."""
    total: float
    """The return so far."""
    observation: NDArray[Any] | None
    """What the policy saw before its action; None after the reset."""
    action: Action | None
    """What it did; None after the reset."""
    ended_by: EndedBy | None
    """How the episode ended; None: it goes on."""

    @property
    def over(self) -> bool:
        """Whether the episode is over."""
        return self.ended_by is not None


@runtime_checkable
class Resettable(Protocol):
    """A policy that draws random numbers; resetting it with each episode's seed makes its episodes reproducible."""

    def reset(self, seed: int) -> None:
        """Seed the policy's random numbers anew."""


class Evaluator:
    """Evaluates policies on fixed seeds, keeping its environments open between calls.

    After an error of one of them all are made anew: a simulator that has ended, say, fails in each further call, and
    the next policy may have nothing to do with it.

    Args:
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seeds: One episode is played for each, in this order; none may be negative.
        max_episode_steps: Cap on the env steps of an episode; None: the env's time limit, or 10,000 if it has
            none.
        max_envs: The most environments that are open at once.

    Raises:
        EnvError: The environment cannot be made.
        SpecError: There are no seeds, or one of them or the cap is out of range.
    """

    def __init__(
        self,
        env_id: str,
        env_args: Mapping[str, Any] | None,
        seeds: Sequence[int],
        *,
        max_episode_steps: int | None = None,
        max_envs: int = MAX_ENVS,
    ) -> None:
        self.seeds = check_seeds(seeds)
        self.env_id, self.env_args = env_id, dict(env_args or {})
        self._max_envs = min(max_envs, _MAX_PROCESSES) if self.env_args.get(OWN_PROCESS) else max_envs
        self._envs = [make_env(env_id, self.env_args)]
        self._are_spent = False
        self.max_episode_steps = episode_cap(self._envs[0], max_episode_steps)
        self._cartpoles = CartPolePlayer.make_if_cartpole(self._envs[0], env_id, self.env_args, self.seeds)
        self._classic = (
            None if self._cartpoles else RowsPlayer.make_if_classic(self._envs[0], env_id, self.env_args, self.seeds)
        )
        stepper = stepper_of(env_id, self.env_args)
        self._stepper = None if stepper is None else calls.watch_steps(stepper)

    @property
    def starts(self) -> Starts | None:
        """The start of each seed's episode in classic control; None for another env or one with wrappers."""
        player = self._cartpoles or self._classic
        return None if player is None else player.starts

    @property
    def rows(self) -> ClassicRows | None:
        """The rows that episodes of classic control are played in, but CartPole's; whoever uses them puts his own."""
        return None if self._classic is None else self._classic.rows

    def check(self, policy: Policy) -> None:
        """Check that a policy can act in this environment.

        Raises:
            NonFiniteWeightsError: A weight is NaN or infinite.
            EnvError: The policy is for other observations or actions, or the environment cannot be made anew.
        """
        if self._are_spent:
            self._close_envs()
            self._envs.append(make_env(self.env_id, self.env_args))
            self._are_spent = False
        check_policy(policy, self._envs[0])

    def run(self, policy: Policy) -> Episodes:
        """Play one greedy episode for each seed.

        Raises:
            NonFiniteWeightsError: The policy's weights are NaN or infinite.
            EnvError: The policy is for other observations or actions, the env raised an error, or it cannot be made
                anew after one.
        """
        self.check(policy)
        try:
            results = self._play(policy)
        except EnvFailedError:
            # Made anew for the next policy, if one comes.
            self._are_spent = True
            raise
        returns, lengths = zip(*results, strict=True)
        return Episodes(self.seeds, returns, lengths)

    def _play(self, policy: Policy) -> list[tuple[float, int]]:
        if isinstance(policy, Resettable):
            # It draws random numbers in the order of its calls, so its episodes must be played one after the other.
            return [self._play_alone(policy, seed) for seed in self.seeds]
        if self._cartpoles is not None:
            return self._cartpoles.play(policy, self.max_episode_steps)
        if self._classic is not None and type(policy) is NetworkPolicy:
            # Another may give actions of other types or outside of their bounds, which is the environment's to judge.
            return self._classic.play(policy, self.max_episode_steps)
        return self._play_side_by_side(policy)

    def close(self) -> None:
        """Close the environments; `run` cannot be called afterwards."""
        self._close_envs()
        if self._classic is not None:
            self._classic.close()
        if self._stepper is not None:
            self._stepper.close()

    def _close_envs(self) -> None:
        while self._envs:
            close_env(self._envs.pop())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _play_alone(self, policy: Policy, seed: int) -> tuple[float, int]:
        return play_episode(policy, self._envs[0], seed, max_episode_steps=self.max_episode_steps)

    def _play_side_by_side(self, policy: Policy) -> list[tuple[float, int]]:
        """Play in several envs at once, so that the network gets batches; an env that is free takes the next seed."""
        while len(self._envs) < min(len(self.seeds), self._max_envs):
            self._envs.append(make_env(self.env_id, self.env_args))
        waiting = deque(enumerate(self.seeds))
        results: dict[int, tuple[float, int]] = {}
        running = [Running(env, *waiting.popleft()) for env in self._envs[: len(self.seeds)]]
        while running:
            actions = policy.act_on_rows(np.stack([episode.observation for episode in running]))
            for episode, has_ended in zip(running, self._step(policy, running, actions), strict=True):
                if has_ended or episode.length >= self.max_episode_steps:
                    results[episode.index] = (episode.total, episode.length)
            ended = [episode for episode in running if episode.index in results]
            running = [episode for episode in running if episode.index not in results]
            running += [Running(episode.env, *waiting.popleft()) for episode in ended if waiting]
        return [results[index] for index in range(len(self.seeds))]

    def _step(self, policy: Policy, running: Sequence[Running], actions: Any) -> list[bool]:
        """Step episodes and return which of them have ended."""
        # Another may give actions of other types or outside of their bounds, which is the environment's to judge.
        if self._stepper is not None and type(policy) is NetworkPolicy:
            return step_together(self._stepper, running, actions)
        return [episode.step(action) for episode, action in zip(running, actions, strict=True)]


def evaluate_policy(
    policy: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seeds: Sequence[int],
    max_episode_steps: int | None = None,
) -> Episodes:
    """Play one greedy episode for each seed.

    Args:
        policy: The policy that acts.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seeds: One episode is played for each, in this order.
        max_episode_steps: Cap on the env steps of an episode; None: the env's time limit, or 10,000 if it has
            none.

    Raises:
        NonFiniteWeightsError: The policy's weights are NaN or infinite.
        EnvError: The environment cannot be made, does not go with the policy, or raised an error.
    """
    with Evaluator(env_id, env_args, seeds, max_episode_steps=max_episode_steps) as evaluator:
        return evaluator.run(policy)


def play_episode(policy: Policy, env: gym.Env[Any, Any], seed: int, *, max_episode_steps: int) -> tuple[float, int]:
    """Play one greedy episode in one environment and return its return and its number of env steps.

    Arguments and errors are those of `episode_steps`.
    """
    (last,) = deque(episode_steps(policy, env, seed, max_episode_steps=max_episode_steps), maxlen=1)
    return last.total, last.num_env_steps


def episode_steps(policy: Policy, env: gym.Env[Any, Any], seed: int, *, max_episode_steps: int) -> Iterator[Moment]:
    """Play one greedy episode in one environment, step by step.

    Args:
        policy: The policy that acts; it is reset with the seed if it is `Resettable`.
        env: The environment it acts in; it is not closed.
        seed: The seed that the env is reset with.
        max_episode_steps: Cap on the env steps of the episode.

    Yields:
        What there is after the reset and after each step; the last one is over.

    Raises:
        EnvFailedError: The env raised an error, or an observation is none of its space or not finite.
    """
    if isinstance(policy, Resettable):
        policy.reset(seed)
    episode = Running(env, 0, seed)
    ended_by: EndedBy | None = None
    yield Moment(0, 0.0, None, None, ended_by)
    while ended_by is None:
        # A copy: an env may write its next observation into the same array.
        observation = np.array(episode.observation)
        action = policy.act_on_row(observation)
        if episode.step(action):
            ended_by = "terminated" if episode.has_terminated else "truncated"
        elif episode.length >= max_episode_steps:
            ended_by = "cap"
        yield Moment(episode.length, episode.total, observation, action, ended_by)


def check_policy(policy: Policy, env: gym.Env[Any, Any]) -> None:
    """Check that a policy's weights are finite and that its spaces are those of an environment.

    Raises:
        NonFiniteWeightsError: The policy's weights are NaN or infinite.
        EnvError: The policy is for other observations or actions.
    """
    policy.check_finite()
    pairs = {
        "observations": (policy.observation_space, env.observation_space),
        "actions": (policy.action_space, env.action_space),
    }
    for what, (ours, theirs) in pairs.items():
        if not _are_same(ours, theirs):
            env_id = env.spec.id if env.spec is not None else "this env"
            raise EnvError(
                f"The policy is for {policy.env_id}, whose {what} are {ours}; those of {env_id} are {theirs}.",
                f"Use it with {policy.env_id}.",
            )


def _are_same(ours: gym.Space[Any], theirs: gym.Space[Any]) -> bool:
    """Whether two spaces are of the same kind, shape and choices; bounds may differ."""
    if _kind(ours) is not _kind(theirs) or ours.shape != theirs.shape:
        return False
    if isinstance(ours, gym.spaces.Discrete) and isinstance(theirs, gym.spaces.Discrete):
        return (ours.n, ours.start) == (theirs.n, theirs.start)
    if isinstance(ours, Choices | MaskedBox) and isinstance(theirs, Choices | MaskedBox):
        return ours.sizes == theirs.sizes
    return True


def _kind(space: gym.Space[Any]) -> type[gym.Space[Any]]:
    """Return the class by which policies know a space: of a class of an env's own, the one that it comes from."""
    return next((kind for kind in _KINDS if isinstance(space, kind)), type(space))


def check_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    """Return the seeds as ints.

    Raises:
        SpecError: There are no seeds, or one is negative.
    """
    result = tuple(int(seed) for seed in seeds)
    if not result:
        raise SpecError("There are no seeds to evaluate on.", "Ask for at least one episode.")
    if min(result) < 0:
        raise SpecError(f"The seed {min(result)} is negative.", "Use seeds of 0 or more.")
    return result


def episode_cap(env: gym.Env[Any, Any], max_episode_steps: int | None, *, unlimited: int = MAX_EPISODE_STEPS) -> int:
    """Return the number of env steps after which an episode is cut off.

    Args:
        env: The environment, which may set a limit of its own.
        max_episode_steps: The cap; None: the env's limit.
        unlimited: The cap where the env sets no limit.

    Raises:
        SpecError: The given cap is below 1.
    """
    if max_episode_steps is None:
        limit = None if env.spec is None else env.spec.max_episode_steps
        return unlimited if limit is None else limit
    if max_episode_steps < 1:
        raise EnvError(f"The cap on episode steps is {max_episode_steps}.", "Use a cap of 1 or more, or none.")
    return max_episode_steps
