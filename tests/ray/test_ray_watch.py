"""When a part of Ray counts as dead, and what then fails because of it."""

import socket
import threading
from functools import partial

import pytest

pytestmark = pytest.mark.ray


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_part_is_dead_when_it_has_been_silent_for_long() -> None:
    from tune_jobs.ray_tune.processes import RayDiedError, RayWatch

    clock, answers = Clock(), {"this": True, "that": True}
    watch = RayWatch({name: partial(answers.__getitem__, name) for name in answers}, 10.0, clock)

    def look(at: float) -> None:
        clock.now = at
        watch.look()
        watch.check()

    look(0.0)
    answers["that"] = False
    look(5.0)
    look(14.9)
    # It was started again: the time counts from the beginning.
    answers["that"] = True
    look(16.0)
    answers["that"] = False
    look(20.0)
    look(29.0)
    with pytest.raises(RayDiedError, match="that"):
        look(30.0)


def test_what_a_trial_raised_is_not_waited_for() -> None:
    from ray.exceptions import RaySystemError, RayTaskError

    from tune_jobs.ray_tune.processes import RayDiedError, RayWatch

    watch = RayWatch({"it": lambda: False}, 0.2)
    watch.check_after(RayTaskError("step", "Traceback", ValueError("of the env")))
    with pytest.raises(RayDiedError, match="it"):
        watch.check_after(RuntimeError("of Ray"))
    # Its env runners were lost with Ray, and the trial was the first to notice.
    with pytest.raises(RayDiedError, match="it"):
        watch.check_after(RayTaskError("step", "Traceback", RaySystemError("an env runner is gone")))
    assert not issubclass(RayDiedError, Exception)


def test_a_block_that_goes_on_is_stuck() -> None:
    from tune_jobs.ray_tune.processes import RayDiedError, RayWatch

    told = threading.Event()
    deaths: list[str] = []

    def tell(death: RayDiedError) -> None:
        deaths.append(str(death))
        told.set()

    with RayWatch({"it": lambda: False}, 0.05, stuck_s=0.05) as watch:
        watch.when_stuck = tell
        assert told.wait(60)
    assert deaths == ["it"]
    with RayWatch({"it": lambda: False}, 0.05, stuck_s=3600) as watch:
        watch.when_stuck = lambda death: deaths.append("too early")
    watch._thread.join(60)
    assert deaths == ["it"]


def test_a_block_that_was_asked_to_end_is_stuck_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    from tune_jobs.ray_tune import processes

    monkeypatch.setattr(processes, "_STOPPING_S", 0.05)
    told = threading.Event()
    with processes.RayWatch({"it": lambda: False}, 0.05, stuck_s=3600) as watch:
        watch.when_stuck = lambda death: told.set()
        watch.hurries = lambda: True
        assert told.wait(60)
    told.clear()
    with processes.RayWatch({"it": lambda: False}, 0.05, stuck_s=3600) as watch:
        watch.when_stuck = lambda death: told.set()
        assert not told.wait(1)
        # Somebody asks after the part has died.
        watch.hurries = lambda: True
        assert told.wait(60)


def test_it_looks_by_itself_and_ends_with_its_block() -> None:
    from tune_jobs.ray_tune.processes import RayDiedError, RayWatch, _answers

    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        assert _answers(socket.AF_INET, address)
    looked = threading.Event()

    def probe() -> bool:
        looked.set()
        return _answers(socket.AF_INET, address)

    with RayWatch({"it": probe}, 0.05) as watch:
        assert looked.wait(60)
        watch._thread.join(60)  # it has seen enough
        with pytest.raises(RayDiedError):
            watch.check()
    with RayWatch({"it": lambda: True}, 0.05) as watch:
        pass
    watch._thread.join(60)
    assert not watch._thread.is_alive()
