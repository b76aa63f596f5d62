"""The program of the guard's child: it runs jobs, functions that take and return JSON; see `guard`."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policies.envs import calls
from policies.envs import faults as env_faults
from policies.envs import modules as env_modules
from policies.envs.rendering import choose_before_import
from policies.errors import EnvFailedError, TuneJobsError, said_by
from policies.guard.prints import print_to

if TYPE_CHECKING:
    from policies.acting.evaluate import Episodes
    from policies.acting.policy import Policy

_PARENT_LOOK_S = 1.0
_PR_SET_PDEATHSIG = 1


def main(parent: int, connection: int, page: int, dump: int) -> None:
    """Do jobs until the parent closes the connection, or ends.

    Args:
        parent: The parent's process id.
        connection: Descriptor of this end of the pipe to the parent.
        page: Descriptor of the file with the page that calls are written to (see `policies.envs.calls`).
        dump: Descriptor of the file that the fault handler writes to.
    """
    _end_with(parent)
    faulthandler.enable(dump)
    faulthandler.register(signal.SIGUSR1, dump, all_threads=True)
    # The parent's standard output may be reserved for one JSON document, so what environments print goes elsewhere.
    with contextlib.suppress(OSError):
        os.dup2(2, 1)
    told = calls.Page(page)
    calls.tell(told)
    import policies.packed.envs.make  # noqa: F401 (loaded early: every job needs it, and the parent is still busy)

    # After this, a KeyboardInterrupt that an env raises can be told from one that came by a signal.
    env_faults.note_signals()
    pipe = Connection(connection)
    while True:
        try:
            asked = json.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            break
        pipe.send_bytes(json.dumps(_answer(asked, told)).encode())


def _end_with(parent: int) -> None:
    """End this process when its parent ends, whatever it is doing then."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_LOOK_S)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=watch, daemon=True).start()


def _answer(asked: Mapping[str, Any], told: calls.Page) -> dict[str, Any]:
    arguments = asked["arguments"]
    try:
        _see(asked)
        return {"result": _JOBS[asked["job"]](**arguments)}
    except BaseException as error:  # noqa: BLE001 (SystemExit, say: an env may raise anything)
        said = {
            "kind": type(error).__name__,
            "message": said_by(error),
            "hint": "",
            "traceback": traceback.format_exc(),
        }
        if isinstance(error, TuneJobsError):
            said |= {"message": error.message, "hint": error.hint}
        elif not isinstance(error, Exception):
            said |= {
                "kind": EnvFailedError.__name__,
                "message": f"{arguments['env_id']} raised {type(error).__name__} in {told.last_raised.phrase}: "
                f"{said_by(error)}.",
                "hint": "Mend the env: what it raises must be an Exception.",
            }
        return {"error": said}


def _see(asked: Mapping[str, Any]) -> None:
    """Give this process the parent's log, folder, import path and allowed modules."""
    print_to(asked.get("log"))
    env_modules.allow_modules(asked["modules"])
    # Without asking where it is: an env may have gone to a folder that it has removed since.
    os.chdir(asked["folders"][0])
    missing = [folder for folder in (*asked["folders"], *asked["module_folders"]) if folder not in sys.path]
    sys.path[:0] = missing
    if ":" in asked["arguments"]["env_id"]:
        # A later job may be a film.
        choose_before_import()


# -- jobs


def full_id(env_id: str) -> str:
    """Run `policies.envs.ids.normalize_env_id`."""
    from policies.envs.ids import normalize_env_id

    with calls.inside(calls.Call.IMPORT):
        return normalize_env_id(env_id)


def check_env(env_id: str, env_args: dict[str, Any], algorithm: Any) -> dict[str, Any]:
    """Run `policies.envs.make.check_env` and return what it found as JSON."""
    from policies.envs.make import check_env as check
    from policies.envs.spaces import describe_space

    info = check(env_id, env_args, algorithm)
    return {
        "env_id": info.env_id,
        "observation_space": describe_space(info.observation_space),
        "action_space": describe_space(info.action_space),
        "threshold": info.threshold,
        "max_episode_steps": info.max_episode_steps,
        "has_vector_entry_point": info.has_vector_entry_point,
        "failure": None if info.failure is None else {"reward": info.failure.reward},
        "mask": info.mask,
        "unused_mask": info.unused_mask,
        "is_flattened": info.is_flattened,
        "unrepeated": info.unrepeated,
        "largest": info.largest,
        "carried": info.carried,
    }


def check_seedable(env_id: str, env_args: dict[str, Any]) -> None:
    """Run `policies.packed.envs.make.check_seedable`."""
    from policies.packed.envs.make import check_seedable as check

    check(env_id, env_args)


def measure_step(env_id: str, env_args: dict[str, Any]) -> dict[str, Any]:
    """Run `policies.packed.envs.make.measure_step` and return what it measured."""
    from policies.packed.envs.make import measure_step as measure

    return vars(measure(env_id, env_args))


def evaluate_policy(
    env_id: str, env_args: dict[str, Any], policy: dict[str, str], seeds: Sequence[int], **options: Any
) -> dict[str, Any]:
    """Play the episodes of an `Evaluator` with these options with a saved policy, and return them."""
    from policies.acting.evaluate import Evaluator

    with Evaluator(env_id, env_args, seeds, **options) as evaluator:
        return vars(evaluator.run(_load(policy)))


def evaluate_policies(
    env_id: str, env_args: dict[str, Any], policies: Sequence[dict[str, str]], seeds: Sequence[int], **options: Any
) -> list[dict[str, Any]]:
    """Run `policies.packed.evaluation.evaluate_many` with saved policies; return their episodes, or their errors.

    The options are those of the `Evaluator`.
    """
    from policies.acting.evaluate import Evaluator
    from policies.packed.evaluation import evaluate_many

    def play(some: list[Policy]) -> list[Episodes | Exception]:
        with Evaluator(env_id, env_args, seeds, **options) as evaluator:
            return evaluate_many(evaluator, some)

    loaded = [_load(policy) for policy in policies]
    results = play(loaded)
    if any(isinstance(result, Exception) for result in results):
        # An env that has raised an error may not be as it was for whoever acts in it next: each gets one of its own.
        results = [play([policy])[0] for policy in loaded]
    return [_episodes_or_error(result) for result in results]


def _episodes_or_error(result: Episodes | Exception) -> dict[str, Any]:
    if not isinstance(result, Exception):
        return vars(result)
    if not isinstance(result, TuneJobsError):
        raise result
    return {"error": {"message": result.message, "hint": result.hint}}


def record_video(env_id: str, policy: dict[str, str], files: dict[str, str | None], **options: Any) -> dict[str, Any]:
    """Run `policies.acting.video.record_video` with a saved policy and return the episodes."""
    from policies.acting.video import record_video as record

    return vars(record(_load(policy), env_id=env_id, **_paths(files), **options))


def record_comparison(
    env_id: str, left: dict[str, str], right: dict[str, str], files: dict[str, str], captions: Sequence[str],
    **options: Any,
) -> list[dict[str, Any]]:  # fmt: skip
    """Run `policies.acting.video.record_comparison` with two saved policies and return their episodes."""
    from policies.acting.video import record_comparison as record

    one, other = captions
    both: tuple[Episodes, Episodes] = record(
        _load(left), _load(right), env_id=env_id, captions=(one, other), **_paths(files), **options
    )
    return [vars(episodes) for episodes in both]


def _load(saved: Mapping[str, str]) -> Policy:
    from policies.acting.load import policy_from_portable
    from policies.portable.file import read_policy

    return calls.watch_policy(policy_from_portable(read_policy(Path(saved["folder"])), saved["description"]))


def _paths(files: Mapping[str, str | None]) -> dict[str, Any]:
    return {name: None if file is None else Path(file) for name, file in files.items()}


_JOBS: dict[str, Callable[..., Any]] = {
    job.__name__: job
    for job in (
        full_id, check_env, check_seedable, measure_step, evaluate_policy, evaluate_policies, record_video,
        record_comparison,
    )
}  # fmt: skip
