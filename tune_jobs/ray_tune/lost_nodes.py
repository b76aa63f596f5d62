"""Tell the loss or refusal of a node from the failure of what ran there: only the latter counts against retries.

Ray Tune counts both, and decides by that count before it calls anybody. Nothing public of Ray 2.60 says otherwise, so
the method of Tune's trials that counts is replaced for a run.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import ray
from ray.air.execution._internal import RayActorManager
from ray.exceptions import OutOfMemoryError, RayActorError, RayError, RayTaskError
from ray.tune import PlacementGroupFactory
from ray.tune.experiment import Trial
from ray.util.placement_group import NODE_ID_LABEL_KEY

from policies.errors import TuneJobsError
from tune_jobs.ray_tune.replaced import replaced

_CONNECT_TIMEOUT_S = 2.0
# A machine that is taken away says so 30 s before at the least (Google Cloud); Ray is asked by each training process.
_ASK_INTERVAL_S = 3.0
# A trial that takes its node down each time, by its memory say, must not do so for ever.
_MOST_WITHOUT_PROGRESS = 5


class NodeLeavesError(TuneJobsError):
    """The node of a training process is about to be taken away; what it trained is saved."""


class NodeRefusedError(TuneJobsError):
    """A node that joined while the sweep ran can't take part in it; nothing was trained there.

    Args:
        message: Which node, and why.
        hint: What to do there.
        node_id: The node, as Ray names it.
    """

    def __init__(self, message: str, hint: str = "", node_id: str = "") -> None:
        super().__init__(message, hint)
        self.node_id = node_id


def node_that_left(error: BaseException | None) -> str:
    """Return the node whose loss or refusal, and nothing else, ended an actor; empty if there was another reason.

    Args:
        error: What Ray raised for the actor, or for an actor that it waited for.
    """
    cause = error.cause if isinstance(error, RayTaskError) else error
    if isinstance(cause, NodeLeavesError):
        return cause.message
    if isinstance(cause, NodeRefusedError):
        return f"{cause.message} {cause.hint}".strip()
    actor_id = cause.actor_id if isinstance(cause, RayActorError) else None
    if not actor_id:
        return ""
    with contextlib.suppress(RayError, ValueError):
        state: Any = ray._private.state  # noqa: SLF001 (what is public asks the dashboard, which may not run)
        node_id = (state.actors(actor_id).get("Address") or {}).get("NodeID")
        if node_id == ray.get_runtime_context().get_node_id():
            # What would be left of this driver then is told by `RayWatch`.
            return ""
        for node in ray.nodes():
            if node["NodeID"] == node_id and not _is_there(node):
                return f"Node {node['NodeManagerAddress']} ({node_id[:8]}) was lost."
    return ""


def _is_there(node: dict[str, Any]) -> bool:
    """Whether a node's Ray answers, which Ray itself may take a minute to find out."""
    if not node["Alive"]:
        return False
    try:
        with socket.create_connection((node["NodeManagerAddress"], node["NodeManagerPort"]), _CONNECT_TIMEOUT_S):
            return True
    except OSError:
        return False


@contextlib.contextmanager
def _surviving_lack_of_memory() -> Iterator[None]:
    """For the block, let an actor that Ray ends for its node's memory be one that died.

    Ray 2.60 raises an error of another kind for it than for other deaths, at which Tune ends the whole run.
    """
    original = RayActorManager._actor_task_failed  # noqa: SLF001

    def failed(manager: Any, tracked_actor_task: Any, exception: Exception) -> None:
        if isinstance(exception, OutOfMemoryError):
            died = RayActorError()
            died.__cause__ = exception
            exception = died
        original(manager, tracked_actor_task=tracked_actor_task, exception=exception)

    with replaced(RayActorManager, "_actor_task_failed", failed):
        yield


class NodeLosses:
    """Knows which of a run's failures were losses of a node; while it is entered, Tune does not count those.

    Args:
        reached: Returns of one of Tune's trials what grows with its checkpoints. After five losses in a row without
            any progress the next ones are failures, as the trial may be their cause.
        before: Called with each error, before anything is asked of Ray.
    """

    def __init__(self, reached: Callable[[Trial], Hashable], before: Callable[[BaseException], None]) -> None:
        self._reached, self._before = reached, before
        self._in_vain: dict[str, tuple[Hashable, int]] = {}
        self._told: dict[str, str] = {}
        self._errors: dict[str, BaseException | None] = {}
        self._refused: set[str] = set()

    def __getstate__(self) -> dict[str, Any]:
        # As for `RecordKeeper`, Tune's pickle of what uses this is never read back.
        return {}

    @contextlib.contextmanager
    def not_counted(self) -> Iterator[None]:
        """For the block, let Tune count failures alone."""
        original = Trial.handle_error

        def handle_error(trial: Trial, exc: Any = None) -> None:
            counted = trial.run_metadata.num_failures
            # Tune keeps only errors of two kinds, in a file; that an actor was ended for its memory is another.
            self._errors[trial.trial_id] = exc
            left = self._node_that_left(trial, exc)
            original(trial, exc)
            if left:
                self._keep_away(trial, exc)
                trial.run_metadata.num_failures = counted
                trial.run_metadata.invalidate_cache()

        with replaced(Trial, "handle_error", handle_error), _surviving_lack_of_memory():
            yield

    def take(self, trial: Trial) -> str:
        """Return the node whose loss was the trial's last error, once; empty: it was a failure."""
        return self._told.pop(trial.trial_id, "")

    def error_of(self, trial: Trial) -> BaseException | None:
        """Return the trial's last error."""
        return self._errors.get(trial.trial_id)

    def _keep_away(self, trial: Trial, error: BaseException | None) -> None:
        """Let a trial go to none of the nodes that were refused so far; those that wait for their place stay as is."""
        cause = error.cause if isinstance(error, RayTaskError) else error
        if not isinstance(cause, NodeRefusedError) or not cause.node_id:
            return
        self._refused.add(cause.node_id)
        asked = trial.placement_group_factory
        elsewhere = {NODE_ID_LABEL_KEY: f"!in({','.join(sorted(self._refused))})"}
        # What Tune has for this refuses a trial that runs; of this one's process nothing is left, and Tune asks anew.
        trial.placement_group_factory = PlacementGroupFactory(
            asked.bundles, strategy=asked.strategy, bundle_label_selector=[elsewhere] * len(asked.bundles)
        )

    def _node_that_left(self, trial: Trial, error: BaseException | None) -> str:
        if error is None:
            return ""
        self._before(error)
        left = node_that_left(error)
        if left:
            reached = self._reached(trial)
            before, times = self._in_vain.get(trial.trial_id, (None, 0))
            times = times + 1 if before == reached else 1
            self._in_vain[trial.trial_id] = (reached, times)
            if times > _MOST_WITHOUT_PROGRESS:
                left = ""
        self._told[trial.trial_id] = left
        return left


class DrainNotice:
    """Notices, in a process on a node, that Ray drains the node, as is done before a spot machine is taken away.

    Args:
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._asked_at = -_ASK_INTERVAL_S
        self._node_id = str(ray.get_runtime_context().get_node_id())

    @property
    def came(self) -> bool:
        """Whether the node is being drained; Ray is asked every few seconds at most."""
        if self._clock() - self._asked_at < _ASK_INTERVAL_S:
            return False
        self._asked_at = self._clock()
        state: Any = ray._private.state  # noqa: SLF001 (told nowhere else)
        # A control process that doesn't answer is the driver's business.
        with contextlib.suppress(RayError, ValueError):
            return self._node_id in state.state.get_draining_nodes()
        return False

    def error(self) -> NodeLeavesError:
        """Return the error to end this process with."""
        place = f"{ray.util.get_node_ip_address()} ({self._node_id[:8]})"
        return NodeLeavesError(f"Node {place} was drained.", "What it trained is saved, and goes on elsewhere.")
