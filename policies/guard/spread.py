"""Play episodes in several children of a guard at once, where an environment is so slow that it is worth it.

An episode depends on its seed and its policy alone, so whoever plays which seeds changes nothing in what comes out.
How long an episode takes is known after the first ones: of an environment that nobody has played yet, the first seed is
played by itself.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from policies.acting.evaluate import MAX_ENVS
from policies.guard.guard import EnvGuard

_WORTH_S = 2.0
"""Each child has work for so long at least: it takes a second of a core to import what environments need."""
_MOST = 16
"""The most children at once; each of them holds environments."""


def play_in_parts(
    guard: EnvGuard,
    job: str,
    env_id: str,
    seeds: Sequence[int],
    *,
    num_policies: int,
    num_processes: int,
    timeout_s: float,
    told: Callable[[int], None],
    env_args: dict[str, Any],
    **arguments: Any,
) -> list[Any]:
    """Do a job that plays an episode for each seed and policy, divided among children by its seeds.

    Args:
        guard: The first child's; what it knows of the environment is used and kept.
        job: A function of `policies.guard.child` that takes `seeds` and `max_envs`.
        env_id: The environment.
        seeds: All seeds.
        num_policies: How many policies play each of them.
        num_processes: The most children at once.
        timeout_s: How long one call of the environment or of a policy may take.
        told: Called from time to time with how many episodes have begun.
        env_args: Keyword arguments of the environment's constructor.
        arguments: The function's other arguments, as JSON.

    Returns:
        Its results, each for the seeds behind those of the one before.

    Raises:
        EnvFailedError: An environment hung, or ended its process.
        TuneJobsError: The function raised it.
    """
    key = json.dumps([env_id, env_args], sort_keys=True)
    job_arguments = {"timeout_s": timeout_s, "env_args": env_args, **arguments}
    parts = _Parts(guard, job, env_id, job_arguments, key, num_policies, told)
    left, measured = list(seeds), guard.episode_s.setdefault(key, [])

    def worth(num_seeds: int) -> int:
        """Return how many children have work for long enough."""
        expected_s = measured[-1] * num_seeds * num_policies if measured else 0.0
        return max(1, min(num_processes, _MOST, num_seeds, int(expected_s / _WORTH_S)))

    # Before its first episodes the child imports, for which the next ones don't wait.
    while num_processes > 1 and len(left) > 2 and (not measured or (len(measured) == 1 and worth(len(left)) > 1)):
        parts.play([left[:1]])
        left = left[1:]
    parts.play(list(_divided(left, worth(len(left)))))
    return parts.results


@dataclass
class _Parts:
    """Plays parts of the seeds at the same time, and keeps what came of them."""

    guard: EnvGuard
    job: str
    env_id: str
    arguments: Mapping[str, Any]
    key: str
    """What tells the environment from others."""
    num_policies: int
    told: Callable[[int], None]
    results: list[Any] = field(default_factory=list)
    num_played: int = 0
    """Episodes of the parts before."""

    def play(self, parts: Sequence[Sequence[int]]) -> None:
        began = time.monotonic()
        guards = [self.guard, *self.guard.others(len(parts) - 1)]
        num_before = self.num_played

        def look() -> None:
            self.told(num_before + sum(each.num_resets for each in guards) - resets_before)

        # Together they hold as many environments as one does.
        max_envs = math.ceil(MAX_ENVS / len(parts))
        unasked = list(guards)
        try:
            waiting = [
                each.begin(self.job, self.env_id, look=look, seeds=part, max_envs=max_envs, **self.arguments)
                for each, part in zip(guards, parts, strict=True)
            ]
            resets_before = sum(each.num_resets for each in guards)
            for result in waiting:
                # If an error comes of it, it is ready for more, or has ended.
                unasked.pop(0)
                self.results.append(result())
        except BaseException:
            # They still play, and nobody waits for them.
            for each in unasked:
                each.give_up()
            raise
        self.num_played += self.num_policies * sum(map(len, parts))
        longest = max(map(len, parts)) * max(1, self.num_policies)
        self.guard.episode_s[self.key].append((time.monotonic() - began) / longest)


def _divided(seeds: Sequence[int], num: int) -> Iterator[Sequence[int]]:
    """Yield the seeds in order, in parts that differ by one at most."""
    for part in range(num):
        yield seeds[len(seeds) * part // num : len(seeds) * (part + 1) // num]
