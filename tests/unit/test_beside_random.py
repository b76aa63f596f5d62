"""Sweeps in which nothing was learned: they say so, and train no setting again."""

import math
from pathlib import Path
from typing import Any

import pytest
from fake_sweeps import BEST, evaluation
from report_sources import source_of
from store_parts import make_iteration
from sweep_folders import make_sweep_folder
from synthetic_sweep import Synthetic
from synthetic_sweep import make_sweep as make_synthetic

from analysis.answers import compared_with_random, nothing_learned
from analysis.best_records import BestRecord
from analysis.page import answer, next_steps
from analysis.records import IterationRecord
from tests.narrowing import present
from tune_jobs.cli import output
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.attach import attach
from tune_jobs.sweeps.confirm import are_all_alike, points_to_confirm
from tune_jobs.sweeps.finishing import finish_sweep
from tune_jobs.sweeps.outcome import SweepResult

ADVICE = "train longer (stop.num_env_steps), or search other values."
LOST = (-200.0,) * 4


def best_of(ours: tuple[float, ...], theirs: tuple[float, ...]) -> BestRecord:
    return BEST.model_copy(
        update={"confirmation": evaluation("best", *ours), "random": evaluation("random", *theirs)}
    )  # fmt: skip


@pytest.mark.parametrize(
    ("ours", "theirs", "told"),
    [
        (LOST, LOST, "alike"),
        ((190.0, 200.0, 210.0), (20.0, 30.0, 10.0), "better"),
        ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), "better"),
        ((20.0, 30.0, 10.0), (190.0, 200.0, 210.0), "worse"),
        # A mean gain of 10 with a deviation of 10: with 3 episodes the interval is 10 +- 24.8, with 12 10 +- 6.1.
        ((0.0, 10.0, 20.0), (0.0, 0.0, 0.0), "alike"),
        ((0.0, 10.0, 20.0) * 4, (0.0,) * 12, "better"),
        ((5.0,), (1.0,), None),
        ((math.nan, 1.0), (0.0, 0.0), None),
        ((1e308, 1e308), (-1e308, -1e308), None),
    ],
)
def test_the_winner_is_compared_with_random_play_over_episodes(
    ours: tuple[float, ...], theirs: tuple[float, ...], told: str | None
) -> None:
    assert compared_with_random(best_of(ours, theirs)) == told
    assert bool(nothing_learned(best_of(ours, theirs))) == (told in ("alike", "worse"))


def test_of_other_seeds_nothing_is_said() -> None:
    best = best_of(LOST, LOST)
    other = best.random.model_copy(update={"seeds": (1, 2, 3, 4)})
    assert compared_with_random(best.model_copy(update={"random": other})) is None


def test_the_terminal_says_it_beside_the_random_policy(capsys: pytest.CaptureFixture[str]) -> None:
    output.show_best(best_of(LOST, LOST), as_json=False)
    assert "(-200 to -200); the policy can't be told from it" in capsys.readouterr().out
    output.show_best(best_of((-2.0, -3.0, -4.0), (9.0, 9.0, 9.0)), as_json=False)
    assert "(9 to 9); the policy is worse" in capsys.readouterr().out
    output.show_best(best_of((9.0, 9.0, 9.0), (-2.0, -3.0, -4.0)), as_json=False)
    assert "; the policy" not in capsys.readouterr().out


def test_the_report_says_what_to_do_and_proposes_no_more_seeds() -> None:
    made = make_synthetic(points=[{"lr": 3e-3}, {"lr": 3.1e-3}])
    assert answer.section(source_of(made)).command
    best = present(made.best)
    lost = best.model_copy(update={"confirmation": best.random})
    found = answer.section(source_of(Synthetic(made.sweep, made.trials, made.results, lost)))
    assert found.sentences[0] == f"The best policy can't be told from random play over 100 episodes: {ADVICE}"
    assert found.command == ""


def test_the_report_proposes_neither_more_seeds_nor_a_narrower_space_as_next_steps() -> None:
    made = make_synthetic(points=[{"lr": value} for value in (3e-3, 3.1e-3, 2.9e-3, 3.2e-3, 1e-7, 2e-7)])
    sweep = made.sweep.model_copy(
        update={"spec": made.sweep.spec | {"space": {"lr": {"loguniform": [1e-8, 1e-1]}}, "num_samples": 6}}
    )
    best = present(made.best)
    lost = best.model_copy(update={"confirmation": best.random})
    titles = [
        {step.title for step in next_steps.section(source_of(Synthetic(sweep, made.trials, made.results, each))).steps}
        for each in (best, lost)
    ]
    assert titles[0] - titles[1] == {"Replicate", "Search a narrower space"}
    assert "Extend" in titles[1]


def finished(store: SweepStore, monkeypatch: pytest.MonkeyPatch, best: BestRecord) -> tuple[str, ...]:
    monkeypatch.setattr(conclude, "choose_best", lambda *_, **__: best)
    monkeypatch.setattr(conclude, "make_videos", lambda _: {})
    monkeypatch.setattr(conclude, "make_report", lambda *_: store.folder)
    monkeypatch.setattr("tune_jobs.sweeps.finishing._Finish._films_and_report", lambda *_: None)
    return finish_sweep(store, SweepResult(store.place, store.read_record(), store.read_trials())).notes


def test_a_finished_sweep_notes_it_unless_it_is_a_baseline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    assert finished(store, monkeypatch, BEST) == ()
    lost = best_of(LOST, LOST)
    assert finished(store, monkeypatch, lost) == (nothing_learned(lost),)
    record = store.read_record()
    store.write_record(record.model_copy(update={"spec": record.spec | {"algorithm": "random"}}))
    assert finished(store, monkeypatch, lost) == ()


def test_who_looks_on_is_told_too(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    sweeps.best(store.folder, num_episodes=2)
    best, better = store.read_best(), best_of((190.0, 200.0, 210.0), (20.0, 30.0, 10.0))
    for confirmation, random in ((best.random, best.random), (better.confirmation, better.random)):
        store.write_best(best.model_copy(update={"confirmation": confirmation, "random": random}))
        told = nothing_learned(store.read_best())
        assert bool(told) == (confirmation == random)
        assert attach(store.folder, progress="none").notes == ((told,) if told else ())


def line(evaluated: float | None, *trained: float) -> IterationRecord:
    return make_iteration(1, evaluation_return=evaluated, episode_returns=trained)


@pytest.mark.parametrize(
    ("results", "alike"),
    [
        ([line(-200.0, -200.0, -200.0), line(None), line(-200.0)], True),
        ([line(-200.0), line(-200.0, -199.0)], False),
        ([line(-200.0), line(-199.0)], False),
        # Never evaluated: settings are judged by something else.
        ([line(None, -200.0)], False),
        ([], False),
    ],
)
def test_all_is_alike_where_no_episode_differs_in_training_or_evaluation(
    results: list[IterationRecord], alike: bool
) -> None:
    assert are_all_alike(results) == alike


@pytest.mark.parametrize(
    ("results", "alike"),
    [
        # The first iterations of a training are mostly not evaluated.
        ([line(None, -200.0), line(-200.0, -200.0)], True),
        ([line(None), line(-200.0), line(None, -200.0)], True),
        ([line(None, -200.0), line(-200.0, -199.0)], False),
        ([line(None), line(None)], False),
    ],
)
def test_all_is_alike_as_well_where_iterations_come_one_by_one(results: list[IterationRecord], alike: bool) -> None:
    """As of a sweep of millions, which are looked at once and not kept."""
    assert are_all_alike(iter(results)) == alike


def test_no_setting_is_trained_again_where_none_leads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    confirm: dict[str, Any] = {"top": 2, "seeds": 2, "max_share": 2.0}
    store = make_sweep_folder(tmp_path / "mine", confirm=confirm)
    assert points_to_confirm(store)
    read = type(store.trial("t0000")).read_iterations

    def flat(trial: Any) -> list[IterationRecord]:
        changes = {"evaluation_return": -200.0, "training_return": -200.0, "episode_returns": (-200.0,)}
        return [item.model_copy(update=changes) for item in read(trial)]

    monkeypatch.setattr(type(store.trial("t0000")), "read_iterations", flat)
    assert points_to_confirm(store) == ()
