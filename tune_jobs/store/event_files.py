"""Write TensorBoard event files, one per trial: `tensorboard --logdir <sweep>/trials`."""

from __future__ import annotations

import io
import socket
import time
from collections import defaultdict

from analysis.records import TrialRecord
from tune_jobs.store.contract import Sweep

_FILE_VERSION = "brain.Event:2"


class ScalarWriter:
    """Writes a trial's returns and speed against its env steps.

    Args:
        sweep: The sweep that has the trials.
    """

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        # The files of this run: a run that continues a trial writes one more file beside the earlier ones.
        self._name = f"events.out.tfevents.{int(time.time()):010d}.{time.time_ns() % 10**9:09d}.{socket.gethostname()}"
        self._begun: set[str] = set()
        self._unwritten: defaultdict[str, io.BytesIO] = defaultdict(io.BytesIO)

    def write(self, record: TrialRecord, *, evaluated: bool) -> None:
        """Add the trial's current numbers, the evaluation return only where it is new; `flush` writes them to disk."""
        # Imported here because it takes 40 ms beside Ray, and is not needed before the first result.
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.record_writer import RecordWriter

        values = {
            "training_return": record.training_return,
            "evaluation_return": record.evaluation_return if evaluated else None,
            "num_episodes": record.num_episodes,
            "env_steps_per_s": record.num_env_steps / record.time_s if record.time_s else None,
        }
        known = [
            Summary.Value(tag=name, simple_value=float(value)) for name, value in values.items() if value is not None
        ]
        writer = RecordWriter(self._unwritten[record.trial_id])
        if record.trial_id not in self._begun:
            self._begun.add(record.trial_id)
            writer.write(Event(wall_time=time.time(), file_version=_FILE_VERSION).SerializeToString())
        event = Event(wall_time=time.time(), step=record.num_env_steps, summary=Summary(value=known))
        writer.write(event.SerializeToString())

    def flush(self) -> None:
        """Append what was added to the files."""
        for trial_id, data in self._unwritten.items():
            self._sweep.trial(trial_id).append_events(self._name, data.getvalue())
        self._unwritten.clear()
