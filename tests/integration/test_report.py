"""The report of a sweep that went well: complete, self-contained, and what each part of it says."""

import base64
import hashlib
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from synthetic_sweep import Synthetic, make_points, make_sweep, with_choice

from analysis.answers import certainty
from analysis.choice_words import candidate_rows
from analysis.wording import (
    NONE,
)
from tests.integration.report_page import Page, report
from tests.narrowing import present

CHARTS = (
    "hyperparameters", "heat_map", "parallel_coordinates", "curves_of_settings", "performance_profile", "best_so_far",
)  # fmt: skip
"""The charts of a sweep whose records hold no times."""

Made = tuple[Synthetic, Path, str, Page]
"""A sweep, the path of its report, its HTML and what is on the page."""


@pytest.fixture(scope="module")
def typical(tmp_path_factory: pytest.TempPathFactory) -> Made:
    synthetic = make_sweep(failed={3})
    folder = tmp_path_factory.mktemp("typical")
    (folder / "before.mp4").write_bytes(b"before-bytes")
    (folder / "after.gif").write_bytes(b"after-bytes")
    videos = {"before": folder / "before.mp4", "after": folder / "after.gif", "other": folder / "gone.mp4"}
    return synthetic, *report(folder, synthetic, videos)


def test_the_winner_stands_on_the_page(typical: Made) -> None:
    synthetic, _, html, page = typical
    best = present(synthetic.best)
    assert f"Winner {best.checkpoint.trial_id} at iteration {best.checkpoint.iteration}," in page.words
    assert f"{best.confirmation.mean_return:.1f} ± {best.confirmation.std_return:.1f}" in page.words
    assert f"{best.selection_score:.1f} on 10 evaluation episodes" in page.words
    assert f"{best.optimism_gap:+.1f} (selection less confirmation)" in page.words
    assert f"{best.random.mean_return:.1f} ± {best.random.std_return:.1f}" in page.words
    assert "100 greedy episodes" in page.words
    assert f"hidden_sizes {best.point['hidden_sizes'][0]}" in page.words
    assert f"lr {best.point['lr']:.4g}" in page.words
    assert '<span class="badge good">solved</span>' in html


def test_the_setting_stands_beside_the_policy(typical: Made, tmp_path: Path) -> None:
    _, path, _, page = typical
    assert "Setting to train with" in page.words
    assert "One seed a setting names a good policy, not a good setting." in page.words
    assert f"tune-jobs replicate {path.parent.parent}" in page.words
    several = make_sweep(seeds_per_point=5, points=make_points(1, np.random.default_rng(0)))
    settings = present(present(several.best).settings)
    _, _, page = report(tmp_path, several)
    assert ", ".join(settings.best.trial_ids) in page.words
    assert f"How sure {certainty(settings)}" in page.words
    (score,) = re.findall(r"in the later half of training; 95 % interval (\S+) to \S+, over training seeds", page.words)
    assert score == f"{settings.best.lower:.1f}"
    badge = f"solved in training with {settings.best.num_solved} of 5 seeds"
    assert badge in page.words
    one = make_sweep(points=make_points(1, np.random.default_rng(0))[:1])
    assert "Setting to train with" not in report(tmp_path / "one", one)[2].words


def test_the_loading_command_names_the_policy_file(typical: Made) -> None:
    _, path, _, page = typical
    policy = path.parent.parent / "best" / "policy.json"
    assert f"tune-jobs evaluate {policy}" in page.words
    assert f"load_policy({str(policy)!r})" in page.words


def test_all_trials_stand_in_the_table_best_first(typical: Made) -> None:
    synthetic, _, _, page = typical
    rows = [row for row in page.rows if re.fullmatch(r"t\d{4}", row[1])]
    assert {row[1] for row in rows} == {trial.trial_id for trial in synthetic.trials}
    assert rows[0][1] == present(synthetic.best).checkpoint.trial_id
    assert rows[-1][:3] == [NONE, "t0003", "failed"]
    scores = [float(row[0]) for row in rows[:-1]]
    assert scores == sorted(scores, reverse=True)


def test_errors_are_visible_and_linked(typical: Made) -> None:
    _, _, _, page = typical
    assert "t0003 RuntimeError: env.step raised ZeroDivisionError: the cart left the track" in page.words
    assert "Last lines of trials/t0003/log.txt" in page.words
    assert ("a", {"href": "#error-t0003"}) in page.tags
    assert any(tag == "details" and attrs.get("id") == "error-t0003" for tag, attrs in page.tags)


def test_videos_are_embedded_and_missing_ones_left_out(typical: Made) -> None:
    _, _, _, page = typical
    (video,) = [attrs for tag, attrs in page.tags if tag == "video"]
    assert video["src"] == "data:video/mp4;base64," + base64.b64encode(b"before-bytes").decode()
    assert {"autoplay", "loop", "muted", "controls"} <= set(video)
    (image,) = [attrs for tag, attrs in page.tags if tag == "img"]
    assert image["src"] == "data:image/gif;base64," + base64.b64encode(b"after-bytes").decode()


def test_nothing_is_loaded_from_elsewhere(typical: Made) -> None:
    _, _, html, page = typical
    for tag, attrs in page.tags:
        for name in ("src", "href", "xlink:href", "data", "srcset"):
            assert present(attrs.get(name, "#")).startswith(("#", "data:")), (tag, name)
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html


def test_the_policy_of_the_page_allows_its_own_scripts_alone(typical: Made) -> None:
    _, _, html, page = typical
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    assert len(scripts) == 3
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests)
    assert f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:" in html
    data = [attrs for tag, attrs in page.tags if tag == "script" and attrs]
    assert data == [{"type": "application/json", "id": "chart-data"}]


def test_tables_and_figures_lie_beside(typical: Made) -> None:
    synthetic, path, html, page = typical
    figures = sorted(file.name for file in (path.parent / "figures").iterdir())
    old, charts = ["learning_curves", "score_by_lr", "score_per_episode", "settings_by_seed"], [*CHARTS]
    assert figures == sorted(
        [f"{name}.{kind}" for name in old for kind in ("pdf", "png", "svg")]
        + [f"{name}.{kind}" for name in charts for kind in ("pdf", "svg")]
    )
    begin = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    for name in figures:
        file = path.parent / "figures" / name
        assert file.read_bytes().startswith(begin[file.suffix])
    # Two figures are no charts, and have two sizes; a chart has a picture for pages without scripts.
    assert html.count("<svg ") == 2 * 2 + len(charts)
    assert [attrs["data-chart"] for _, attrs in page.tags if "data-chart" in attrs] == charts
    assert len(pd.read_csv(path.parent / "trials.csv")) == 20
    assert len(pd.read_csv(path.parent / "steps_to_solve.csv")) == 20
    assert len(pd.read_csv(path.parent / "iterations.csv")) == sum(map(len, synthetic.results.values()))


def test_how_it_was_run_is_told(typical: Made) -> None:
    synthetic, _, html, page = typical
    for text in ("2.60.0", "0123456789abcdef", "1 min 10 s", "10 (4711 to 4720)", "100 (900000 to 900099)"):
        assert text in page.words
    (spec,) = re.findall(r"<summary>Sweep file, resolved</summary>\s*<div[^>]*><pre>(.*?)</pre>", html, re.DOTALL)
    assert yaml.safe_load(spec) == synthetic.sweep.spec


def test_what_the_sweep_file_says_of_the_sweep_stands_at_the_head(tmp_path: Path, typical: Made) -> None:
    synthetic = make_sweep()
    about = {"title": "Which size?", "source": None, "expected": "195 & more", "description": "Two\nlines."}
    synthetic.sweep = synthetic.sweep.model_copy(update={"spec": {**synthetic.sweep.spec, "about": about}})
    _, html, page = report(tmp_path, synthetic)
    assert '<p class="lines">Which size?</p>' in html
    assert "Two lines. Expected by the sweep file: 195 & more" in page.words
    assert "sweep file:" not in typical[-1].words


def test_the_leading_settings_are_shown_with_seeds_intervals_and_ties(tmp_path: Path) -> None:
    synthetic = make_sweep(points=make_points(1, np.random.default_rng(0)), seeds_per_point=3, failed={4})
    settings = present(present(synthetic.best).settings)
    _, _, page = report(tmp_path, synthetic)
    headings = page.rows.index([
        "rank", "hidden_sizes", "activation", "lr", "seeds", "solved", "score in the later half of training",
        "95 % interval over training seeds", "P(best)", "tie group",
    ])  # fmt: skip
    first, *others = page.rows[headings + 1 : headings + 1 + len(settings.ranking)]
    best = settings.best
    assert first[4:8] == [
        "3", str(best.num_solved), f"{best.score:.1f}", f"{best.lower:.1f} to {best.upper:.1f}",
    ]  # fmt: skip
    assert "a" in first[9]
    assert any(row[4] == "3, 1 failed" for row in others)
    assert "A seed that failed counts as the worst score of the sweep." in page.words


def test_one_seed_a_setting_has_no_interval_and_says_so(typical: Made) -> None:
    _, _, _, page = typical
    assert "nothing says that the first is the best" in page.words
    assert "The first 10 of 20 settings." in page.words
    assert "P(best)" not in page.words


def test_the_page_says_what_solves_in_the_fewest_env_steps(typical: Made) -> None:
    _, path, _, page = typical
    first = pd.read_csv(path.parent / "steps_to_solve.csv").iloc[0]
    steps = f"{int(first['median_num_env_steps']):,}"
    assert (
        f"hidden_sizes {first['hidden_sizes']}, activation {first['activation']}, lr {first['lr']:.4g} reaches a mean "
        f"training return of 195 over 100 episodes in the fewest env steps: {steps} (one seed)."
    ) in page.words
    header = page.rows.index([
        "hidden_sizes", "activation", "lr", "seeds that solve", "median env steps", "env steps of each seed",
    ])  # fmt: skip
    assert page.rows[header + 1][3:] == ["1 of 1", steps, steps]
    assert all("0 of" not in row[3] for row in page.rows[header + 1 : header + 8])


def test_steps_to_solve_are_told_seed_by_seed(tmp_path: Path) -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 1e-7}], seeds_per_point=3, failed={1})
    _, _, page = report(tmp_path, synthetic)
    (row,) = [row for row in page.rows if "not solved" in row[-1]]
    assert row[1] == "2 of 3"
    one, _, other = row[3].split(", ")
    assert row[3] == f"{one}, not solved, {other}"
    assert "(the median of 3 seeds)" in page.words


def test_the_policys_card_shows_what_it_was_chosen_from(tmp_path: Path) -> None:
    synthetic = make_sweep()
    best = with_choice(present(synthetic.best), synthetic.trials)
    synthetic.best = best
    _, _, page = report(tmp_path, synthetic)
    winner = present(best.choice).winner
    assert f"on {winner.num_episodes} evaluation episodes" in page.words
    assert "Chosen from 27 kept checkpoints: the leading 3 (1 other left out) in 2 rounds" in page.words
    for row in candidate_rows(best):
        assert " ".join(row.cells) in page.words
    assert "There are other candidates by now" not in page.words
    assert "Round 2 could not be played: the motor broke" in page.words
