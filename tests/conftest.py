"""One Ray for all tests here, and a package of test environments that its worker processes find too."""

import contextlib
import gc
import inspect
import math
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest

from tests import slow

PLUGIN = Path(__file__).parent / "ray" / "env_plugin"
EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"

# Under nohup, or in a shell's background, signals are ignored, here and in what is started here. Tests of signals need
# processes that get them: those that are started find the default in the place of a handler.
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    slow.choose(config, items)


def pytest_collection_finish() -> None:
    """Leave what was imported and collected, a million objects, out of each of the many searches for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def guard() -> Iterator[None]:
    """One guard's child for all tests here: each plan would start one of its own."""
    from policies.guard.guard import guarding

    with guarding():
        yield


@pytest.fixture(scope="session", autouse=True)
def _scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is fetched from object stores, which stays for the next command: a thousand folders after a run of tests."""
    from tune_jobs.store.objects.scratch import VARIABLE

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, str(tmp_path_factory.mktemp("scratch")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_synced() -> Iterator[None]:
    """What is written here outlives its process, which is all that a test can see: no power fails meanwhile.

    The disk of a busy machine takes milliseconds for each of the files, twenty thousand in tests/unit. Tests of when
    files are synced have a function of their own in the place of this one.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_upgraded() -> Iterator[None]:
    """Who edits a file while tests run is no upgrade, which would be told in the place of errors."""
    from tune_jobs.process import own_files

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(own_files, "_BEGAN_AT", math.inf)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_source_is_looked_up() -> Iterator[None]:
    """Ray 2.60's `ConnectorV2.__init__` asks for the frame of its caller, and gets the source of all frames read.

    From a test, under sixty frames of pytest's, that takes half a second for each Algorithm (50 ms in a trial of a
    sweep), a quarter of what tests of RLlib take.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inspect, "stack", _frames)
        yield


def _frames(context: int = 1) -> list[inspect.FrameInfo]:
    """Return what `inspect.stack` returns, without the lines of source code around each call."""
    frames = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        frames.append(inspect.FrameInfo(frame, code.co_filename, frame.f_lineno, code.co_name, None, None))
        frame = frame.f_back
    return frames


@pytest.fixture(scope="session")
def env_plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Install `env_plugin` for this process and those it starts: a metadata folder with Gymnasium's entry point."""
    folder = tmp_path_factory.mktemp("site")
    metadata = folder / "tune_jobs_test_envs-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: tune-jobs-test-envs\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[gymnasium.envs]\n__root__ = tune_jobs_test_envs:register\n")
    # The examples are run in their folders, by a Ray that is started there; this one is there for all tests.
    paths = [str(PLUGIN), str(folder), str(EXAMPLES / "own_env"), str(EXAMPLES / "own_module")]
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(paths + ([before] if before else []))
    sys.path[:0] = paths
    import tune_jobs_test_envs

    # For RLlib's own runners, which ask Gymnasium itself.
    tune_jobs_test_envs.register()
    yield
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before
    for path in paths:
        sys.path.remove(path)


@pytest.fixture(scope="session")
def ray_session(env_plugin: None) -> Iterator[None]:
    """A Ray of two CPUs, started as a sweep starts its own, trials' processes as forks included.

    RLlib would start one without these settings. With processes of Ray alone, each of which imports for seconds,
    the tests of tests/ray take half as long again. What is forked trains packs in one test and RLlib in the next.
    """
    import ray

    from tune_jobs.plan.machine import Machine
    from tune_jobs.ray_tune import forks, local_ray
    from tune_jobs.ray_tune.environment import prepare_environment

    prepare_environment()
    with contextlib.ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patched:
            for imported in (forks._EARLY, forks._LATE):
                patched.setitem(imported, "packs", (*imported["packs"], *imported["trials"]))
            server = stack.enter_context(forks.fork_server("packs"))
        stack.enter_context(local_ray.without_environments())
        local_ray.start(Machine(2), server)
        yield
        ray.shutdown()
