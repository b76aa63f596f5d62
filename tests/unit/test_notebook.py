"""What results look like in a notebook: escaped, bounded, and one output that lives."""

import logging
import re
import sys
import types
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from fake_sweeps import BEST, SWEEP, TRIALS, evaluation
from test_monitor import make_monitor, make_trial

from analysis.best_records import EvaluationRecord
from analysis.notebook import BriefList, film_html
from analysis.records import SweepRecord, TrialRecord
from tune_jobs.spec.file import list_presets
from tune_jobs.sweeps import live_view, notebook_view
from tune_jobs.sweeps.create import CreatedSweep
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.results import Films, ReportPath, Trials
from tune_jobs.sweeps.status import BestSoFar, Sweeps, SweepStatus

EVIL = "<script>alert('x')</script>"
MOST = 20_000


class _Checked(HTMLParser):
    """Notes the tags, and refuses those that are not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read(page: str | None) -> _Checked:
    assert page is not None
    parser = _Checked()
    parser.feed(page)
    parser.close()
    assert not parser.open
    assert "script" not in parser.tags
    return parser


def large_trial(index: int) -> TrialRecord:
    return TRIALS[1].model_copy(
        update={
            "trial_id": f"t{index:04d}", "index": index, "status": "failed", "error": EVIL * 1_000,
            "point": {f"{EVIL}{number}": EVIL * 20 for number in range(100)}, "notes": (EVIL,) * 100,
        }
    )  # fmt: skip


LARGE = [large_trial(index) for index in range(1_000)]
SPEC = {"env": {"id": EVIL}, "space": {f"x{number}": {"choice": ["a" * 1_000] * 100} for number in range(100)}}
LARGE_SWEEP = SWEEP.model_copy(update={"name": EVIL, "spec": SPEC, "evaluation_seeds": tuple(range(10_000))})
LARGE_BEST = BEST.model_copy(
    update={"point": LARGE[0].point, "confirmation": evaluation(EVIL, *[1.0] * 10_000), "random": BEST.random}
)
SO_FAR = BestSoFar("t0001", 1, 5, LARGE[0].point, 7, 1.0)
STATUS = SweepStatus(LARGE_SWEEP, {"failed": 1_000}, alive=True, best=SO_FAR)
RESULT = SweepResult(
    f"/a/{EVIL}", LARGE_SWEEP, LARGE, LARGE_BEST, EVIL * 1_000, {EVIL: Path(EVIL)}, notes=(EVIL * 100,) * 100
)


@pytest.mark.parametrize(
    "shown",
    [
        RESULT, STATUS, LARGE_BEST, Trials(LARGE), Sweeps([STATUS] * 1_000), CreatedSweep(EVIL, f"/a/{EVIL}"),
        Films({EVIL: Path(f"/a/{EVIL}.mp4")}),
    ],
)  # fmt: skip
def test_whatever_it_holds_what_is_shown_is_short_and_escaped(shown: Any) -> None:
    assert len(repr(shown)) < MOST
    page = shown._repr_html_()
    assert len(page) < 4 * MOST
    read(page)


@pytest.mark.parametrize("record", [LARGE[0], LARGE_SWEEP, LARGE_BEST.confirmation, LARGE_BEST])
def test_the_repr_of_a_record_is_short(record: TrialRecord | SweepRecord | EvaluationRecord) -> None:
    assert len(repr(record)) < 5_000
    assert repr(record).startswith(f"{type(record).__name__}(")


def test_a_repr_names_what_is_not_the_default() -> None:
    text = repr(TRIALS[0])
    assert "trial_id='t0000'" in text
    assert "point={'hidden_sizes': [64, 32], 'lr': 0.1}" in text
    assert "changes" not in text
    assert "num_failures" not in text


def test_the_presets_are_short_too() -> None:
    assert len(repr(list_presets())) < MOST


def test_a_list_says_how_many_it_does_not_show() -> None:
    assert repr(BriefList(range(12))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ... and 2 more]"
    assert repr(BriefList(range(2))) == "[0, 1]"
    assert BriefList([1]) == [1]


def test_a_result_tells_what_a_person_asks_first() -> None:
    result = SweepResult("sweeps/mine", SWEEP, TRIALS, BEST, None, {"report": Path("report/index.html")})
    text = read(result._repr_html_()).text
    for part in ("Sweep mine: completed", "2 trials: 1 failed, 1 completed", "t0000: ValueError", "sweeps/mine"):
        assert part in text
    for part in ("lr 3e-05", "200.0 mean evaluation return", "195.0 over 2 fresh episodes; gap +5.0", "21.0", "solved"):
        assert part in text
    assert repr(result).startswith("SweepResult(place='sweeps/mine', state='completed', ")
    assert "best='t0001 scored 200.0'" in repr(result)
    # What it shows can be asked for by the same name.
    shown = re.findall(r"[(\s](\w+)=", repr(result))
    assert {"state", "counts", "artifacts", "exit_code"} <= set(shown)
    assert all(hasattr(result, name) for name in shown)
    assert result.counts == {"failed": 1, "completed": 1}


def test_a_status_tells_progress_and_time_left() -> None:
    status = SweepStatus(
        SWEEP.model_copy(update={"state": "running"}), {"running": 2}, alive=True, num_env_steps=50,
        max_env_steps=100, time_left_s=5.0,
    )  # fmt: skip
    text = read(status._repr_html_()).text
    for part in ("Sweep mine", "50 %: 50 of at most 100 env steps", "about 5 s", "no evaluation yet"):
        assert part in text


def test_trials_are_a_table_of_the_first() -> None:
    page = read(Trials(TRIALS * 15)._repr_html_())
    assert page.text.count("t0001") == 10
    assert "and 10 more" in page.text
    assert "64x32" in page.text


def test_a_film_is_within_the_page_unless_it_is_large_or_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    films = Films({name: tmp_path / f"{name}.mp4" for name in ("before", "after", "before_after")})
    for path in films.values():
        path.write_bytes(path.stem.encode())
    page = films._repr_html_()
    assert read(page).tags.count("video") == 1
    assert "data:video/mp4;base64,YmVmb3JlX2FmdGVy" in page  # before_after
    gif = tmp_path / "after.gif"
    gif.write_bytes(b"GIF")
    films["before_after"].unlink()
    assert "data:image/gif;base64,R0lG" in film_html([films["before_after"], gif])
    monkeypatch.setattr("analysis.notebook._MAX_FILM_BYTES", 2)
    assert "base64" not in films._repr_html_()
    assert "after.mp4" in films._repr_html_()


def test_a_report_is_a_link_and_a_folded_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a b"
    folder.mkdir()
    report = ReportPath(folder / "index.html")
    assert "is gone" in read(report._repr_html_()).text
    report.write_text("x" * 100_000)
    monkeypatch.chdir(tmp_path)
    page = report._repr_html_()
    assert page is not None
    assert 'src="a%20b/index.html"' in page
    assert read(page).tags == ["div", "a", "details", "summary", "iframe"]
    # A notebook elsewhere can't show it, but names it.
    monkeypatch.chdir(folder)
    monkeypatch.chdir("/")
    assert str(report) in read(report._repr_html_()).text
    assert ReportPath("sweeps").parent._repr_html_() is None
    assert report == Path(report)


# -- the live output


class Notebook(types.ModuleType):
    """In the place of IPython."""

    def __init__(self) -> None:
        super().__init__("IPython")
        self.pages: list[list[str]] = []
        self.shell = types.SimpleNamespace(kernel=object(), execution_count=1)

    def get_ipython(self) -> Any:
        return self.shell

    def HTML(self, page: str) -> str:  # noqa: N802 (IPython's name)
        return page

    def display(self, page: str, *, display_id: bool) -> Any:
        assert display_id
        shown = [page]
        self.pages.append(shown)
        return types.SimpleNamespace(update=shown.append)


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> Iterator[Notebook]:
    fake = Notebook()
    monkeypatch.setitem(sys.modules, "IPython", fake)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    yield fake
    notebook_view._outputs.clear()


def test_in_a_notebook_one_output_lives_through_the_trials_and_what_follows(notebook: Notebook, tmp_path: Path) -> None:
    monitor = make_monitor(make_trial(0, "running", steps=250, score=3.0), make_trial(1), cap=1_000)
    with live_view.shown(monitor, "auto", tmp_path / "log"):
        assert "12 %" in notebook.pages[0][-1]
        monitor.update(make_trial(0, "completed", steps=1_000, score=7.0))
        # Ray says again and again that ipywidgets is missing, which nothing here needs.
        assert not logging.getLogger("ray.widgets.util").isEnabledFor(logging.INFO)
    assert logging.getLogger("ray.widgets.util").level == logging.NOTSET
    assert "50 %" in notebook.pages[0][-1]
    assert "7.0" in notebook.pages[0][-1]
    last = notebook.pages[0][-1]
    assert "#000000" not in last  # it would not be seen on a dark page
    with live_view.working("mine", "writing the report", "auto"):
        assert notebook.pages[0][-1].startswith(last)
        assert "writing the report" in notebook.pages[0][-1]
    assert notebook.pages[0][-1] == last
    assert len(notebook.pages) == 1
    read(last)
    # Another cell has its own.
    notebook.shell.execution_count = 2
    with live_view.working("mine", "writing the report", "auto"):
        pass
    assert len(notebook.pages) == 2


def test_a_live_output_is_short_and_escaped(notebook: Notebook, tmp_path: Path) -> None:
    trials = [
        make_trial(index, "running", steps=250, score=3.0).model_copy(update={"point": LARGE[0].point})
        for index in range(50)
    ]
    with live_view.shown(make_monitor(*trials), "auto", tmp_path / "log"):
        pass
    assert len(notebook.pages[0][-1]) < 2 * MOST
    read(notebook.pages[0][-1])


def test_a_notebook_that_fails_to_show_it_does_not_end_the_sweep(
    notebook: Notebook, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(page: str) -> None:
        raise OSError(page)

    monkeypatch.setattr(notebook, "display", lambda *_, **__: types.SimpleNamespace(update=fail))
    with live_view.shown(make_monitor(make_trial(0)), "auto", tmp_path / "log"):
        pass


@pytest.mark.parametrize("shell", [None, types.SimpleNamespace(execution_count=1)])
def test_without_a_kernel_there_are_lines(
    notebook: Notebook, tmp_path: Path, capfd: pytest.CaptureFixture[str], shell: Any
) -> None:
    notebook.shell = shell
    with live_view.shown(make_monitor(make_trial(0)), "auto", tmp_path / "log"):
        pass
    assert notebook.pages == []
    assert capfd.readouterr().err.startswith("mine: ")


def test_nothing_is_shown_if_nothing_is_wanted(notebook: Notebook, tmp_path: Path) -> None:
    with live_view.shown(make_monitor(make_trial(0)), "none", tmp_path / "log"):
        pass
    with live_view.working("mine", "writing the report", "none"):
        pass
    assert notebook.pages == []
