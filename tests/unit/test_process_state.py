"""What Ray and Ray Tune change of a process is given back; what belongs to others is left alone."""

import faulthandler
import logging
import os
import random
import resource
import signal
import sys
import threading
import warnings
from typing import Any, cast

import numpy as np
import pytest
import torch

from policies.envs.modules import allow_modules, allowed_modules
from tune_jobs.process.state import given_back


def state() -> dict[str, Any]:
    """What another library could see of it."""
    root, known = logging.getLogger(), logging.getLogger("tune_jobs_test.known")
    return {
        "environment": dict(os.environ),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "hooks": (sys.excepthook, threading.excepthook, faulthandler.is_enabled()),
        "loggers": [(log.level, log.handlers[:], log.propagate, log.disabled) for log in (root, known)],
        "factory": logging.getLogRecordFactory(),
        "warnings": warnings.filters[:],
        "random": random.getstate(),
        "numpy": str(np.random.get_state()),  # noqa: NPY002 (the generator that is everybody's)
        "files": resource.getrlimit(resource.RLIMIT_NOFILE),
        "modules": allowed_modules(),
    }


def disturb() -> None:
    os.environ.update(RAY_X="1", TUNE_X="1", PYTHONBREAKPOINT="none", PYTHONPATH="/nowhere", SDL_VIDEODRIVER="dummy")
    signal.signal(signal.SIGUSR1, lambda *_: None)
    signal.signal(signal.SIGTERM, lambda *_: None)
    sys.excepthook = threading.excepthook = cast("Any", lambda *_: None)
    faulthandler.enable()
    for log in (logging.getLogger(), logging.getLogger("tune_jobs_test.known")):
        log.setLevel(3)
        log.addHandler(logging.NullHandler())
        log.propagate = not log.propagate
    logging.setLogRecordFactory(lambda *args: logging.LogRecord(*args))  # noqa: PLW0108 (another one than before)
    warnings.filterwarnings("error", message="of no one")
    random.random()
    np.random.random()  # noqa: NPY002
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft - 1, hard))
    allow_modules(["tune_jobs_test_module"])


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt])
def test_everything_is_as_before(
    monkeypatch: pytest.MonkeyPatch, error: type[KeyboardInterrupt] | type[ValueError] | None
) -> None:
    monkeypatch.setenv("TUNE_MINE", "7")
    # pytest has one of its own.
    dumps: list[Any] = []
    monkeypatch.setattr(faulthandler, "is_enabled", lambda: bool(dumps))
    monkeypatch.setattr(faulthandler, "enable", lambda: dumps.append(1))
    monkeypatch.setattr(faulthandler, "disable", dumps.clear)
    logging.getLogger("tune_jobs_test.known")
    before = state()

    def run() -> None:
        with given_back():
            disturb()
            os.environ["TUNE_MINE"] = "8"
            assert [key for key, value in before.items() if state()[key] == value] == []
            if error is not None:
                raise error

    if error is None:
        run()
    else:
        with pytest.raises(error):
            run()
    assert state() == before


def test_what_a_users_module_sets_as_it_is_imported_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with given_back():
        monkeypatch.setenv("MUJOCO_GL", "egl")
    assert os.environ["MUJOCO_GL"] == "egl"


def test_modules_that_the_user_allowed_stay_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    from policies.envs import modules as env_modules

    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["of_the_user"])
    with given_back():
        allow_modules(["of_the_sweep"])
        assert allowed_modules() == ("of_the_sweep", "of_the_user")
    assert allowed_modules() == ("of_the_user",)


def test_what_torch_draws_and_may_do_at_random_is_as_before() -> None:
    """RLlib seeds it and forbids it the rest, for each Algorithm."""

    def state() -> list[Any]:
        return [
            torch.get_rng_state().tolist(), torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(), torch.backends.cudnn.deterministic,
            torch.backends.cudnn.benchmark,
        ]  # fmt: skip

    before = state()
    exact, warns, deterministic, benchmark = before[1:]
    with given_back():
        # Whatever earlier tests have left.
        torch.rand(1)
        torch.use_deterministic_algorithms(not exact, warn_only=not warns)
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = not deterministic, not benchmark
        assert not any(one == other for one, other in zip(before, state(), strict=True))
    assert state() == before


def test_what_a_program_has_frozen_of_torch_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `torch.backends.disable_global_flags` does, for good."""
    backends: Any = torch.backends
    # What freezes them is set there; `torch.backends` itself is another object.
    monkeypatch.setitem(backends.flags_frozen.__globals__, "__allow_nonbracketed_mutation_flag", False)
    assert backends.flags_frozen()
    with given_back():
        pass


def test_it_works_in_any_thread() -> None:
    failures = []

    def run() -> None:
        try:
            with given_back():
                os.environ["RAY_X"] = "1"
            assert "RAY_X" not in os.environ
        except Exception as error:  # noqa: BLE001
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(60)
    assert failures == []
