"""The process that plays an episode for a page: lines of JSON on its standard output, in the environment's own time.

An environment is a user's code, which never runs in the service's process. It may hang or end its process: this one, of
which the service sees the end.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from policies.acting.live import watch_episode
from policies.acting.load import load_policy
from policies.acting.policy import Policy, RandomPolicy
from policies.envs.modules import allow_modules
from policies.errors import TuneJobsError
from policies.parents import end_with_parent

LEAST_SPEED, MOST_SPEED = 0.1, 10.0
MAX_STEPS = 10_000
"""The most env steps that are shown."""


def main() -> None:
    """Play the episode that standard input asks for."""
    end_with_parent(by_kernel=False)
    # What an environment prints is not for the page.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(told: Mapping[str, Any]) -> None:
        answers.write(json.dumps(told, allow_nan=False) + "\n")
        answers.flush()

    request = json.loads(sys.stdin.read())
    try:
        play(request, say)
    except BrokenPipeError:
        # Nobody watches any more.
        os._exit(0)
    except TuneJobsError as error:
        say({"event": "problem", "detail": error.message, "hint": error.hint})


def play(request: Mapping[str, Any], say: Callable[[Mapping[str, Any]], None]) -> None:
    """Play an episode.

    Args:
        request: `policy` (a folder, or "random"), `env_id`, `env_args`, `modules`, `seed`, `speed` (1: the
            environment's own time), and `start` (the first env step that is told; 0: all are).
        say: Takes what is to be told: `info`, then a `step` each, then `end`; `skipped` once a second before `start`.

    Raises:
        TuneJobsError: The policy can't be read, or the environment failed.
        BrokenPipeError: Nobody watches any more.
    """
    allow_modules(request["modules"])
    env_id, env_args, seed = request["env_id"], request["env_args"], request["seed"]
    if request["policy"] == "random":
        policy: Policy = RandomPolicy.for_env(env_id, env_args)
    else:
        policy = load_policy(request["policy"])
    start = request["start"]
    info, steps = watch_episode(policy, env_id, env_args, seed, start=start)
    say({"event": "info", **asdict(info), "seed": seed})
    pause = 1.0 / info.fps / min(MOST_SPEED, max(LEAST_SPEED, request["speed"]))
    due, step = time.monotonic(), None
    told_at = due
    for step in steps:
        if step.num_env_steps < start and not step.over:
            # Who waits hears that the environment does not hang.
            if time.monotonic() - told_at > 1.0:
                say({"event": "skipped", "num_env_steps": step.num_env_steps})
                told_at = time.monotonic()
            continue
        say({"event": "step", **asdict(step)})
        if step.num_env_steps >= MAX_STEPS:
            break
        due = max(due + pause, time.monotonic() - pause)
        time.sleep(max(0.0, due - time.monotonic()))
    if step is not None:
        told = {"num_env_steps": step.num_env_steps, "total": step.total}
        say({"event": "end", **told, "over": step.over, "ended_by": step.ended_by})


if __name__ == "__main__":
    main()
