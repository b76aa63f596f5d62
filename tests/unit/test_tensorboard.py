"""TensorBoard's files, read back by a package that reads them."""

import math
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest
from synthetic_sweep import make_sweep

from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.sweep_store import SweepStore

event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
crc32c = pytest.importorskip("tensorboardX.crc32c")
ROOT = Path(__file__).parents[2]


def masked(data: bytes) -> int:
    crc = crc32c.crc32c(data)
    return cast("int", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def read(path: Path) -> list[Any]:
    """Every event of a file, its checksums checked."""
    data, events = path.read_bytes(), []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        assert struct.unpack("<I", data[8:12]) == (masked(data[:8]),)
        body = data[12 : 12 + length]
        assert struct.unpack("<I", data[12 + length : 16 + length]) == (masked(body),)
        events.append(event_pb2.Event.FromString(body))
        data = data[16 + length :]
    return events


def files(folder: Path, trial_id: str) -> list[Path]:
    return sorted((folder / "trials" / trial_id / "tensorboard").glob("events.out.tfevents.*"))


def test_scalars_are_read_back(tmp_path: Path) -> None:
    first, second = make_sweep().trials[:2]
    first = first.model_copy(update={"num_env_steps": 300_000, "time_s": 2.0, "training_return": -3.5})
    writer = ScalarWriter(SweepStore(tmp_path))
    writer.write(first, evaluated=False)
    writer.write(
        second.model_copy(update={"num_env_steps": 0, "time_s": 0.0, "training_return": None}), evaluated=False
    )
    assert files(tmp_path, first.trial_id) == []
    writer.flush()
    writer.write(first.model_copy(update={"num_env_steps": 300_100, "evaluation_return": 1e300}), evaluated=True)
    writer.flush()
    (path,) = files(tmp_path, first.trial_id)
    version, *events = read(path)
    assert version.file_version == "brain.Event:2"
    assert [event.step for event in events] == [300_000, 300_100]
    assert all(abs(event.wall_time - version.wall_time) < 60 for event in events)
    told = [{value.tag: value.simple_value for value in event.summary.value} for event in events]
    assert told[0] == {"training_return": -3.5, "num_episodes": first.num_episodes, "env_steps_per_s": 150_000.0}
    assert told[1]["evaluation_return"] == math.inf
    (path,) = files(tmp_path, second.trial_id)
    assert [value.tag for value in read(path)[1].summary.value] == ["num_episodes"]


def test_a_run_that_goes_on_writes_a_file_of_its_own(tmp_path: Path) -> None:
    trial = make_sweep().trials[0]
    for _ in range(2):
        writer = ScalarWriter(SweepStore(tmp_path))
        writer.write(trial, evaluated=True)
        writer.flush()
    assert [len(read(path)) for path in files(tmp_path, trial.trial_id)] == [2, 2]


def test_writing_event_files_loads_no_torch() -> None:
    code = (
        "import sys, types\n"
        "from tune_jobs.store.event_files import ScalarWriter\n"
        "fields = dict.fromkeys(['training_return', 'evaluation_return', 'num_episodes', 'time_s'], 1.0)\n"
        "record = types.SimpleNamespace(trial_id='t0000', num_env_steps=1, **fields)\n"
        "ScalarWriter(None).write(record, evaluated=True)\n"
        "print('tensorboard' in sys.modules, 'torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "True False\n"
