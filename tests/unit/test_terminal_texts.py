"""Texts of a sweep's records, which anybody may have written, tell a terminal nothing but what can be read."""

import contextlib
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from rich.console import Console
from rich.live import Live
from rich.style import Style
from rich.table import Table
from rich.text import Text
from sweep_folders import make_sweep_folder

from analysis.records import JobRecord
from tune_jobs.cli.commands import cli
from tune_jobs.cli.output import make_console, print_facts, say_interrupted, show_stop
from tune_jobs.process import streams
from tune_jobs.store.opening import resume_command
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import live_view
from tune_jobs.sweeps.fitting_console import FittingConsole
from tune_jobs.sweeps.live_view import _Lines, _view, shown, working
from tune_jobs.sweeps.monitor import SweepMonitor

# To the clipboard, as some terminals do at once; and the same in the one character that means ESC and a bracket.
COPY = "\x1b]52;c;eA==\x07"
HOSTILE = f"{COPY}\x9d52;c;eA==\x9c"
STYLES = re.compile(r"\x1b\[[0-9;]*m")


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A sweep whose records have such texts wherever a text can be."""
    monkeypatch.chdir(tmp_path)
    store = make_sweep_folder(tmp_path / "sweeps" / "mine")
    job = JobRecord(id=f"mine{HOSTILE}-1", address=f"ftp://{HOSTILE}", place=store.place)
    store.write_record(
        store.read_record().model_copy(update={"job": job, "versions": {"ray": HOSTILE}, "git_commit": HOSTILE})
    )
    for trial in store.read_trials():
        changes: dict[str, Any] = {
            "point": {**trial.point, f"a{HOSTILE}": f"b{HOSTILE}"}, "notes": (f"c{HOSTILE}",), "node": f"d{HOSTILE}",
            "stop_reason": f"e{HOSTILE}",
        }  # fmt: skip
        if trial.trial_id == "t0000":
            changes |= {"status": "failed", "error": f"f{HOSTILE}"}
        store.trial(trial.trial_id).write_record(trial.model_copy(update=changes))
    return store


def run(*words: str, in_colour: bool = False) -> Result:
    """Run a command; in colour, as it is on a terminal."""
    return CliRunner(env={"FORCE_COLOR": "1", "TERM": "xterm-256color"} if in_colour else None).invoke(cli, words)


def obeyed(text: str) -> Sequence[str]:
    """The control characters in a text, besides those of rich's styles."""
    return re.findall(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", STYLES.sub("", text))


@pytest.mark.parametrize("in_colour", [False, True])
@pytest.mark.parametrize("words", [("status",), ("trials",), ("trials", "--json"), ("compare",), ("attach",)])
def test_what_is_printed_of_records_is_text(hostile: SweepStore, words: tuple[str, ...], *, in_colour: bool) -> None:
    verb, *more = words
    done = run(verb, "mine", *more, in_colour=in_colour)
    assert done.exit_code in (0, 3), done.output
    assert (obeyed(done.stdout), obeyed(done.stderr)) == ([], [])
    assert "52;c;eA==" in done.stdout


def test_json_says_what_the_records_say(hostile: SweepStore) -> None:
    told = run("trials", "mine", "--json")
    assert json.loads(told.stdout)[0]["error"] == f"f{HOSTILE}"
    assert obeyed(told.stdout) == []


def test_commands_that_go_on_are_text(hostile: SweepStore, capsys: pytest.CaptureFixture[str]) -> None:
    record = hostile.read_record()
    go_on = resume_command(hostile, record)
    say_interrupted(record, go_on)
    show_stop("mine", was_running=True, go_on=go_on, as_json=False)
    told = capsys.readouterr()
    assert (obeyed(told.out), obeyed(told.err)) == ([], [])
    assert "52;c;eA==" in told.out
    assert "52;c;eA==" in told.err


def test_what_is_said_at_last_is_text(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(streams, "_shown_on", [stream])
    streams.say_at_last(HOSTILE)
    assert obeyed(stream.getvalue()) == []


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def monitor(hostile: SweepStore) -> SweepMonitor:
    trials = hostile.read_trials()
    monitor = SweepMonitor("mine", trials, caps={trial.trial_id: 600 for trial in trials})
    monitor.phase = f"waiting for {HOSTILE}"
    return monitor


def test_the_live_table_is_text_and_is_drawn_anew(monitor: SweepMonitor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = Terminal()
    with _view(monitor, stream) as live:
        assert isinstance(live, Live)
        live.refresh()
        live.refresh()
    told = stream.getvalue()
    assert COPY not in told
    assert "\x9d" not in told
    assert r"\x1b]52;c;eA==" in told
    # Rich's own: the cursor is hidden, goes up to the table's first line, and is shown again.
    for code in ("\x1b[?25l", "\x1b[1A", "\x1b[2K", "\x1b[?25h", "\x1b[1m"):
        assert code in told


def test_lines_of_a_log_are_text(
    monitor: SweepMonitor, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with shown(monitor, "auto", tmp_path / "log", notes=[HOSTILE]):
        pass
    monkeypatch.setattr(live_view, "_LINE_INTERVAL_S", 0.01)
    stream = io.StringIO()
    with _Lines(lambda: HOSTILE, stream, at_the_end=True):
        pass
    told = capfd.readouterr().err + stream.getvalue()
    assert obeyed(told) == []
    assert told.count("52;c;eA==") >= 4


def test_what_is_done_meanwhile_is_text(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(live_view, "patient_stream", lambda: contextlib.nullcontext(stream))
    with working(f"mine{HOSTILE}", "writing the report", "auto"):
        pass
    assert "52;c;eA==" in stream.getvalue()
    assert COPY not in stream.getvalue()
    assert "\x9d" not in stream.getvalue()


def test_richs_own_styles_links_and_layout_stay() -> None:
    def printed(kind: type[Console]) -> str:
        console = kind(file=io.StringIO(), force_terminal=True, color_system="truecolor", width=60)
        table = Table("name", "value")
        table.add_row(Text("a\tb", style="red"), "two words\nand a line")
        console.print(table, Text("read it", style=Style(link="https://example.org")), style="dim")
        return str(re.sub(r"id=\d+", "id=0", console.file.getvalue()))  # type: ignore[attr-defined]

    assert printed(FittingConsole) == printed(Console)
    assert "\x1b]8;id=0;https://example.org\x1b\\" in printed(FittingConsole)


def test_the_console_of_commands_fits_what_it_is_given(capsys: pytest.CaptureFixture[str]) -> None:
    console = make_console()
    console.print(HOSTILE, style="red")
    print_facts(console, {HOSTILE: HOSTILE, "fact": "of two\nlines"})
    told = capsys.readouterr().out
    assert obeyed(told) == []
    assert told.count(r"\x1b]52;c;eA==") == 3
