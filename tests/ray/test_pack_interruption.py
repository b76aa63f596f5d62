"""A sweep in packs that is killed or interrupted goes on where it was: the real command, engine and signals."""

import json
import re
import signal
import subprocess
from pathlib import Path

import pytest
from test_interruption import PROGRAM, read, wait_until

pytestmark = pytest.mark.ray

# Two packs of two. Each iteration has 48 updates: when the first checkpoints are there, the last is seconds away.
SPEC = """
env: CartPole-v1
algorithm: ppo
engine: packed
hyperparams: {hidden_sizes: [128, 128], train_batch_size: 256, minibatch_size: 32, num_epochs: 6}
space: {lr: {loguniform: [1e-4, 1e-2]}}
num_samples: 5
stop: {num_env_steps: 12_000}
evaluation: {every_iterations: 3, num_episodes: 2}
checkpoints: {every_iterations: 3, keep: 1}
resources: {max_concurrent: 4}
"""


def has_checkpoint(folder: Path, index: int) -> bool:
    return any(folder.glob(f"trials/t000{index}/checkpoints/[0-9]*/manifest.json"))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_members_go_on_from_their_checkpoints(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC)
    folder = tmp_path / "sweeps" / "cut"
    command = [PROGRAM, "launch", "spec.yaml", "--name", "cut", "--no-finish"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: all(has_checkpoint(folder, index) for index in range(4)), process)
        process.send_signal(number)
        out, err = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == (-number if number == signal.SIGKILL else 130), out + err
    before = read(folder)
    assert "completed" not in [record["status"] for record in before]
    if number == signal.SIGINT:
        assert [record["status"] for record in before] == ["paused"] * 4 + ["pending"]
        assert all(record["checkpoints"][-1]["iteration"] == record["num_iterations"] for record in before[:4])
    latest = [
        max((int(path.name) for path in (folder / f"trials/t000{index}/checkpoints").glob("[0-9]*")), default=0)
        for index in range(4)
    ]
    assert min(latest) > 0
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
        assert steps[-1] >= 12_000 > steps[-2]
    for index, iteration in enumerate(latest):
        log = (folder / f"trials/t000{index}/log.txt").read_text()
        # A killed driver's packs train on for a moment.
        assert int(re.findall(r"built from checkpoint (\d+)", log)[-1]) >= iteration
