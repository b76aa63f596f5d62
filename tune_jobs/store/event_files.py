"""Write TensorBoard event files, one per trial: `tensorboard --logdir <sweep>/trials`."""

from __future__ import annotations

import io
import socket
import time
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

from analysis.records import IterationRecord, TrialRecord
from analysis.wording import setting_text
from tune_jobs.store.contract import Sweep

if TYPE_CHECKING:
    from tensorboard.compat.proto.summary_pb2 import Summary

_FILE_VERSION = "brain.Event:2"


class ScalarWriter:
    """Writes what a trial's iterations measured against its env steps, and its searched values for the tab HParams.

    Args:
        sweep: The sweep that has the trials.
    """

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        # The files of this run: a run that continues a trial writes one more file beside the earlier ones.
        self._name = f"events.out.tfevents.{int(time.time()):010d}.{time.time_ns() % 10**9:09d}.{socket.gethostname()}"
        self._begun: set[str] = set()
        self._unwritten: defaultdict[str, io.BytesIO] = defaultdict(io.BytesIO)

    def write(self, record: TrialRecord, iterations: Sequence[IterationRecord]) -> None:
        """Add iterations of a trial, each once; `flush` writes them to disk.

        Args:
            record: The trial.
            iterations: Its iterations since the last call, oldest first; without any nothing is added.
        """
        if not iterations:
            return
        # Imported here because it takes 40 ms beside Ray, and is not needed before the first result.
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.record_writer import RecordWriter

        writer = RecordWriter(self._unwritten[record.trial_id])
        now = time.time()
        if record.trial_id not in self._begun:
            self._begun.add(record.trial_id)
            writer.write(Event(wall_time=now, file_version=_FILE_VERSION).SerializeToString())
            writer.write(Event(wall_time=now, summary=_session(record, now)).SerializeToString())
        for iteration in iterations:
            values = [Summary.Value(tag=name, simple_value=value) for name, value in _scalars(iteration).items()]
            event = Event(wall_time=now, step=iteration.num_env_steps, summary=Summary(value=values))
            writer.write(event.SerializeToString())

    @property
    def has_any(self) -> bool:
        """Whether there is anything that `flush` would write."""
        return bool(self._unwritten)

    def flush(self) -> None:
        """Append what was added to the files."""
        for trial_id, data in self._unwritten.items():
            self._sweep.trial(trial_id).append_events(self._name, data.getvalue())
        self._unwritten.clear()


def _scalars(iteration: IterationRecord) -> dict[str, float]:
    """Return what an iteration measured, by the names that iterations.csv has for it."""
    values = {
        "training_return": iteration.training_return,
        "evaluation_return": iteration.evaluation_return,
        "num_episodes": iteration.num_episodes,
        "env_steps_per_s": iteration.num_env_steps / iteration.time_s if iteration.time_s else None,
        **{f"learner/{name}": value for name, value in iteration.learner.items()},
    }
    return {name: float(value) for name, value in values.items() if value is not None}


def _session(record: TrialRecord, now: float) -> Summary:
    """Return the summary that makes a trial a session of the tab HParams, grouped with the other seeds of its point.

    TensorBoard finds out from the sessions of all trials which values each hyperparameter takes.
    """
    # Not by summary_v2 of that plugin, which wants TensorFlow or a stand-in for it.
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import metadata, plugin_data_pb2

    start = plugin_data_pb2.SessionStartInfo(
        group_name=f"point {record.point_index}",
        start_time_secs=now if record.started_at is None else record.started_at,
    )
    for name, sampled in record.point.items():
        # As training has it: a single size among lists of them is a list there.
        value = record.hyperparams.get(name, sampled)
        if isinstance(value, bool):
            start.hparams[name].bool_value = value
        elif isinstance(value, int | float):
            start.hparams[name].number_value = value
        else:
            start.hparams[name].string_value = setting_text(value)
    data = plugin_data_pb2.HParamsPluginData(session_start_info=start)
    value = Summary.Value(
        tag=metadata.SESSION_START_INFO_TAG,
        metadata=metadata.create_summary_metadata(data),
        tensor=metadata.NULL_TENSOR,
    )
    return Summary(value=[value])
