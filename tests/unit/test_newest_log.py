"""A trial's log, of whichever machine: what every store promises of it, and `reproduce`, which reads it."""

import tracemalloc
from pathlib import Path

import pytest
from store_parts import Reopen, make_iteration, make_trial

from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.logs import continued_from
from tune_jobs.store.objects import scratch
from tune_jobs.sweeps import reproduce


@pytest.fixture
def continued(sweep: Sweep, trial: Trial) -> Trial:
    """A trial that was interrupted after three iterations of six."""
    trial.write_record(make_trial(status="completed"))
    trial.take(sweep.take())
    trial.write_log("built from seed 5")
    trial.append_iterations([make_iteration(number) for number in (1, 2, 3)])
    trial.write_log("built from checkpoint 000003")
    trial.append_iterations([make_iteration(number) for number in (4, 5, 6)])
    trial.settle()
    return trial


@pytest.fixture(params=["this machine", "another"])
def machine(request: pytest.FixtureRequest, continued: Trial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "another":
        # Of an object store, the file that the trial's process wrote is on its own machine.
        monkeypatch.setenv(scratch.VARIABLE, str(tmp_path / "another"))
    return str(request.param)


@pytest.mark.usefixtures("machine")
def test_the_newest_log_is_read_on_every_machine(another: Reopen) -> None:
    trial = another().trial("t0000")
    assert [line.partition(": ")[2] for line in trial.newest_log().read_text().splitlines()] == [
        "built from seed 5",
        "built from checkpoint 000003",
    ]


@pytest.mark.usefixtures("machine")
def test_on_every_machine_a_trial_is_compared_up_to_where_it_continued_from_a_checkpoint(another: Reopen) -> None:
    found = another()
    trial = found.trial("t0000")
    recorded = trial.read_iterations()
    assert len(recorded) == 6
    assert reproduce._repeatable(found, trial.read_record(), recorded) == recorded[:3]


def test_without_a_log_there_is_no_file(trial: Trial) -> None:
    trial.write_record(make_trial())
    assert not trial.newest_log().exists()
    assert continued_from(trial.newest_log()) is None


def test_a_log_may_be_larger_than_the_memory(tmp_path: Path) -> None:
    log, filler = tmp_path / "log.txt", "an environment prints \N{SNOWMAN}\n" * 50_000
    log.write_text(
        f"{filler}-- trial t0000, process 7: built from checkpoint 000012\n{filler}"
        f"half a line-- trial t0000, process 8: built from checkpoint 000009\n{filler}"
    )
    tracemalloc.start()
    try:
        assert continued_from(log) == 9
        assert tracemalloc.get_traced_memory()[1] < log.stat().st_size / 10
    finally:
        tracemalloc.stop()
