"""A sweep in packs that is killed or interrupted goes on where it was: the real command, engine and signals."""

import functools
import json
import re
import signal
import subprocess
from pathlib import Path

import pytest
from test_interruption import PROGRAM, read, wait_until

pytestmark = pytest.mark.ray

NUM_ENV_STEPS = 2_560
# Two packs of two, and a fifth; slow, by waiting, while the file SLOW is there.
SPEC = f"""
env: {{id: TestTrouble-v0, args: {{pause_s: 0.005, pause_while: "SLOW"}}}}
algorithm: ppo
engine: packed
hyperparams: {{hidden_sizes: [8], num_envs: 4, train_batch_size: 128, minibatch_size: 64, num_epochs: 2}}
space: {{lr: {{loguniform: [1e-4, 1e-2]}}}}
num_samples: 5
stop: {{num_env_steps: {NUM_ENV_STEPS}}}
evaluation: {{every_iterations: 2, num_episodes: 2}}
checkpoints: {{every_iterations: 2, keep: 1}}
resources: {{max_concurrent: 4}}
"""
MEMBERS = [f"t000{index}" for index in range(4)]


def newest_checkpoints(folder: Path) -> list[int]:
    """Of the members, their iterations; 0: none."""
    found = []
    for name in MEMBERS:
        paths = folder.glob(f"trials/{name}/checkpoints/[0-9]*/manifest.json")
        found.append(max((int(path.parent.name) for path in paths), default=0))
    return found


def all_have_newer(folder: Path, latest: list[int]) -> bool:
    return all(new > old for new, old in zip(newest_checkpoints(folder), latest, strict=True))


def test_members_go_on_from_their_checkpoints_after_a_kill_and_an_interruption(
    env_plugin: None, tmp_path: Path
) -> None:
    slow = tmp_path / "slow"
    slow.touch()
    (tmp_path / "spec.yaml").write_text(SPEC.replace("SLOW", str(slow)))
    folder = tmp_path / "sweeps" / "cut"
    command, latest = ["launch", "spec.yaml", "--name", "cut"], [0] * 4
    for number in (signal.SIGKILL, signal.SIGINT):
        process = subprocess.Popen(
            [PROGRAM, *command, "--no-finish"], cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            wait_until(functools.partial(all_have_newer, folder, latest), process)
            process.send_signal(number)
            out, err = process.communicate(timeout=600)
        finally:
            process.kill()
        assert process.returncode == (-number if number == signal.SIGKILL else 130), out + err
        before = read(folder)
        assert "completed" not in [record["status"] for record in before]
        check_built_from(folder, latest)
        latest = newest_checkpoints(folder)
        command = ["resume", "cut"]
    assert [record["status"] for record in before] == ["paused"] * 4 + ["pending"]
    assert all(record["checkpoints"][-1]["iteration"] == record["num_iterations"] for record in before[:4])
    slow.unlink()
    done = subprocess.run(
        [PROGRAM, "resume", str(folder), "--json", "--no-finish"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    records = read(folder)
    assert [record["status"] for record in records] == ["completed"] * 5
    assert [record["hyperparams"] for record in records] == [record["hyperparams"] for record in before]
    for record in records:
        lines = [json.loads(line) for line in (folder / f"trials/{record['trial_id']}/results.jsonl").open()]
        assert [line["iteration"] for line in lines] == list(range(1, len(lines) + 1))
        steps = [line["num_env_steps"] for line in lines]
        assert steps == sorted(steps)
        assert steps[-1] >= NUM_ENV_STEPS > steps[-2]
    check_built_from(folder, latest)


def check_built_from(folder: Path, latest: list[int]) -> None:
    """That the members' last processes went on from checkpoints; none is older than those."""
    for name, iteration in zip(MEMBERS, latest, strict=True):
        log = (folder / f"trials/{name}/log.txt").read_text()
        # A killed driver's packs train on for a moment.
        assert iteration == 0 or int(re.findall(r"built from checkpoint (\d+)", log)[-1]) >= iteration
