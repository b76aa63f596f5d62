"""TensorBoard event files, one a trial: `tensorboard --logdir <sweep>/trials`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.records import TrialRecord

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter


class ScalarWriter:
    """Writes a trial's returns and speed against its env steps.

    Args:
        sweep_folder: Files go to trials/<trial id>/tensorboard in it.
    """

    def __init__(self, sweep_folder: Path) -> None:
        self._folder = sweep_folder
        self._writers: dict[str, SummaryWriter] = {}

    def write(self, record: TrialRecord, *, evaluated: bool) -> None:
        """Add the trial's current numbers; the evaluation return only where it is new."""
        writer = self._writers.get(record.trial_id)
        if writer is None:
            # It imports torch, which nothing else here needs: not before the first result is on the screen.
            from tensorboardX import SummaryWriter

            logdir = self._folder / "trials" / record.trial_id / "tensorboard"
            writer = self._writers[record.trial_id] = SummaryWriter(str(logdir), flush_secs=5)
        values = {
            "training_return": record.training_return,
            "evaluation_return": record.evaluation_return if evaluated else None,
            "num_episodes": record.num_episodes,
            "env_steps_per_s": record.num_env_steps / record.time_s if record.time_s else None,
        }
        for name, value in values.items():
            if value is not None:
                writer.add_scalar(name, value, record.num_env_steps)

    def close(self, trial_id: str) -> None:
        """The trial has ended."""
        writer = self._writers.pop(trial_id, None)
        if writer is not None:
            writer.close()

    def close_all(self) -> None:
        """Every trial has."""
        for trial_id in list(self._writers):
            self.close(trial_id)
