"""Which of Ray's commands are done by a fork, and which are left to Ray."""

import json
import sys

import pytest

from tune_jobs.ray_tune.forked_worker import forkable

PROGRAM = "/ray/workers/default_worker.py"


def command(*options: str, program: str = PROGRAM) -> list[str]:
    return [sys.executable, "/ray/workers/setup_worker.py", program, "--node-id=1", *options]


def context(**parts: object) -> str:
    return "--serialized-runtime-env-context=" + json.dumps(parts)


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--language=PYTHON", "--serialized-runtime-env-context={}"],
        [context(command_prefix=[], env_vars={}, py_executable=sys.executable, override_worker_entrypoint=None)],
    ],
)
def test_a_command_that_only_starts_the_program_is_a_fork(options: list[str]) -> None:
    assert forkable(command(*options, "--worker-id=2")) == [PROGRAM, "--node-id=1", "--worker-id=2"]


@pytest.mark.parametrize(
    "options",
    [
        ["--language=CPP"],
        [context(command_prefix=["podman", "run"])],
        [context(env_vars={"A": "b"})],
        [context(py_executable="/another/python")],
        [context(override_worker_entrypoint="/another.py")],
        [context(something_new="that a later Ray has")],
    ],
)
def test_a_command_that_does_more_is_left_to_ray(options: list[str]) -> None:
    assert forkable(command(*options)) is None


@pytest.mark.parametrize("program", ["-s", "/ray/util/client/server"])
def test_another_program_is_left_to_ray(program: str) -> None:
    assert forkable(command(program=program)) is None
