"""The Dockerfile's commands and the compose file's services, run as they stand; there is no engine to do so."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from image import Image, Root, read_compose, why_not

pytestmark = [pytest.mark.package, pytest.mark.cluster]
ROOT = Path(__file__).parents[2]
TOKEN = "0123456789abcdef" * 4


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    if reason := why_not():
        pytest.skip(reason)
    with Root() as root:
        # Not compiled by pip, file by file: Python compiles what is imported, a fifth of it. It does so elsewhere, as
        # the user of the containers may write nothing in the image's own folders.
        image = Image(root, {"PIP_COMPILE": "0"})
        image.build(ROOT / "docker" / "Dockerfile", ROOT)
        image.environment["PYTHONPYCACHEPREFIX"] = "/tmp/compiled"
        root.cut_off()
        # As compose and Kubernetes have it; the volumes are tune's.
        root.make_read_only("/sweeps", "/files")
        root.run(["chown", f"{image.user}:{image.user}", "/sweeps"], environment=image.environment)
        yield image


MOST_BYTES = 1_500_000_000


def canonical(name: str) -> str:
    """A package's name as the index compares it."""
    return re.sub("[-_.]+", "-", name).lower()


def test_the_image_holds_the_pinned_versions_and_nothing_runs_as_root(image: Image) -> None:
    assert image.run(["id", "-un"], environment={}).stdout == "tune\n"
    assert "Usage: tune-jobs" in image.run(image.command, environment={}).stdout
    done = image.run(["pip", "list", "--format=json"], environment={})
    installed = {
        canonical(package["name"]): package["version"].partition("+")[0]
        # pip warns that its cache cannot be written, as nothing can.
        for package in json.loads(next(line for line in done.stdout.splitlines() if line.startswith("[")))
    }
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    pins = {canonical(name): version for name, version in pins.items()}
    ours = {"pip", "tune-jobs"}
    assert {name: version for name, version in installed.items() if pins.get(name) != version}.keys() == ours
    assert {"ray", "torch", "gymnasium"} <= installed.keys()
    assert image.run(["touch", "/opt/tune-jobs/file"], environment={}).returncode != 0
    assert image.run(["touch", "/sweeps/file"], environment={}).returncode == 0
    assert image.run(["rm", "/sweeps/file"], environment={}).returncode == 0


def test_the_image_is_no_larger_than_promised(image: Image) -> None:
    built = ["python", "-c", "import torch; print(torch.version.cuda)"]
    if image.run(built, environment=image.environment).stdout.strip() != "None":
        pytest.skip("the index has PyTorch's build for CUDA")
    done = image.run(["du", "--bytes", "--apparent-size", "--summarize", "/opt/tune-jobs"], environment={})
    installed = int(done.stdout.split()[0])
    # Its publisher's figure; no engine builds it here.
    base = 130_000_000
    assert installed + base < MOST_BYTES, installed


def test_the_composed_services_run_a_sweep_on_two_workers(image: Image, tmp_path: Path) -> None:
    compose = read_compose(ROOT / "docker" / "compose.yaml", {"RAY_AUTH_TOKEN": TOKEN, "WORKER_CPUS": "1"})
    services = compose["services"]
    head_log = tmp_path / "head.log"
    head = image.begin(services["head"]["command"], environment=services["head"]["environment"], log=head_log)
    image.wait_until_healthy(services["head"], head, head_log)
    # The image's own check, too, which knows whether it is a node.
    assert image.run(["sh", "-c", image.healthcheck], environment=services["head"]["environment"]).returncode == 0
    for number in range(2):
        log = tmp_path / f"worker-{number}.log"
        worker = image.begin(services["worker"]["command"], environment=services["worker"]["environment"], log=log)
        image.wait_until_healthy(services["worker"], worker, log)
        # All share one network here, so that the head's agent answers for a worker; and one worker after the other, as
        # they would choose the same ports. That it has joined is seen in the cluster's CPUs.
        status = ["ray", "status", "--address", "head:6379"]
        image.wait_until(status, rf"/{number + 1}\.0 CPU", environment=services["head"]["environment"])
    launcher = services["launcher"]
    # Two packs, which ask for a CPU each at once: one on each worker, however short the trials.
    settings = ["num_samples=1", "stop.num_env_steps=8000", "stop.training_return=null", "evaluation.num_episodes=2"]
    arguments = ["launch", "mine.yaml", "--address", "auto", "--json"]
    for setting in settings:
        arguments += ["--set", setting]
    files = image.root.path(launcher["working_dir"])
    shutil.copy(ROOT / "tune_jobs" / "spec" / "presets" / "cartpole-ppo.yaml", files / "mine.yaml")
    # Begun early: Ray tries for 20 s before it gives up.
    stranger = image.begin(
        [*launcher["entrypoint"], *arguments, "--address", "head:6379"],
        environment={**launcher["environment"], "RAY_AUTH_TOKEN": TOKEN[::-1]},
        workdir=launcher["working_dir"],
    )
    done = image.run(
        launcher["entrypoint"] + arguments, environment=launcher["environment"], workdir=launcher["working_dir"]
    )
    assert done.returncode == 0, done.stdout[-4000:] + head_log.read_text()[-2000:]
    folder = image.root.path("/sweeps/mine")
    trials = [json.loads(path.read_text()) for path in sorted(folder.glob("trials/*/trial.json"))]
    # Four, and two that confirm the setting.
    assert [trial["status"] for trial in trials] == ["completed"] * 6
    # The head takes no trials; the two workers share them.
    assert len({trial["node"] for trial in trials}) == 2
    for name in ("best/policy.safetensors", "best/after.mp4", "report/index.html"):
        assert (folder / name).stat().st_size > 0
    out, _ = stranger.communicate(timeout=300)
    assert stranger.returncode == 5
    assert b"does not accept this machine's token" in out
