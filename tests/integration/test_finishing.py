"""What comes after the trials, where the environment fails in it: said in the result, the report and the exit code."""

import contextlib
import dataclasses
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_baselines import make_task, run_trial

from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from policies.errors import EnvFailedError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.process.interruption import taking_signals
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.finishing import finish_sweep
from tune_jobs.sweeps.outcome import SweepResult

HOSTILE = "hostile_envs:Hostile"
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["hostile_envs"])


@pytest.fixture
def sweep_of(tmp_path: Path) -> Callable[..., SweepStore]:
    """A sweep of one trial that went well, in an environment that is hostile from now on."""

    def make(**args: Any) -> SweepStore:
        flag = tmp_path / "hostile"
        args |= {"only_after": str(flag)}
        spec = load_spec(
            {
                "env": {"id": HOSTILE, "args": args},
                "algorithm": "constant",
                "hyperparams": {"env_steps_per_iteration": 100},
                "stop": {"num_env_steps": 200},
                "evaluation": {"num_episodes": 2},
                "iteration_timeout_s": 2,
            }
        )
        store = SweepStore(tmp_path / "mine")
        store.create()
        plan = make_plan(spec, Machine(1))
        write_new(store, spec, plan, None)
        task = make_task(
            store.folder, "constant", env_id=HOSTILE, hyperparams=plan.trials[0].hyperparams, stop=spec.stop,
            checkpoints=spec.checkpoints,
        )  # fmt: skip
        run_trial(dataclasses.replace(task, env_args=args))
        trial = store.trial("t0000")
        trial.write_record(trial.read_record().model_copy(update={"status": "completed", "num_iterations": 2}))
        flag.touch()
        return store

    return make


def finished(store: SweepStore) -> SweepResult:
    return finish_sweep(store, SweepResult(store.place, store.read_record(), store.read_trials()))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ({"how": "hang", "at": 7}, "hangs in step(), step 7 after reset()"),
        ({"how": "exit", "where": "reset", "at": 2}, "ended with exit code 7 in reset()"),
        ({"how": "segfault"}, "was ended by SIGSEGV (segmentation fault) in step(), step 1 after reset()"),
        ({"how": "fail", "at": 3}, "after 2 steps: ValueError: the motor broke"),
    ],
)
def test_a_confirmation_that_fails_is_in_the_report_and_the_exit_code(
    sweep_of: Callable[..., SweepStore], args: dict[str, Any], words: str
) -> None:
    store = sweep_of(**args)
    result = finished(store)
    assert result.exit_code == 3
    assert result.best is None
    assert words in present(result.why_no_best)
    page = result.artifacts["report"].read_text(encoding="utf-8")
    assert "No winner" in page
    assert words in page
    assert {path.name for path in store.best_folder.glob("*")} <= {"evaluation.json"}


def test_a_report_that_chooses_says_why_it_could_not(sweep_of: Callable[..., SweepStore]) -> None:
    store = sweep_of(how="exit", at=4)
    assert "ended with exit code 7 in step(), step 4" in finish.make_report(store).read_text(encoding="utf-8")


def test_an_older_winner_is_not_shown_as_the_confirmed_one(sweep_of: Callable[..., SweepStore]) -> None:
    store = sweep_of(how="fail", where="close")  # harmless
    assert finished(store).exit_code == 0
    spec = store.read_record().spec
    spec["env"]["args"] |= {"how": "exit", "where": "step"}
    store.write_record(store.read_record().model_copy(update={"spec": spec}))
    result = finished(store)
    assert result.exit_code == 3
    assert "No winner" in result.artifacts["report"].read_text(encoding="utf-8")


@pytest.mark.parametrize(("how", "words"), [("hang", "hangs in render()"), ("exit", "exit code 7 in render()")])
def test_a_film_that_fails_is_a_note_and_an_exit_code(
    sweep_of: Callable[..., SweepStore], how: str, words: str
) -> None:
    store = sweep_of(how=how, where="render", at=5)
    result = finished(store)
    assert result.exit_code == 3
    assert result.best is not None
    (note,) = result.notes
    assert note.startswith("No video: ")
    assert words in note
    assert {path.name for path in store.best_folder.iterdir()} == {
        "evaluation.json", "policy.json", "policy.safetensors",
    }  # fmt: skip


def test_an_env_that_cannot_be_drawn_is_no_failure(sweep_of: Callable[..., SweepStore]) -> None:
    store = sweep_of(how="fail", where="render")
    result = finished(store)
    assert (result.exit_code, result.best is None) == (0, False)
    assert "cannot be drawn: ValueError: the motor broke" in result.notes[0]


def as_films(store: SweepStore) -> dict[str, Path]:
    """Film the winner, as it were."""
    with store.writing_films() as paths:
        for path in paths.values():
            path.write_bytes(b"a film")
    return dict(store.films())


def page_of(store: SweepStore) -> Path:
    return store.report_folder / "index.html"


def test_the_report_is_drawn_while_films_are_made_and_shows_them(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    def film(store: SweepStore) -> dict[str, Path]:
        until = time.monotonic() + 120
        while not list(store.report_folder.glob("figures/*.svg")):
            assert time.monotonic() < until, "no figure is drawn meanwhile"
            time.sleep(0.05)
        assert not page_of(store).exists()
        return as_films(store)

    monkeypatch.setattr(finish, "make_videos", film)
    store = sweep_of(how="fail", where="close")
    result = finished(store)
    assert (result.notes, result.artifacts["report"]) == ((), page_of(store))
    assert list(result.artifacts)[-1] == "report"
    assert page_of(store).read_text(encoding="utf-8").count("data:video/mp4") == 2
    assert store.current_report() == page_of(store)


def test_a_report_is_given_up_where_the_films_are_interrupted(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    def film(_: SweepStore) -> dict[str, Path]:
        raise KeyboardInterrupt

    monkeypatch.setattr(finish, "make_videos", film)
    store = sweep_of(how="fail", where="close")
    with taking_signals():
        result = finished(store)
    assert result.interrupted
    assert "report" not in result.artifacts
    assert not page_of(store).exists()
    assert "tune-jobs-report" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("is_link", [True, False])
def test_a_report_that_cannot_be_written_is_told_and_films_are_made(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch, *, is_link: bool
) -> None:
    monkeypatch.setattr(finish, "make_videos", as_films)
    store = sweep_of(how="fail", where="close")
    # Where its folder belongs: one is refused before anything is drawn, the other when the first file is written.
    if is_link:
        store.report_folder.symlink_to(store.best_folder)
    else:
        store.report_folder.write_text("mine")
    result = finished(store)
    assert "after_mp4" in result.artifacts
    (note,) = result.notes
    assert note.startswith("No report: ")


@pytest.mark.parametrize("call", [sweeps.best, sweeps.evaluate, sweeps.video])
def test_what_is_done_by_hand_is_guarded_too(sweep_of: Callable[..., SweepStore], call: Callable[..., Any]) -> None:
    store = sweep_of(how="exit", at=4)
    with pytest.raises(EnvFailedError, match=r"exit code 7 in step\(\), step 4"):
        call(store.folder)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["launch", "sweep.yaml", "--dry-run", "--json"], "hangs in step(), step 1 after reset()"),
        (["launch", "sweep.yaml", "--json", "--storage", "here"], "hangs in step(), step 1 after reset()"),
    ],
)
def test_a_plan_of_an_env_that_hangs_ends_with_a_message(tmp_path: Path, arguments: list[str], words: str) -> None:
    (tmp_path / "sweep.yaml").write_text(
        f"env: {{id: '{HOSTILE}', args: {{how: hang}}}}\nalgorithm: ppo\niteration_timeout_s: 1\n"
    )
    paths = [str(ROOT / "tests" / "unit"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-m", "tune_jobs.cli.commands", *arguments],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TUNE_JOBS_ALLOWED_MODULES": "hostile_envs"},
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert words in json.loads(done.stdout)["error"]
    assert not (tmp_path / "here" / "sweep").exists()


def test_it_is_shown_how_far_the_confirmation_is(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("policies.guard.guard._LOOK_S", 0.01)
    shown: dict[str, list[str]] = {}

    @contextlib.contextmanager
    def working(name: str, what: str, progress: str) -> Iterator[Callable[[str], None]]:
        yield shown.setdefault(what, []).append

    monkeypatch.setattr("tune_jobs.sweeps.live_view.working", working)
    assert finished(sweep_of(step_s=0.0005)).exit_code == 0
    numbers = [int(text.split()[-3]) for text in shown["choosing the best policy"] if text.startswith("confirming")]
    assert numbers == sorted(numbers)
    assert 1 <= numbers[0] < 20
    assert 80 < numbers[-1] <= 100


CONFIRMED = ["confirming the best policy", "playing at random"]


@pytest.mark.parametrize(
    ("command", "progress", "said"),
    [
        (sweeps.best, "none", ["choosing the best policy", *CONFIRMED]),
        (sweeps.evaluate, "auto", ["reading the policy", *CONFIRMED, "playing", "playing at random"]),
        (sweeps.video, "auto", ["reading the policy", *CONFIRMED, "filming"]),
        (sweeps.report, "none", ["writing the report", *CONFIRMED, "writing the report"]),
    ],
)
def test_each_command_shows_how_far_it_is(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any], progress: str,
    said: list[str],
) -> None:  # fmt: skip
    monkeypatch.setattr("policies.guard.guard._LOOK_S", 0.002)
    shown: list[str] = []
    asked: list[str] = []

    @contextlib.contextmanager
    def working(name: str, what: str, progress: str) -> Iterator[Callable[[str], None]]:
        asked.extend((name, progress))
        shown.append(what)
        yield shown.append

    monkeypatch.setattr("tune_jobs.sweeps.live_view.working", working)
    store = sweep_of()
    command(store.folder, progress=progress)
    assert asked in ([store.name, progress], [str(store.folder), progress])
    # Without how far each is.
    words = [re.split("[:,]", text)[0] for text in shown]
    assert [word for number, word in enumerate(words) if words[number - 1 : number] != [word]] == said


def test_what_a_library_raises_as_it_draws_is_a_note_beside_the_result(
    sweep_of: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def draw(*_: Any) -> Path:
        raise RuntimeError("no font was found.")

    monkeypatch.setattr(finish, "make_report", draw)
    result = finished(sweep_of(how="exit"))
    assert result.notes[-1] == "No report: RuntimeError: no font was found."
    assert result.exit_code == 3
    assert "in draw" in caplog.text
