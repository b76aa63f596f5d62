"""Of several processes that took something up, the last one alone writes."""

import multiprocessing
import threading
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest

from policies.errors import CannotRunError
from tune_jobs.store import ownership
from tune_jobs.store.ownership import Owner, OwnershipLostError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "t0000" / ".owner"


def epoch(path: Path) -> int:
    return int(path.read_text().split()[0])


def test_who_takes_it_has_a_larger_epoch_and_who_had_it_has_lost_it(path: Path) -> None:
    first = Owner.take(path)
    with first.held():
        pass
    second = Owner.take(path)
    assert epoch(path) == 2
    assert (first.is_current(), second.is_current()) == (False, True)
    with pytest.raises(OwnershipLostError, match="taken over by another process"), first.held():
        pytest.fail("entered")
    with pytest.raises(OwnershipLostError):
        first.check()
    with second.held():
        pass


def open_files(folder: Path) -> list[Path]:
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    return [link for link in links if str(link.readlink()).startswith(str(folder))]


def test_a_released_owner_has_no_file_open_and_can_still_write(path: Path) -> None:
    owner = Owner.take(path)
    for _ in range(2):
        with owner.held():
            assert len(open_files(path.parent)) == 1
        owner.release()
        assert open_files(path.parent) == []
    assert owner.is_current()


def test_a_token_can_be_passed_on(path: Path) -> None:
    token = Owner.take(path).token
    with Owner(path, token).held():
        pass
    Owner.take(path)
    assert not Owner(path, token).is_current()


def test_nobody_takes_it_between_the_check_and_the_write(path: Path) -> None:
    first, order = Owner.take(path), []

    def take() -> None:
        Owner.take(path)
        order.append("taken")

    with first.held():
        thread = threading.Thread(target=take)
        thread.start()
        thread.join(0.3)
        order.append("written")
    thread.join()
    assert order == ["written", "taken"]


def _count(path: Path, number: int, barrier: Barrier) -> None:
    """Take it, and count up in a file beside it until another one has taken it."""
    owner = Owner.take(path)
    barrier.wait()
    lost = False
    for _ in range(number):
        try:
            with owner.held():
                counter = path.with_name("counter")
                counter.write_text(str(int(counter.read_text()) + 1))
                with path.with_name("who").open("a") as file:
                    file.write(f"{owner.token.split()[0]}\n")
        except OwnershipLostError:
            lost = True
    if not lost:
        path.with_name("last").write_text(owner.token.split()[0])


def test_processes_that_write_at_once_write_one_after_the_other(path: Path) -> None:
    path.parent.mkdir()
    path.with_name("counter").write_text("0")
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(3)
    processes = [context.Process(target=_count, args=(path, 50, barrier)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(600)
    assert [process.exitcode for process in processes] == [0, 0, 0]
    # Each had taken it before any wrote: the last one alone did.
    assert path.with_name("last").read_text() == "3"
    assert path.with_name("who").read_text().split() == ["3"] * 50
    assert path.with_name("counter").read_text() == "50"


def test_what_is_taken_under_a_run_can_be_taken_no_more_when_the_run_is_over(tmp_path: Path, path: Path) -> None:
    old = Owner.take(tmp_path / ".owner")
    first = Owner.take(path, old)
    Owner.take(tmp_path / ".owner")
    # It keeps what it has until somebody takes it.
    assert first.is_current()
    with pytest.raises(OwnershipLostError):
        Owner.take(path, old)
    assert first.is_current()


@pytest.mark.parametrize("junk", [b"", b"\x00\xff", b"no number", b"7"])
def test_a_file_that_cannot_be_read_is_nobodys_and_can_be_taken(path: Path, junk: bytes) -> None:
    first = Owner.take(path)
    path.write_bytes(junk)
    assert not first.is_current()
    second = Owner.take(path)
    assert second.is_current()
    assert not first.is_current()


def test_a_link_is_not_followed(tmp_path: Path, path: Path) -> None:
    path.parent.mkdir()
    elsewhere = tmp_path / "elsewhere"
    path.symlink_to(elsewhere)
    with pytest.raises(CannotRunError, match="cannot be written"):
        Owner.take(path)
    assert not elsewhere.exists()


def test_a_folder_that_is_gone_is_nobodys(path: Path) -> None:
    owner = Owner.take(path)
    path.unlink()
    path.parent.rmdir()
    assert not owner.is_current()


def test_a_process_that_holds_it_for_ever_is_named(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "_PATIENCE_S", 0.2)
    first = Owner.take(path)
    with first.held(), pytest.raises(CannotRunError, match="has been locked") as caught:
        Owner.take(path)
    assert first.token in str(caught.value)
    assert first.is_current()
