"""The report of sweeps that went badly, or hold odd things: right, safe, and it says what is missing."""

from pathlib import Path

import pytest
from synthetic_sweep import make_sweep

from analysis.page.cards import winner_card
from analysis.records import CheckpointRecord
from analysis.report_data import goal_of
from policies.hyperparams import Algorithm
from tests.integration.report_page import report
from tests.narrowing import present

HOSTILE = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>{{ 7*7 }}"


def test_a_sweep_without_a_winner_says_why(tmp_path: Path) -> None:
    synthetic = make_sweep(failed=range(20))
    assert synthetic.best is None
    _, _, page = report(tmp_path, synthetic)
    assert "No winner No trial of 20 is usable: 20 failed. First error (t0000): RuntimeError" in page.words
    assert "Policy to deploy" not in page.words


def test_an_unconfirmed_sweep_names_the_leader_and_the_command(tmp_path: Path) -> None:
    synthetic = make_sweep(pending=range(6, 20), with_best=False)
    synthetic.sweep = synthetic.sweep.model_copy(update={"state": "interrupted"})
    _, _, page = report(tmp_path, synthetic)
    assert "not confirmed on fresh seeds yet" in page.words
    assert f"tune-jobs best {tmp_path}" in page.words
    assert f"tune-jobs resume {tmp_path}" in page.words


@pytest.mark.parametrize("kind", ["one trial", "no trials", "nothing ran", "dqn", "no threshold"])
def test_any_sweep_gives_a_page(tmp_path: Path, kind: str) -> None:
    synthetic = {
        "one trial": lambda: make_sweep(points=[{}]),
        "no trials": lambda: make_sweep(points=[]),
        "nothing ran": lambda: make_sweep(pending=range(20)),
        "dqn": lambda: make_sweep(points=[{"double_q": i, "lr": 1e-3} for i in (True, False)], algorithm="dqn"),
        "no threshold": lambda: make_sweep(env_id="Own-v0", threshold=None),
    }[kind]()
    _, html, page = report(tmp_path, synthetic)
    assert ("No winner" in page.words) == (synthetic.best is None)
    assert "nan" not in page.words.lower().split()
    # The programs for other libraries have it, as they are Python's.
    assert "None" not in page.words.replace("grad_clip=None", "")
    if kind == "no threshold":
        assert '<span class="badge">no threshold</span>' in html


@pytest.mark.parametrize(
    ("points", "threshold", "sentence"),
    [
        ([{"lr": 1e-7}], 195.0, "No trial reached a mean training return of 195 over 100 episodes."),
        ([{"lr": 3e-3}], None, None),
        ([{}], 195.0, "The sweep's one point reaches"),
    ],
)
def test_the_sentence_suits_the_sweep(
    tmp_path: Path, points: list[dict[str, float]], threshold: float | None, sentence: str | None
) -> None:
    env_id = "CartPole-v0" if threshold else "Own-v0"
    synthetic = make_sweep(points=points, threshold=threshold, env_id=env_id)
    if threshold is None:
        synthetic.sweep = synthetic.sweep.model_copy(update={"spec": synthetic.sweep.spec | {"stop": {}}})
    _, _, page = report(tmp_path, synthetic)
    assert ("Env steps to solve" in page.words) == (sentence is not None)
    assert sentence is None or sentence in page.words


@pytest.mark.parametrize(
    ("algorithm", "heading"), [("random", "Random play on"), ("constant", "A constant action on"), ("dqn", "DQN on")]
)
def test_a_baseline_has_no_before_and_after(tmp_path: Path, algorithm: Algorithm, heading: str) -> None:
    synthetic = make_sweep(points=[{}], algorithm=algorithm)
    (tmp_path / "v.mp4").write_bytes(b"v")
    _, _, page = report(tmp_path, synthetic, {"before": tmp_path / "v.mp4", "after": tmp_path / "v.mp4"})
    assert f"{heading} CartPole-v0" in page.words
    assert ("After training" in page.words) == (algorithm == "dqn")


def test_hostile_text_is_never_html(tmp_path: Path) -> None:
    synthetic = make_sweep(
        points=[{"activation": HOSTILE, "lr": 1e-3}, {"activation": "$relu$", "lr": 2e-3}],
        failed={1},
        env_id=HOSTILE,
        name=HOSTILE,
        error=HOSTILE,
    )
    synthetic.sweep = synthetic.sweep.model_copy(
        update={"versions": {HOSTILE: HOSTILE}, "address": HOSTILE, "git_commit": HOSTILE}
    )
    (tmp_path / "v.mp4").write_bytes(b"v")
    _, html, page = report(tmp_path, synthetic, {HOSTILE: tmp_path / "v.mp4"})
    assert [tag for tag, _ in page.tags].count("script") == 4
    assert not any(tag == "img" for tag, _ in page.tags)
    assert not any(name.startswith("on") for _, attrs in page.tags for name in attrs)
    assert "<script>alert" not in html
    assert "{{ 7*7 }}" in page.words


def test_a_winner_the_selection_has_moved_from_is_called_out(tmp_path: Path) -> None:
    synthetic = make_sweep(points=[{"lr": 1e-3}, {"lr": 3e-3}])
    assert not winner_card(present(synthetic.best), synthetic.trials, synthetic.sweep, str(tmp_path))["stale"]
    old = CheckpointRecord(trial_id="t0000", iteration=1, num_env_steps=1)
    synthetic.best = present(synthetic.best).model_copy(update={"checkpoint": old})
    _, _, page = report(tmp_path, synthetic)
    assert "There are other candidates by now" in page.words


def test_returns_that_are_not_finite_cost_only_their_interval(tmp_path: Path) -> None:
    synthetic = make_sweep()
    broken = present(synthetic.best).confirmation.model_copy(update={"returns": (float("nan"),) * 100})
    best = present(synthetic.best).model_copy(update={"confirmation": broken})
    card = winner_card(best, synthetic.trials, synthetic.sweep, str(tmp_path))
    assert card["interval"] is None
    assert card["gain"] is None


def test_episodes_that_are_not_finite_are_left_out_of_the_figure(tmp_path: Path) -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}])
    row = synthetic.results["t0000"][0]
    synthetic.results["t0000"][0] = row.model_copy(update={"episode_returns": (float("nan"), float("inf"), 9.0)})
    path, _, _ = report(tmp_path, synthetic)
    assert (path.parent / "figures" / "score_per_episode.png").is_file()


@pytest.mark.parametrize(
    ("env_id", "threshold", "stop", "goal"),
    [
        ("CartPole-v1", 123.0, {}, 123.0),
        ("CartPole-v1", 0.0, {}, 0.0),
        ("CartPole-v1", None, {"training_return": 7.0}, 475.0),
        ("Own-v0", None, {"training_return": 0.0, "evaluation_return": None}, 0.0),
        ("evil_module:Own-v0", None, {}, None),
    ],
)
def test_the_goal_is_the_threshold_of_the_env_or_the_stop_rule(
    env_id: str, threshold: float | None, stop: dict[str, float | None], goal: float | None
) -> None:
    synthetic = make_sweep(points=[{"lr": 1e-3}], env_id=env_id, threshold=195.0)
    confirmation = present(synthetic.best).confirmation.model_copy(update={"threshold": threshold})
    best = present(synthetic.best).model_copy(update={"confirmation": confirmation})
    sweep = synthetic.sweep.model_copy(update={"spec": synthetic.sweep.spec | {"stop": stop}})
    assert goal_of(sweep, best) == goal


def test_a_training_that_collapsed_is_told_on_the_card_and_in_the_table(tmp_path: Path) -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 1e-7}], seeds_per_point=3)
    _, _, page = report(tmp_path / "none", synthetic)
    assert "Stability" not in page.words
    assert not any("collapsed" in row for row in page.rows)
    first = present(present(synthetic.best).settings).best.trial_ids[0]
    rows = synthetic.results[first]
    rows[-1] = rows[-1].model_copy(update={"evaluation_return": 9.0})
    _, _, page = report(tmp_path / "one", synthetic)
    most = max(row.evaluation_return for row in rows if row.evaluation_return is not None)
    assert (
        f"Stability 1 of 3 trainings collapsed: {first} from {most:.1f} to 9.0 (best and last evaluation)" in page.words
    )
    assert "A trial collapsed if, by its last evaluation, it had lost more than half" in page.words
    (place,) = (row.index("collapsed") for row in page.rows if "collapsed" in row)
    shown = {row[1]: row[place] for row in page.rows if len(row) > place and row[1] in synthetic.results}
    assert [name for name, text in shown.items() if text == "yes"] == [first]
    assert set(shown.values()) == {"yes", "no"}
