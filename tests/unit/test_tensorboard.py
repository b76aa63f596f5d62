"""TensorBoard's files, read back by a package that reads them."""

import math
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest
from s3_faults import Opened
from store_parts import make_iteration
from synthetic_sweep import make_sweep

from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.objects import parts
from tune_jobs.store.objects.bucket import Bucket, Tag
from tune_jobs.store.objects.outbox import outbox
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


def tags(event: Any) -> dict[str, float]:
    return {value.tag: value.simple_value for value in event.summary.value}


def test_scalars_are_read_back_of_every_iteration(tmp_path: Path) -> None:
    first, second = make_sweep().trials[:2]
    writer = ScalarWriter(SweepStore(tmp_path))
    learner = {"total_loss": 0.5, "entropy": 0.25, "kl": 0.0, "lr": None}
    one = make_iteration(1, training_return=-3.5, learner=learner)
    writer.write(first, [one, make_iteration(2, learner={"kl": 2.0})])
    writer.write(second, [make_iteration(1).model_copy(update={"num_env_steps": 0, "time_s": 0.0})])
    assert files(tmp_path, first.trial_id) == []
    writer.flush()
    writer.write(first, [make_iteration(3, evaluation_return=1e300)])
    writer.write(first, [])
    writer.flush()
    (path,) = files(tmp_path, first.trial_id)
    version, session, *events = read(path)
    assert version.file_version == "brain.Event:2"
    assert [value.tag for value in session.summary.value] == ["_hparams_/session_start_info"]
    assert [event.step for event in events] == [100, 200, 300]
    assert all(abs(event.wall_time - version.wall_time) < 60 for event in events)
    assert tags(events[0]) == {
        "training_return": -3.5, "num_episodes": 1.0, "env_steps_per_s": 100.0,
        "learner/total_loss": 0.5, "learner/entropy": 0.25, "learner/kl": 0.0,
    }  # fmt: skip
    assert tags(events[1])["learner/kl"] == 2.0
    assert tags(events[2])["evaluation_return"] == math.inf
    (path,) = files(tmp_path, second.trial_id)
    assert list(tags(read(path)[2])) == ["num_episodes"]


def test_a_run_that_goes_on_writes_a_file_of_its_own(tmp_path: Path) -> None:
    trial = make_sweep().trials[0]
    for iteration in (1, 2):
        writer = ScalarWriter(SweepStore(tmp_path))
        writer.write(trial, [make_iteration(iteration)])
        writer.flush()
    assert [len(read(path)) for path in files(tmp_path, trial.trial_id)] == [3, 3]


def test_a_trial_without_iterations_writes_nothing(tmp_path: Path) -> None:
    writer = ScalarWriter(SweepStore(tmp_path))
    writer.write(make_sweep().trials[0], [])
    writer.flush()
    assert not list(tmp_path.iterdir())


def test_the_hparams_tab_has_each_trial_with_its_searched_values(tmp_path: Path) -> None:
    points: list[dict[str, Any]] = [
        {"lr": 0.1, "hidden_sizes": [64, 32], "activation": "relu", "vf_share_layers": True, "grad_clip": None},
        {"lr": 0.2, "hidden_sizes": 64, "activation": "tanh", "vf_share_layers": False, "grad_clip": 1},
    ]
    writer = ScalarWriter(SweepStore(tmp_path))
    for trial, point in zip(make_sweep().trials, points, strict=False):
        whole = {**point, "hidden_sizes": [64, 32] if point["lr"] == 0.1 else [64]}
        writer.write(
            trial.model_copy(update={"point": point, "hyperparams": whole}), [make_iteration(1, training_return=3.0)]
        )
    writer.flush()
    experiment = hparams_of(tmp_path / "trials")
    infos = {info.name: info for info in experiment.hparam_infos}
    assert set(infos) == set(points[0])
    assert (infos["lr"].domain_interval.min_value, infos["lr"].domain_interval.max_value) == (0.1, 0.2)
    listed = {name: {item.string_value for item in info.domain_discrete.values} for name, info in infos.items()}
    assert listed["hidden_sizes"] == {"64x32", "64"}
    assert listed["activation"] == {"relu", "tanh"}
    assert listed["grad_clip"] == {"-", "1.0"}
    assert {item.bool_value for item in infos["vf_share_layers"].domain_discrete.values} == {True, False}
    assert {info.name.tag for info in experiment.metric_infos} == {
        "training_return", "num_episodes", "env_steps_per_s",
    }  # fmt: skip


def hparams_of(logdir: Path) -> Any:
    """What TensorBoard's tab HParams knows of a folder, by its own loader."""
    from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
    from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
    from tensorboard.context import RequestContext
    from tensorboard.plugins.base_plugin import TBContext
    from tensorboard.plugins.hparams.backend_context import Context

    multiplexer = EventMultiplexer()
    multiplexer.AddRunsFromDirectory(str(logdir))
    multiplexer.Reload()
    backend = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(logdir))))
    request = RequestContext()
    return backend.experiment_from_metadata(request, "", True, backend.hparams_metadata(request, ""), [])


def test_an_object_store_is_not_sent_a_long_curve_again_and_again(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(parts, "_EVENTS_BYTES", 1_000)
    sweep, trial, put = opened(), make_sweep().trials[0], Bucket.put
    sent = list[int]()

    def counted(self: Bucket, key: str, data: bytes, **given: Any) -> Tag:
        sent.append(len(data))
        return put(self, key, data, **given)

    monkeypatch.setattr(Bucket, "put", counted)
    writer = ScalarWriter(sweep)
    for iteration in range(1, 61):
        writer.write(trial, [make_iteration(iteration, training_return=float(iteration))])
        writer.flush()
        outbox().settle(sweep._parts.jobs)
    assert len(sent) == 60
    assert max(sent) < 1_500
    # As TensorBoard reads them, one after the other by their names.
    fetched = {item.key: tmp_path / item.key for item in sweep._bucket.listed()}
    assert all(sweep._bucket.fetch_all(fetched).values())
    first, *others = files(tmp_path, trial.trial_id)
    assert first.name == writer._name
    assert all(read(path) for path in others)
    found = EventAccumulator(str(first.parent)).Reload().Scalars("training_return")
    assert [(event.step, event.value) for event in found] == [(100 * n, n) for n in range(1, 61)]


def test_writing_event_files_loads_no_torch() -> None:
    code = (
        "import sys\n"
        "from analysis.records import IterationRecord, TrialRecord\n"
        "from tune_jobs.store.event_files import ScalarWriter\n"
        "record = TrialRecord(trial_id='t0000', index=0, point_index=0, seed=1, point={'lr': 0.1})\n"
        "iteration = IterationRecord(iteration=1, num_env_steps=1, num_episodes=1, time_s=1.0)\n"
        "ScalarWriter(None).write(record, [iteration])\n"
        "print(*(name in sys.modules for name in ('tensorboard', 'torch', 'tensorflow')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "True False False\n"
