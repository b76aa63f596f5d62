"""Spare Ray Tune (2.60) work for every trial and report whose outcome nobody reads."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from ray.air.execution._internal import RayActorManager
from ray.tune.execution.tune_controller import TuneController
from ray.tune.experiment import Trial

from tune_jobs.ray_tune.replaced import replaced

_Report = TypeVar("_Report")


@dataclass(frozen=True, repr=False)
class Sealed(Generic[_Report]):
    """A report on its way through Tune.

    Tune takes dicts apart and keeps statistics of every number in them; and it writes each result as a text, twice, for
    messages that nobody sees, which for pydantic's models takes longer than all that is done with a report.
    """

    report: _Report


_WAIT_OF_TUNE_S = 0.1
# How long the driver waits for an event before it looks whether it is asked to stop, and whether its parts are there.
_WAIT_S = 0.5


@contextlib.contextmanager
def lean_run() -> Iterator[None]:
    """Spare Tune, in the block, what nobody reads; nothing public of Ray 2.60 leaves any of it out."""
    with (
        replaced(TuneController, "_get_trial_checkpoints", _no_trials),
        replaced(TuneController, "checkpoint", _at_the_end(TuneController.checkpoint)),
        replaced(RayActorManager, "next", _waiting_longer(RayActorManager.next)),
        replaced(Trial, "get_trainable_cls", _once(Trial.get_trainable_cls)),
        replaced(Trial, "set_ray_actor", _not_asked),
    ):
        yield


def _no_trials(_: Any) -> dict[str, str]:
    """Leave the trials out of the state that Tune saves: runs never go on from that, but from the sweep's records."""
    return {}


def _at_the_end(original: Callable[..., None]) -> Callable[..., None]:
    """Save Tune's state at the end alone, where Tune looks whether its file is there.

    How often it is saved while trials run can be set, but at each event Tune looks whether it is time to, which takes a
    fifth of a millisecond.
    """

    def checkpoint(controller: Any, force: bool = False, wait: bool = False) -> None:  # noqa: FBT001, FBT002 (Tune's)
        if force:
            original(controller, force=force, wait=wait)

    return checkpoint


def _waiting_longer(original: Callable[..., Any]) -> Callable[..., bool]:
    """Wait half a second for an event, and not a tenth: while trials train, to look for some is all that Tune does."""

    def following(manager: Any, timeout: float | None = None) -> bool:
        # Shorter ones are what is left of a wait; longer ones are those for processes that end.
        return bool(original(manager, timeout=_WAIT_S if timeout == _WAIT_OF_TUNE_S else timeout))

    return following


def _once(original: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Ask Ray's control process once what class a trial has, and not several times for each trial."""
    known: dict[str, Any] = {}

    def get(trial: Any) -> Any:
        if trial.trainable_name not in known:
            known[trial.trainable_name] = original(trial)
        return known[trial.trainable_name]

    return get


def _not_asked(trial: Any, actor: Any) -> None:
    """Note a trial's process, and don't ask it for a result in the place of those of trials that have reported nothing.

    That is two of the six calls of a process for a trial of three reports. At the end of such a trial Tune waited for
    the answer, which the process gives after its report.
    """
    trial.temporary_state.ray_actor = actor
