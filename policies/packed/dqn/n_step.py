"""Turn steps of a pack's environments into rows of its replay memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.hyperparams import DQNHyperparams
from policies.packed.envs.vector import Step
from policies.packed.inputs import Inputs
from policies.replay import NStep, Transitions

Floats = NDArray[np.float32]


class StackedNStep:
    """Makes n-step transitions from every member's steps.

    Args:
        num_envs: Sub-environments of each member.
        seen: What networks see of an observation.
        n_step: Steps of reward before bootstrapping; the same for all members.
    """

    def __init__(self, num_envs: int, seen: Inputs, n_step: int) -> None:
        self._num_envs, self._seen, self._n_step = num_envs, seen, n_step
        self._gamma: dict[str, float] = {}
        self._waiting: dict[str, NStep] = {}

    def add_member(self, member_id: str, hyperparams: DQNHyperparams) -> None:
        """Add a member, whose episodes begin."""
        self._gamma[member_id] = hyperparams.gamma
        self._waiting[member_id] = NStep(self._num_envs, self._n_step, hyperparams.gamma)

    def remove_member(self, member_id: str) -> None:
        """Remove a member, and drop its transitions that still wait for rewards."""
        del self._gamma[member_id], self._waiting[member_id]

    def rows(
        self, member_ids: Sequence[str], observations: NDArray[Any], actions: NDArray[np.int64], step: Step
    ) -> Floats | list[Floats]:
        """Return the rows that are complete after a vector step.

        Args:
            member_ids: The members, in the order of the rows of the other arguments.
            observations: The observations that were acted on, (S, W).
            actions: The actions, (S,).
            step: The step that the actions led to.

        Returns:
            (M, N, columns); or, where n_step is more than 1, one array of (K, columns) for each member.
        """
        if self._n_step > 1:
            return self._by_member(member_ids, observations, actions, step)
        gamma = np.repeat([self._gamma[name] for name in member_ids], self._num_envs)
        rows = self._empty(len(actions), observations, step.final_observations.reshape(len(actions), -1))
        rows[:, -3], rows[:, -2] = actions, step.rewards
        rows[:, -1] = np.where(step.is_last, 0.0, gamma)
        return rows.reshape(len(member_ids), self._num_envs, -1)

    def _empty(self, num_rows: int, observations: NDArray[Any], later: NDArray[Any]) -> Floats:
        """Return rows of observations and next observations, whose last three columns are still to be filled."""
        middle = self._seen.num_columns
        rows = np.empty((num_rows, 2 * middle + 3), dtype=np.float32)
        self._seen.put(rows[:, :middle], observations)
        self._seen.put(rows[:, middle : 2 * middle], later)
        return rows

    def _by_member(
        self, member_ids: Sequence[str], observations: NDArray[Any], actions: NDArray[np.int64], step: Step
    ) -> list[Floats]:
        found, is_last = [], step.is_last
        for index, name in enumerate(member_ids):
            own = slice(index * self._num_envs, (index + 1) * self._num_envs)
            columns = {
                # The observations that were acted on, and those that the step led to, before any reset.
                "obs": np.stack([observations[own], step.final_observations[own].reshape(self._num_envs, -1)]),
                "actions": actions[None, own],
                "rewards": step.rewards[None, own],
                "terminated": is_last[None, own],
                "truncated": step.truncated[None, own],
                "stepped": np.ones((1, self._num_envs), dtype=np.bool_),
            }
            found.append(self._as_rows(self._waiting[name].transitions(columns)))
        return found

    def _as_rows(self, transitions: Transitions) -> Floats:
        rows = self._empty(len(transitions.actions), transitions.obs, transitions.next_obs)
        rows[:, -3], rows[:, -2], rows[:, -1] = transitions.actions, transitions.rewards, transitions.discounts
        return rows
