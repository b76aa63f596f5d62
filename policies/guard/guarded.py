"""Use environments outside of trials safely, by running each function in the guard's child process.

The functions take, return and raise the same as the functions of the same names in `policies.envs`,
`policies.packed.envs`, `policies.acting.evaluate` and `policies.acting.video`. In addition they raise `EnvFailedError`
where the environment hangs or ends its process.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from policies.acting.baselines import ConstantPolicy, baseline_policy
from policies.acting.evaluate import Episodes
from policies.acting.policy import Policy, RandomPolicy, WeightsPolicy
from policies.envs.failures import FailureRule
from policies.envs.first_step import Carried, Largest
from policies.envs.make import EnvInfo
from policies.envs.mask_hints import UnusedMask
from policies.envs.spaces import space_from_description
from policies.errors import EnvError, EnvFailedError, TuneJobsError
from policies.files import write_atomic, write_plain
from policies.guard.guard import CALL_TIMEOUT_S, guarding
from policies.guard.spread import play_in_parts
from policies.hyperparams import Algorithm, ConstantHyperparams, RandomHyperparams
from policies.packed.envs.make import StepTime
from policies.portable.file import PortablePolicy, save_policy


@contextlib.contextmanager
def printing_to(log: Path) -> Iterator[None]:
    """Have a log get what environments print in the block's jobs, where a line of the terminal tells how far they are.

    Args:
        log: The log, which is made with the first job; if it cannot be written, they print to standard error.
    """
    with guarding() as guard:
        before, guard.log = guard.log, log
        try:
            yield
        finally:
            guard.log = before


def full_id(env_id: str, *, timeout_s: float = CALL_TIMEOUT_S) -> str:
    """Run `policies.envs.ids.normalize_env_id` in the guard's child, which imports the module that an id names.

    Returns:
        The registered id; one that is not found as it is, since whoever makes the environment says what is wrong.

    Raises:
        EnvFailedError: Its module hangs, or ended the process.
    """
    try:
        with guarding() as guard:
            found: str = guard.run("full_id", env_id, timeout_s=timeout_s)
    except EnvFailedError:
        raise
    except EnvError:
        return env_id
    return found


def check_env(
    env_id: str,
    env_args: Mapping[str, Any] | None,
    algorithm: Algorithm | None = None,
    *,
    timeout_s: float = CALL_TIMEOUT_S,
) -> EnvInfo:
    """Run `policies.envs.make.check_env` in the guard's child.

    Args:
        env_id: Gymnasium id.
        env_args: Keyword arguments of the env's constructor, which JSON can hold; None: none.
        algorithm: The algorithm that the action space is checked for; None: any.
        timeout_s: How long one call of the environment may take.
    """
    args = _as_json(env_id, env_args)
    try:
        with guarding() as guard:
            told: dict[str, Any] = guard.run(
                "check_env", env_id, env_args=args, algorithm=algorithm, timeout_s=timeout_s
            )
    except EnvError as error:
        raise _told_better(env_id, error) from None
    failure = told["failure"]
    told |= {name: space_from_description(told[name]) for name in ("observation_space", "action_space")}
    told |= {"env_args": args, "failure": None if failure is None else FailureRule(**failure)}
    told["unused_mask"] = None if told["unused_mask"] is None else UnusedMask(*told["unused_mask"])
    told["largest"] = None if told["largest"] is None else Largest(*told["largest"])
    told["carried"] = Carried(*told["carried"])
    return EnvInfo(**told)


def check_seedable(env_id: str, env_args: Mapping[str, Any] | None, *, timeout_s: float = CALL_TIMEOUT_S) -> None:
    """Run `policies.packed.envs.make.check_seedable` in the guard's child; the arguments are those of `check_env`."""
    with guarding() as guard:
        guard.run("check_seedable", env_id, env_args=_as_json(env_id, env_args), timeout_s=timeout_s)


def measure_step(env_id: str, env_args: Mapping[str, Any] | None, *, timeout_s: float = CALL_TIMEOUT_S) -> StepTime:
    """Run `policies.packed.envs.make.measure_step` in the guard's child; the arguments are those of `check_env`."""
    with guarding() as guard:
        told = guard.run("measure_step", env_id, env_args=_as_json(env_id, env_args), timeout_s=timeout_s)
    return StepTime(**told)


def evaluate_policy(
    policy: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seeds: Sequence[int],
    max_episode_steps: int | None = None,
    num_processes: int = 1,
    told: Callable[[int], None] = lambda _: None,
    timeout_s: float = CALL_TIMEOUT_S,
) -> Episodes:
    """Run `policies.acting.evaluate.evaluate_policy` in the guard's child.

    Args:
        policy: The policy that acts.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seeds: One episode is played for each, in this order.
        max_episode_steps: As there.
        num_processes: In how many processes at once slow environments are played at most.
        told: Called from time to time with how many episodes have begun.
        timeout_s: How long one call of the environment or of the policy may take.
    """
    with guarding() as guard, _saved(policy) as (saved,):
        parts = play_in_parts(
            guard, "evaluate_policy", env_id, [int(seed) for seed in seeds], num_policies=1,
            num_processes=num_processes, env_args=_as_json(env_id, env_args), policy=saved,
            max_episode_steps=max_episode_steps, timeout_s=timeout_s, told=told,
        )  # fmt: skip
    return _joined(parts)


def evaluate_policies(
    policies: Sequence[Policy],
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seeds: Sequence[int],
    max_episode_steps: int | None = None,
    num_processes: int = 1,
    told: Callable[[int], None] = lambda _: None,
    timeout_s: float = CALL_TIMEOUT_S,
) -> list[Episodes | TuneJobsError]:
    """Play one greedy episode for each seed and each policy, as many at once as the env allows, in the guard's child.

    The arguments are those of `evaluate_policy`.

    Returns:
        For each policy its episodes, which are those of `evaluate_policy`, or the error that this would raise.

    Raises:
        EnvError: The environment cannot be made, hung, or ended its process, for whichever policy.
    """
    with guarding() as guard, _saved(*policies) as saved:
        parts = play_in_parts(
            guard, "evaluate_policies", env_id, [int(seed) for seed in seeds], num_policies=len(policies),
            num_processes=num_processes, env_args=_as_json(env_id, env_args), policies=saved,
            max_episode_steps=max_episode_steps, timeout_s=timeout_s, told=told,
        )  # fmt: skip
    return [_joined_or_error(of_policy) for of_policy in zip(*parts, strict=True)]


def record_video(
    policy: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seeds: int | Sequence[int],
    mp4: Path | None = None,
    gif: Path | None = None,
    caption: str | None = None,
    fps: float | None = None,
    max_steps: int | None = None,
    timeout_s: float = CALL_TIMEOUT_S,
) -> Episodes:
    """Run `policies.acting.video.record_video` in the guard's child.

    `timeout_s` is how long one call of the environment or of the policy may take.
    """
    filmed = [int(seeds)] if isinstance(seeds, int) else [int(seed) for seed in seeds]
    with guarding() as guard, _saved(policy) as (saved,), _staged({"mp4": mp4, "gif": gif}) as files:
        told = guard.run(
            "record_video", env_id, env_args=_as_json(env_id, env_args), policy=saved, files=files, seeds=filmed,
            caption=caption, fps=fps, max_steps=max_steps, timeout_s=timeout_s,
        )  # fmt: skip
    return _episodes(told)


def record_comparison(
    left: Policy,
    right: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seed: int,
    captions: tuple[str, str],
    left_mp4: Path,
    right_mp4: Path,
    right_gif: Path,
    both_mp4: Path,
    max_steps: int | None = None,
    timeout_s: float = CALL_TIMEOUT_S,
) -> tuple[Episodes, Episodes]:
    """Run `policies.acting.video.record_comparison` in the guard's child.

    `timeout_s` is how long one call of the environment or of a policy may take.
    """
    wanted: dict[str, Path | None] = {
        "left_mp4": left_mp4, "right_mp4": right_mp4, "right_gif": right_gif, "both_mp4": both_mp4,
    }  # fmt: skip
    with guarding() as guard, _saved(left, right) as (one, other), _staged(wanted) as files:
        first, second = guard.run(
            "record_comparison", env_id, env_args=_as_json(env_id, env_args), left=one, right=other, files=files,
            captions=captions, seed=seed, max_steps=max_steps, timeout_s=timeout_s,
        )  # fmt: skip
    return _episodes(first), _episodes(second)


def _as_json(env_id: str, env_args: Mapping[str, Any] | None) -> dict[str, Any]:
    try:
        args: dict[str, Any] = json.loads(json.dumps(dict(env_args or {})))
    except (TypeError, ValueError) as error:
        raise EnvError(
            f"The arguments of {env_id!r} cannot be written to a sweep file: {error}.",
            "Give numbers, texts, true, false, lists and mappings with texts as keys.",
        ) from error
    return args


def _told_better(env_id: str, error: EnvError) -> EnvError:
    """Return the error, or a better one if the env id is registered in this process but not in others."""
    if not error.message.startswith("No environment ") or env_id.strip() not in gym.registry:
        return error
    return EnvError(
        f"{env_id!r} is registered with Gymnasium in this process alone: the processes of trials do not have it.",
        f"Call gymnasium.register in a module, such as my_envs.py, allow it, and name the env my_envs:{env_id}; or "
        "give the env's class.",
    )


def _episodes(told: Mapping[str, Any]) -> Episodes:
    return Episodes(**{name: tuple(values) for name, values in told.items()})


def _joined(parts: Sequence[Mapping[str, Any]]) -> Episodes:
    return _episodes({name: [value for part in parts for value in part[name]] for name in parts[0]})


def _joined_or_error(parts: Sequence[Mapping[str, Any]]) -> Episodes | TuneJobsError:
    error = next((part["error"] for part in parts if "error" in part), None)
    return _joined(parts) if error is None else TuneJobsError(**error)


@contextlib.contextmanager
def _saved(*policies: Policy) -> Iterator[list[dict[str, str]]]:
    """Save policies to files that last as long as the block."""
    with tempfile.TemporaryDirectory(prefix="tune-jobs-policy-", ignore_cleanup_errors=True) as name:
        saved = []
        for number, policy in enumerate(policies):
            folder = Path(name, str(number))
            folder.mkdir()
            save_policy(_portable(policy), folder, write=write_plain)
            saved.append({"folder": str(folder), "description": policy.description})
        yield saved


def _portable(policy: Policy) -> PortablePolicy:
    if isinstance(policy, WeightsPolicy):
        return policy.portable
    if isinstance(policy, ConstantPolicy):
        values: RandomHyperparams = ConstantHyperparams(action=policy.action)
    elif isinstance(policy, RandomPolicy):
        values = RandomHyperparams()
    else:
        raise TypeError(f"A policy of kind {type(policy).__name__} cannot be saved in a file.")
    return baseline_policy(
        values,
        env_id=policy.env_id,
        env_args=dict(policy.env_args),
        observation_space=policy.observation_space,
        action_space=policy.action_space,
    )


@contextlib.contextmanager
def _staged(files: Mapping[str, Path | None]) -> Iterator[dict[str, str | None]]:
    """Yield temporary paths for files; they are moved to their own paths if the block ends without an error."""
    with tempfile.TemporaryDirectory(prefix="tune-jobs-film-", ignore_cleanup_errors=True) as name:
        staged = {key: None if path is None else Path(name, key + path.suffix) for key, path in files.items()}
        yield {key: None if path is None else str(path) for key, path in staged.items()}
        for key, path in files.items():
            source = staged[key]
            if path is not None and source is not None:
                write_atomic(path, source.read_bytes())
