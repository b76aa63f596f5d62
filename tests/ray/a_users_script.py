"""A script that launches sweeps: run by test_users_process.py, which reads what it prints.

It looks at everything that another library in its process could notice, before and after launches of all kinds.
"""

import faulthandler
import json
import logging
import os
import random
import resource
import signal
import sys
import threading
import time
import traceback
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import tune_jobs
from policies.envs.modules import allowed_modules

SPEC = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "hyperparams": {"hidden_sizes": [8]},
    "stop": {"num_env_steps": 2_000},
    "evaluation": {"every_iterations": 1, "num_episodes": 2},
}
ENDLESS = {"stop": {"num_env_steps": 500_000_000}}
STORAGE = Path(sys.argv[1])


def state() -> dict[str, Any]:
    root, mine = logging.getLogger(), logging.getLogger("mine")
    return {
        "environment": dict(os.environ),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "hooks": (sys.excepthook, threading.excepthook, sys.unraisablehook, sys.displayhook, faulthandler.is_enabled()),
        "streams": (sys.stdout, sys.stderr, sys.stdin),
        "descriptors": [str(Path(f"/proc/self/fd/{number}").readlink()) for number in range(3)],
        "loggers": [(log.level, log.handlers[:], log.propagate, log.disabled) for log in (root, mine)],
        "factory": logging.getLogRecordFactory(),
        "warnings": warnings.filters[:],
        "random": random.getstate(),
        "numpy": str(np.random.get_state()),  # noqa: NPY002
        "files": resource.getrlimit(resource.RLIMIT_NOFILE),
        "folder": Path.cwd(),
        # Ray has packages of its own, which it imports when it needs them.
        "path": [entry for entry in sys.path if "thirdparty_files" not in entry],
        "modules": allowed_modules(),
        "mask": signal.pthread_sigmask(signal.SIG_BLOCK, ()),
    }


def launch(name: str, **changes: Any) -> str:
    """Launch a sweep; what came of it."""
    try:
        keywords = {key: changes.pop(key) for key in ("address", "finish") if key in changes}
        spec = {**SPEC, **changes}
        result = tune_jobs.launch(spec, name=name, storage=STORAGE, progress="none", **{"finish": False, **keywords})
    except BaseException as error:  # noqa: BLE001 (KeyboardInterrupt too)
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return f"exit code {result.exit_code}"


def interrupt_when_it_trains(name: str) -> None:
    """SIGTERM, in a while: Ray's own handler of it would abort this process 3 s later."""

    def wait() -> None:
        while not any((STORAGE / name).glob("trials/*/checkpoints/0*")):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


class Holder:
    """An actor that holds a CPU."""

    def is_there(self) -> bool:
        return True


def tell(what: str, before: dict[str, Any], came_of_it: str) -> None:
    after = state()
    changed = {key: [repr(value), repr(after[key])] for key, value in before.items() if after[key] != value}
    print(json.dumps({"what": what, "came of it": came_of_it, "changed": changed}), flush=True)


def main() -> None:
    logging.getLogger("mine").setLevel(17)
    # Importing Gymnasium, which this does, changes filters of warnings and a variable, as any import of it would.
    assert callable(tune_jobs.launch)
    assert "ray" not in sys.modules
    before = state()
    tell("a launch", before, launch("one", finish=True))
    tell("a bad spec", before, launch("two", algorithm="sac"))
    interrupt_when_it_trains("three")
    tell("a signal", before, launch("three", **ENDLESS))
    results: list[str] = []
    thread = threading.Thread(target=lambda: results.append(launch("four")))
    thread.start()
    while not (STORAGE / "four").exists():
        assert thread.is_alive()
        time.sleep(0.01)
    results.append(launch("five"))
    created = tune_jobs.create(SPEC, name="created", storage=STORAGE)
    with ThreadPoolExecutor(1) as pool:
        driven = pool.submit(tune_jobs.drive, created.folder, progress="none", finish=False).result()
    thread.join()
    tell("two threads", before, "; ".join([*results, f"exit code {driven.exit_code}"]))

    # From here on with a Ray of the user's own.
    import ray

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
    before = state()
    tell("too few CPUs", before, launch("six", resources={"num_cpus": 2}))
    tell("another Ray", before, launch("seven", address=f"127.0.0.1:{sys.argv[2]}"))
    holder = ray.remote(num_cpus=1)(Holder).remote()
    ray.get(holder.is_there.remote())
    tell("no free CPU", before, launch("eight"))
    ray.kill(holder)
    tell("the user's Ray", before, launch("nine"))
    assert ray.is_initialized()
    assert ray.cluster_resources()["CPU"] == 1


if __name__ == "__main__":
    main()
