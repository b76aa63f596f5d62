"""The two answers of a sweep: the policy to deploy and the setting to train with, each on a card, and the films."""

from __future__ import annotations

import base64
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.answers import certainty, less_expected, why_unsure
from analysis.best_records import BestRecord, SettingRecord
from analysis.choice_words import COLUMNS, candidate_rows, chosen_from
from analysis.collapse import collapses, collapses_text
from analysis.page.scores import interval_of, score_means, score_text
from analysis.page.source import Source, point_pairs
from analysis.records import SweepRecord, TrialRecord
from analysis.report_tables import Cell, Table
from analysis.selection import NoUsableTrialError, is_current, select_best
from analysis.statistics import episodes_interval, t_interval
from analysis.wording import counted, return_text, shown_path
from policies import random_streams
from policies.acting.movies import still_of
from policies.envs.mask_settings import ACTION_MASK, METHOD, names_in
from policies.envs.wrappers import wrapped_by
from policies.errors import CheckpointError, NotFoundError
from policies.portable.file import read_policy

_NUMBERS = ("episodes", "score")
_MAX_AVERAGED = 1e150
_MEDIA_TYPES = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
_FILM_TITLES = {
    "before": "Before training: random actions",
    "after": "After training: the winner, greedy",
    "side_by_side": "Before and after, on the same seed",
}
_FILM_TITLES_UNTRAINED = {"before": "Random actions", "after": "The winner"}
"""A baseline has not been trained, so it has no before and after."""


@dataclass(frozen=True)
class Film:
    """A film as a part of the page."""

    title: str
    kind: str
    """What it is shown by: "video" or "image"."""
    source: str
    """Its data, as a URL."""
    still: str | None
    """A picture of it for print, as a URL; None: there is none."""


@dataclass(frozen=True)
class SettingCard:
    """The setting to train with."""

    point: list[tuple[str, str]]
    score: str
    means: str
    """What the score is: "in the later half of training"."""
    interval: str | None
    """None: nothing says how much seeds differ."""
    expected: str
    """What is to be expected of more seeds; empty: as much as its score."""
    badge: tuple[str, str] | None
    """Whether its seeds solved the env: the text and its CSS class; None: there is no threshold."""
    certainty: str
    """How sure it is the best."""
    trial_ids: str
    num_failed: int
    collapsed: str
    """Which of them collapsed; empty: none."""
    is_the_winners: bool
    """Whether the policy to deploy was trained with it."""


@dataclass(frozen=True)
class Cards:
    """The cards; one that is None is not shown."""

    policy: dict[str, Any] | None
    setting: SettingCard | None
    why_no_policy: tuple[str, str] | None
    """Why there is no policy, and what to do."""
    films: list[Film]


def section(source: Source, films: Mapping[str, Path]) -> Cards:
    """Return the cards of a sweep.

    Args:
        source: The sweep.
        films: Files to embed, by "before", "after" or another name; those that do not exist are left out.
    """
    best = source.best
    titles = _FILM_TITLES if source.is_trained else _FILM_TITLES_UNTRAINED
    # The winner comes first.
    shown = sorted(films.items(), key=lambda item: item[0] == "before")
    return Cards(
        policy=None if best is None else winner_card(best, source.trials, source.sweep, source.place),
        setting=setting_card(source),
        why_no_policy=source.why_no_best or why_no_best(source.trials, source.place) if best is None else None,
        films=[_embed(name, path, titles) for name, path in shown if path.is_file()],
    )


def _embed(name: str, path: Path, titles: Mapping[str, str]) -> Film:
    media_type = _MEDIA_TYPES.get(path.suffix.lower(), "video/mp4")
    kind = media_type.partition("/")[0]
    picture = still_of(path) if kind == "video" else None
    return Film(
        title=titles.get(name, name),
        kind=kind,
        source=_url(media_type, path.read_bytes()),
        still=None if picture is None else _url("image/jpeg", picture),
    )


def _url(media_type: str, data: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def winner_card(best: BestRecord, trials: Sequence[TrialRecord], sweep: SweepRecord, place: str) -> dict[str, Any]:
    """Return the winner's data: its point, both scores, its rivals, the random baseline, and how to load it."""
    confirmation, random, choice = best.confirmation, best.random, best.choice
    interval = gain = None
    if _have_mean(confirmation.returns):
        # Episodes that are all alike say nothing of how others would differ.
        if len(set(confirmation.returns)) > 1:
            interval = episodes_interval(confirmation.returns, rng=random_streams.fixed())
        if _have_mean(random.returns) and random.seeds == confirmation.seeds and confirmation.num_episodes > 1:
            # Pairs of one seed meet the same initial states. By this very interval it is told whether it learned.
            gain = t_interval(
                [ours - theirs for ours, theirs in zip(confirmation.returns, random.returns, strict=True)]
            )
    # Of a sweep in an object store the sweep is what can be named: its best is what is evaluated and loaded.
    policy = shown_path(place if "://" in place else Path(place, "best", "policy.json"))
    return {
        "trial_id": best.checkpoint.trial_id,
        "iteration": best.checkpoint.iteration,
        "num_env_steps": best.checkpoint.num_env_steps,
        "seed": best.seed,
        "point": point_pairs(best.point),
        "selection_score": best.selection_score,
        "num_selection_episodes": len(sweep.evaluation_seeds) if choice is None else choice.winner.num_episodes,
        "confirmation": confirmation,
        "is_finite": math.isfinite(confirmation.mean_return),
        "interval": interval,
        "gain": gain,
        "random": random,
        "optimism_gap": best.optimism_gap,
        "evaluate_command": f"tune-jobs evaluate {shlex.quote(policy)}",
        "load_code": loading_code(policy, Path(place, "best")),
        "stale": not is_current(best, trials),
        "chosen_from": "" if choice is None else chosen_from(choice),
        "candidates": candidate_table(best),
        "choice_note": "" if choice is None else choice.note,
    }


def loading_code(policy: str, folder: Path) -> str:
    """Return how a policy is loaded and acts, as Python.

    Args:
        policy: How it is named.
        folder: Where it lies.
    """
    acting = acting_code(folder)
    names = "allow_modules, load_policy" if acting.startswith("allow_modules(") else "load_policy"
    return f"from tune_jobs import {names}\n\npolicy = load_policy({policy!r})\n{acting}"


def acting_code(folder: Path) -> str:
    """Return how the policy in a folder acts, as Python.

    What an environment with wrappers of ours observes comes from one that is made with them; a mask is beside the
    observation if the policy takes it so.
    """
    try:
        policy = read_policy(folder)
    except (CheckpointError, NotFoundError):
        # It is in an object store, or not written yet.
        return "action = policy.act(observation)"
    if wrapped := wrapped_by(policy.env_args):
        module, colon, _ = policy.env_id.partition(":")
        allows = f"allow_modules([{module!r}])\n" if colon else ""
        return (
            f"{allows}env = policy.make_env()  # with {wrapped}\nobservation, info = env.reset()\n"
            "action = policy.act(observation)"
        )
    if not policy.needs_mask:
        return "action = policy.act(observation)"
    # As `policies.envs.masks` finds it: a mask that was not asked for is a method's, and a method goes before an info.
    setting = policy.env_args.get(ACTION_MASK)
    if setting is None:
        return f"action = policy.act(observation, mask={_called(METHOD)})"
    name, method = names_in(setting)
    return f"action = policy.act(observation, mask=info[{json.dumps(name)}])  # or {_called(method)}, if there is one"


def _called(method: str) -> str:
    return f"env.get_wrapper_attr({json.dumps(method)})()"


def setting_card(source: Source) -> SettingCard | None:
    """Return the setting to train with; None if the sweep has one setting, or none that can be judged."""
    settings = source.settings
    if settings is None or settings.num_settings < 2 or not source.is_trained:
        return None
    best = settings.best
    return SettingCard(
        point=point_pairs(best.point),
        score=score_text(settings, best.score),
        means=score_means(settings),
        interval=interval_of(settings, best),
        expected=less_expected(settings),
        badge=_solved_badge(best),
        certainty=f"{why_unsure(settings).capitalize()}." if best.probability_best is None else certainty(settings),
        trial_ids=", ".join(best.trial_ids),
        num_failed=best.num_failed,
        collapsed=collapses_text(
            collapses(best.trial_ids, source.trials, source.results), num_trainings=len(best.trial_ids)
        ),
        is_the_winners=source.winner in best.trial_ids,
    )


def _solved_badge(setting: SettingRecord) -> tuple[str, str] | None:
    if setting.num_solved is None:
        return None
    num_seeds = len(setting.scores)
    kind = "good" if setting.num_solved == num_seeds else "" if setting.num_solved else "bad"
    return (f"solved in training with {setting.num_solved:,} of {counted(num_seeds, 'seed')}", kind)


def why_no_best(trials: Sequence[TrialRecord], place: str) -> tuple[str, str]:
    """Return message and hint for a sweep that has no confirmed winner."""
    try:
        selection = select_best(trials)
    except NoUsableTrialError as error:
        return error.message, error.hint
    return (
        f"{selection.trial.trial_id} leads with {return_text(selection.score)}, not confirmed on fresh seeds yet.",
        f"Run: tune-jobs best {shlex.quote(shown_path(place))}",
    )


def candidate_table(best: BestRecord) -> Table:
    """Return what the policy was chosen from, one row a candidate, the winner first."""
    rows = [
        [
            # Numbers are to the right, which columns of known texts are not.
            Cell(None if column in _NUMBERS else text, text, "wide" if column == "rejected" else "")
            for column, text in zip(COLUMNS, row.cells, strict=True)
        ]
        for row in candidate_rows(best)
    ]
    return Table(list(COLUMNS), rows)


def _have_mean(values: Sequence[float]) -> bool:
    """Whether there are values, all finite, whose sums and squares are finite too."""
    return len(values) > 0 and all(abs(value) < _MAX_AVERAGED for value in values)
