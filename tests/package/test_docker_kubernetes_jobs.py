"""What the entrypoints of the Kubernetes jobs make of a driver's end, run by a shell as Ray's job server does."""

import contextlib
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
from kustomize import render

FOLDER = Path(__file__).parents[2] / "docker" / "kubernetes"


def entrypoint_of(folder: str, kind: str) -> str:
    (manifest,) = [one for one in render(FOLDER / folder, component=FOLDER / "storage-pvc") if one["kind"] == kind]
    return str(manifest["spec"].get("jobTemplate", manifest["spec"])["entrypoint"])


@pytest.mark.parametrize(("folder", "kind"), [("sweep", "RayJob"), ("nightly", "RayCronJob")])
@pytest.mark.parametrize(
    ("codes", "code"),
    [
        ([0], 0),
        ([3], 0),
        ([4, 0], 0),
        ([4, 3], 0),
        ([4, 2], 2),
        ([4, 5], 5),
        ([2], 2),
        ([5], 5),
        ([130], 0),
        ([4, 130], 0),
    ],
)
def test_a_job_fails_unless_its_sweep_is_over(
    folder: str, kind: str, codes: list[int], code: int, tmp_path: Path
) -> None:
    """As Ray's job server runs the entrypoint: with a shell, and what it prints is the job's log."""
    entrypoint = entrypoint_of(folder, kind)
    program = tmp_path / "tune-jobs"
    program.write_text(f'#!/bin/sh\necho "$1 $2 $4"\n[ "$1" = resume ] && exit {codes[0]}\nexit {codes[-1]}\n')
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["/bin/sh", "-c", entrypoint], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, "")
    first, *rest = done.stdout.splitlines()
    name = first.split()[1]
    assert first.startswith(f"resume {name}")
    assert re.fullmatch(r"cartpole(-\d{4}-\d\d-\d\d)?", name)
    if len(codes) == 2:
        assert rest.pop(0) == f"launch /files/sweep.yaml {name}"
    if codes[-1] == 3:
        (said,) = rest
        assert said.startswith(f"The sweep {name} is over, but trials failed")
        assert said.endswith(f"tune-jobs trials {name}")
    elif codes[-1] == 130:
        # Else KubeRay would make a further cluster, which resumes what was stopped on request.
        (said,) = rest
        assert said.startswith(f"The sweep {name} was stopped on request, and stays so")
        assert said.endswith("delete this RayJob and apply it again" if folder == "sweep" else "the same storage")
    else:
        assert rest == []


@pytest.mark.parametrize(("folder", "kind"), [("sweep", "RayJob"), ("nightly", "RayCronJob")])
def test_a_job_that_a_signal_ends_is_not_taken_for_one_that_was_stopped_on_request(
    folder: str, kind: str, tmp_path: Path
) -> None:
    """Ray sends it to every process of a job, and the driver ends with the same code as on request."""
    entrypoint = entrypoint_of(folder, kind)
    program = tmp_path / "tune-jobs"
    program.write_text("#!/bin/sh\ntrap 'exit 130' TERM\necho runs\nwhile :; do sleep 0.1; done\n")
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    with subprocess.Popen(
        ["/bin/sh", "-c", entrypoint], env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as job:
        try:
            assert job.stdout is not None
            assert job.stdout.readline() == "runs\n"
            os.killpg(job.pid, signal.SIGTERM)
            assert job.wait(timeout=30) == -signal.SIGTERM
            assert job.stdout.read() == ""
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(job.pid, signal.SIGKILL)
