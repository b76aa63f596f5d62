"""A sweep in packs that is killed or interrupted goes on where it was: the real command, engine and signals."""

import json
import re
import signal
import subprocess

import pytest
from test_interruption import PROGRAM, read, wait_until

pytestmark = pytest.mark.ray

# Two packs of two.
SPEC = """
env: CartPole-v1
algorithm: ppo
engine: packed
hyperparams: {train_batch_size: 256, minibatch_size: 128, num_epochs: 2}
space: {lr: {loguniform: [1e-4, 1e-2]}}
num_samples: 5
stop: {num_env_steps: 60_000}
evaluation: {every_iterations: 3, num_episodes: 2}
checkpoints: {every_iterations: 3, keep: 1}
resources: {max_concurrent: 4}
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_members_go_on_from_their_checkpoints(tmp_path, number):
    (tmp_path / "spec.yaml").write_text(SPEC)
    folder = tmp_path / "sweeps" / "cut"
    command = [PROGRAM, "launch", "spec.yaml", "--name", "cut", "--no-finish"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: len(list(folder.glob("trials/*/checkpoints/[0-9]*/manifest.json"))) >= 4, process)
        process.send_signal(number)
        out, err = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == (-number if number == signal.SIGKILL else 130), out + err
    before = read(folder)
    assert "completed" not in [record["status"] for record in before]
    if number == signal.SIGINT:
        # On a busy machine one pack may not have begun yet: its members have nothing to save.
        begun = [record for record in before if record["checkpoints"]]
        assert begun
        assert [record["num_iterations"] for record in before if not record["checkpoints"]] == [0] * (5 - len(begun))
        assert {record["status"] for record in begun} == {"paused"}
        assert {record["status"] for record in before} <= {"paused", "pending"}
        assert all(record["checkpoints"][-1]["iteration"] == record["num_iterations"] for record in begun)
    latest = [
        max((int(path.name) for path in (folder / f"trials/t000{index}/checkpoints").glob("[0-9]*")), default=0)
        for index in range(4)
    ]
    assert max(latest) > 0
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
        assert steps[-1] >= 60_000 > steps[-2]
    for index, iteration in enumerate(latest):
        if iteration:
            log = (folder / f"trials/t000{index}/log.txt").read_text()
            # A killed driver's packs train on for a moment.
            assert int(re.findall(r"built from checkpoint (\d+)", log)[-1]) >= iteration
