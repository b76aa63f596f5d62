"""Named pipes, folders and sockets where a sweep has files: nobody waits for them, and our words refuse them."""

import contextlib
import json
import os
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import odd_files
import pytest
from store_parts import make_iteration
from sweep_folders import train

from policies.acting.load import load_policy
from policies.envs import modules as env_modules
from policies.envs.tallies import read_tally
from policies.errors import CannotRunError, CheckpointError, TuneJobsError
from policies.files import MAX_RECORD_BYTES, open_to_append, read_regular, sha256_file
from tune_jobs.process.streams import quiet
from tune_jobs.store.candidates import candidates
from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.locks import held
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.ownership import Owner
from tune_jobs.store.pack_files import PackFiles
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.sweeps import resume as resuming
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.drive import settled


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return odd_files.make_template(tmp_path_factory.mktemp("template") / "mine")


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    return shutil.copytree(template, tmp_path / "mine")


@pytest.fixture(autouse=True)
def _no_modules_stay_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())


class WaitedError(Exception):
    """Somebody would have waited for ever."""


@pytest.fixture(autouse=True)
def _nobody_waits() -> Iterator[None]:
    def end(*_: object) -> None:
        raise WaitedError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def make_socket(path: Path) -> None:
    # Paths of sockets are short.
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path.name)


KINDS = {"named pipe": os.mkfifo, "folder": os.mkdir, "socket": make_socket}


def take(path: str) -> Callable[..., Any]:
    def act(folder: Path) -> None:
        Owner.take(folder / path).check()

    return act


def lock(folder: Path) -> None:
    store = SweepStore(folder)
    with store.lock(), settled(store):
        pass


def keep(folder: Path) -> None:
    keeper = RecordKeeper(SweepStore(folder), ["t0001"], lambda record: None)
    keeper.started("t0001")
    keeper.failed("t0001", "it broke", retried=False)
    keeper.close()


def scalars(folder: Path) -> None:
    writer = ScalarWriter(SweepStore(folder))
    writer.write(SweepStore(folder).trial("t0000").read_record(), [make_iteration(1)])
    writer.flush()


def show(folder: Path) -> None:
    with quiet(SweepStore(folder).driver_log):
        pass


def trial(folder: Path) -> TrialStore:
    return SweepStore(folder).trial("t0001")


def go_on(folder: Path) -> None:
    train(SweepStore(folder), "t0001", 7)


CHECKPOINT = odd_files.CHECKPOINT
USES = {
    "sweep.json": (sweeps.status, lambda folder: sweeps.list_sweeps(folder.parent),
                   lambda folder: SweepStore(folder).read_record()),
    "trials/t0001/trial.json": (sweeps.trials, lambda folder: trial(folder).read_record()),
    "trials/t0001/results.jsonl": (sweeps.trials, sweeps.dataframe, lambda folder: candidates(trial(folder)), go_on),
    "trials/t0001/results.damaged": (lambda folder: trial(folder).results_path.write_bytes(b"half"), go_on),
    "trials/t0001/log.txt": (lambda folder: trial(folder).log_tail(),
                             lambda folder: trial(folder).write_log("it began")),
    "trials/t0001/.tally": (keep, go_on, lambda folder: read_tally(trial(folder).tally_path)),
    "trials/t0001/.owner": (go_on,),
    "trials/t0000/tensorboard": (scalars,),
    "trials": (sweeps.trials, sweeps.resume),
    "trials/t0001": (sweeps.trials, sweeps.resume),
    "trials/t0001/checkpoints": (go_on,),
    f"{CHECKPOINT}/manifest.json": (sweeps.trials, go_on,
                                   lambda folder: verify_checkpoint(folder / CHECKPOINT)),
    f"{CHECKPOINT}/policy.json": (lambda folder: verify_checkpoint(folder / CHECKPOINT), go_on),
    f"{CHECKPOINT}/more": (lambda folder: verify_checkpoint(folder / CHECKPOINT),),
    "best/evaluation.json": (lambda folder: SweepStore(folder).read_best(),),
    "best/policy.json": (lambda folder: load_policy(folder / "best"),),
    "best/policy.safetensors": (lambda folder: load_policy(folder / "best"),),
    "packs/p00.json": (lambda folder: PackFiles(folder, "p00").read(),),
    "packs/p00.log": (lambda folder: PackFiles(folder, "p00").log_tail(),),
    "packs/.p00.owner": (take("packs/.p00.owner"),),
    "driver.log": (show,),
    ".lock": (sweeps.status, lock),
    ".driver-lock": (sweeps.status, sweeps.stop, lock),
    ".owner": (take(".owner"),),
    ".stop": (sweeps.status, lock, sweeps.resume),
}  # fmt: skip
"""What reads or writes each part of a sweep."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", USES)
def test_what_is_no_file_is_refused_and_nobody_waits_for_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, part: str, kind: str
) -> None:
    monkeypatch.setattr(resuming, "run_sweep", lambda *_, **__: None)
    path = folder / part
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    KINDS[kind](path)
    for use in USES[part]:
        with contextlib.suppress(TuneJobsError):
            use(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_named(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "here"
    KINDS[kind](path)
    for use in (read_regular, sha256_file):
        with pytest.raises(OSError, match=f"it is a {kind}, not a file"):
            use(path)
    with pytest.raises(CannotRunError, match=f"{path}: it is a {kind}, not a file"):
        open_to_append(path)
    with pytest.raises(CannotRunError, match=f"{path} cannot be written"), held(path, "It is taken.", ""):
        pass


def test_a_device_gives_no_bytes() -> None:
    with pytest.raises(OSError, match="it is a device, not a file"):
        read_regular("/dev/zero")  # type: ignore[arg-type]


def test_files_are_read_and_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "new" / "log.txt"
    for text in (b"one\n", b"two\n"):
        with open_to_append(path) as file:
            assert os.get_blocking(file.fileno())
            file.write(text)
    assert read_regular(path) == b"one\ntwo\n"
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "nothing")


@pytest.mark.parametrize("name", ["sweep.json", "trials/t0001/trial.json", f"{CHECKPOINT}/manifest.json"])
def test_a_record_that_is_far_too_large_is_not_read(folder: Path, name: str) -> None:
    os.truncate(folder / name, MAX_RECORD_BYTES + 1)
    with pytest.raises(CheckpointError, match=rf"{name} cannot be read .*it has 67,108,865 bytes, and no more than"):
        USES[name][-1](folder)


def test_results_that_are_far_too_large_cost_the_others_nothing(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    os.truncate(trial(folder).results_path, 2**31)
    assert len(sweeps.dataframe(folder)) == 2
    assert "results.jsonl cannot be read: it has 2,147,483,648 bytes" in caplog.text
    with pytest.raises(CheckpointError, match="Move it away"):
        trial(folder).read_iterations()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"name": "mine", "name": "yours"}', "'name' occurs twice"),
        ('{"spec": {"seed": 1, "seed": 2}}', "'seed' occurs twice"),
        ('{"created_at": NaN}', "NaN is no JSON"),
        ('{"created_at": -Infinity}', "-Infinity is no JSON"),
    ],
)
def test_json_that_readers_take_differently_is_refused(folder: Path, text: str, why: str) -> None:
    (folder / "sweep.json").write_text(text)
    with pytest.raises(CheckpointError, match=f"sweep.json cannot be read as sweep: {why}"):
        sweeps.status(folder)


@pytest.mark.parametrize("number", [300, 900, 100_000])
def test_json_that_is_nested_deeply_is_refused_before_anybody_is_stuck_in_it(folder: Path, number: int) -> None:
    data = odd_files.put(odd_files.read(folder / "sweep.json"), ("spec", "more"), "here")
    (folder / "sweep.json").write_text(json.dumps(data).replace('"here"', "[" * number + "]" * number))
    for use in (sweeps.status, sweeps.report, sweeps.resume):
        with pytest.raises(CheckpointError, match=r"sweep\.json cannot be read as sweep: "):
            use(folder)


def test_a_name_that_occurs_twice_among_very_many_is_found_at_once(folder: Path) -> None:
    names = [f'"n{number}": 0' for number in range(200_000)]
    (folder / "sweep.json").write_text("{" + ", ".join([*names, names[-1]]) + "}")
    began = time.process_time()
    with pytest.raises(CheckpointError, match="'n199999' occurs twice"):
        sweeps.status(folder)
    assert time.process_time() - began < 5.0
