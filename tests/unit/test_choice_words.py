"""What a policy was chosen from, in words: the summary, the rows, the command line and the notebook."""

import json

import pytest
from synthetic_sweep import make_sweep, with_choice

from analysis.best_records import BestRecord
from analysis.choice_words import CandidateRow, candidate_rows, chosen_from
from analysis.records import TrialRecord
from analysis.selection import is_current, policy_candidates
from analysis.wording import NONE
from tests.narrowing import present
from tune_jobs.cli.output import show_best

SYNTHETIC = make_sweep()


@pytest.fixture
def best() -> BestRecord:
    return with_choice(present(SYNTHETIC.best), SYNTHETIC.trials)


def at(place: int) -> str:
    checkpoint = policy_candidates(SYNTHETIC.trials)[place].checkpoint
    return f"{checkpoint.trial_id} at {checkpoint.num_env_steps:,}"


def test_the_summary_tells_what_was_spent_and_who_was_left_out(best: BestRecord) -> None:
    choice = present(best.choice)
    assert chosen_from(choice) == (
        f"{choice.num_known} kept checkpoints: the leading 3 (1 other left out) in 2 rounds, 260 more episodes "
        "(50,000 of at most 250,000 env steps); 1 other scored the same to the last episode"
    )
    longer = choice.model_copy(update={"num_env_steps": 260_000})
    assert "(260,000 in place of 250,000 env steps)" in chosen_from(longer)
    alone = choice.model_copy(update={"candidates": choice.candidates[:1], "num_known": 1, "num_rounds": 0})
    assert chosen_from(alone) == "1 kept checkpoint; with one candidate nothing more was played"


def test_each_candidate_has_its_episodes_score_interval_and_fate(best: BestRecord) -> None:
    won, tied, lost, damaged = candidate_rows(best, none="-")
    confirmed = best.confirmation
    assert (won.policy, won.num_episodes, won.score, won.interval) == (at(0), "120", "200.0", "all equal")
    assert won.confirmation.startswith(f"{confirmed.mean_return:.1f} (")
    assert won.rejected == "chosen"
    assert (tied.interval, tied.rejected) == ("199.5 to 200.5", "round 2: a tie, from more env steps")
    assert tied.confirmation == won.confirmation
    assert lost == CandidateRow(at(2), "50", "180.2", "-", "-", "round 1")
    assert damaged == CandidateRow(at(3), "-", "200.0", "-", "-", "left out: its weights are damaged")


def test_odd_numbers_cost_only_their_own_cells(best: BestRecord) -> None:
    choice = present(best.choice)
    returns = (float("nan"), *best.confirmation.returns[1:])
    odd = best.model_copy(update={"confirmation": best.confirmation.model_copy(update={"returns": returns})})
    assert candidate_rows(odd, none="-")[0].confirmation == "nan"
    item = choice.candidates[0].model_copy(update={"score": float("inf"), "reason": "x" * 500, "rejected_in": 3})
    row = candidate_rows(best.model_copy(update={"choice": choice.model_copy(update={"candidates": (item,)})}))[0]
    assert row.score == NONE
    assert len(row.rejected) < 140


def test_a_winner_of_an_older_version_has_no_candidates() -> None:
    assert candidate_rows(present(SYNTHETIC.best)) == []


def test_best_prints_the_candidates_and_json_has_them_all(best: BestRecord, capsys: pytest.CaptureFixture[str]) -> None:
    show_best(best, as_json=False)
    printed = capsys.readouterr().out
    assert "200.0 mean evaluation return over 120 episodes" in printed
    assert f"chosen from {chosen_from(present(best.choice))}" in " ".join(printed.split())
    for row in candidate_rows(best, none="-"):
        assert row.policy in printed
        assert row.rejected in printed
    assert "over episodes of each policy, not over training seeds" in printed
    assert "note: Round 2 could not be played: the motor broke" in printed
    show_best(best, as_json=True)
    choice = json.loads(capsys.readouterr().out)["choice"]
    assert [item["rejected_in"] for item in choice["candidates"]] == [None, 2, 1, 0]
    assert choice["candidates"][1]["confirmation"]["num_episodes"] == 100


def test_more_candidates_than_fit_are_counted(best: BestRecord, capsys: pytest.CaptureFixture[str]) -> None:
    choice = present(best.choice)
    many = choice.model_copy(update={"candidates": choice.candidates[:1] + (choice.candidates[2],) * 11})
    show_best(best.model_copy(update={"choice": many}), as_json=False)
    printed = capsys.readouterr().out
    assert printed.count("round 1") == 7
    assert "4 others: see --json, or the report" in printed


def test_a_notebook_tells_the_episodes(best: BestRecord) -> None:
    assert "200.0 mean evaluation return over 120 episodes" in best._repr_html_()


def test_a_choice_is_current_until_there_are_other_checkpoints(best: BestRecord) -> None:
    trials = SYNTHETIC.trials
    assert is_current(best, trials)
    known = policy_candidates(trials)

    def without(place: int) -> list[TrialRecord]:
        gone = known[place].checkpoint
        return [
            trial.model_copy(update={"checkpoints": tuple(item for item in trial.checkpoints if item != gone)})
            for trial in trials
        ]

    assert not is_current(best, without(0))
    assert not is_current(best, without(len(known) - 1)), "one that did not play is missing"
    changed = known[1].checkpoint.model_copy(update={"num_env_steps": 1})
    candidates = list(present(best.choice).candidates)
    candidates[1] = candidates[1].model_copy(update={"checkpoint": changed})
    other = present(best.choice).model_copy(update={"candidates": tuple(candidates)})
    assert not is_current(best.model_copy(update={"choice": other}), trials)
    assert not is_current(best, [])
