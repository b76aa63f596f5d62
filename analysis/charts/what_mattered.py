"""Charts of what mattered: the score by each hyperparameter, by the top two together, and by all at once."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from analysis.charts.columns import shown_note, trials_table
from analysis.charts.model import Axis, Cell, Chart, Column, HeatMap, Panels, Parallel, Trials
from analysis.charts.subject import Subject
from analysis.wording import counted, return_text

_MAX_BINS = 5
_MIN_TRIALS = 2
_PALE = " Where a line is pale, it passes by what does not act in its trial."


def make_charts(subject: Subject) -> list[Chart]:
    """Return the charts of what mattered."""
    names = subject.varied_names
    trials = trials_table(subject, names)
    why_not = _why_not(subject, trials)
    marks = _marks(trials)
    values = " Its values are those that it ended with, as a population changes them." if subject.is_population else ""
    panels = Chart(
        "hyperparameters",
        "mattered",
        "Score against each hyperparameter",
        f"Each dot is a trial; panels in the order of {subject.order_of_names}, colours by the first of them.{values}",
        None if why_not else Panels(trials),
        why_not,
        (*marks, *shown_note(trials)),
    )
    why_no_lines = why_not
    if not why_not and len(names) < 2:
        why_no_lines = "One hyperparameter alone was searched, so the panel above shows all there is."
    parallel = Chart(
        "parallel_coordinates",
        "mattered",
        "All hyperparameters at once",
        "Each line is a trial, coloured by its score; drag along an axis to choose a range, which the table of all "
        f"trials then keeps to.{_PALE if any(None in column.values for column in trials.columns) else ''}",
        None if why_no_lines else Parallel(trials),
        why_no_lines,
        (*marks, *shown_note(trials)),
    )
    return [panels, _heat_map(trials, why_not), parallel]


def _why_not(subject: Subject, trials: Trials) -> str:
    """Return why the score can't be shown by hyperparameters; empty if it can."""
    known = [score for score in trials.scores if score is not None]
    if not known:
        return "No trial has a score, so nothing can be said of what mattered." if trials.ids else "No trial has begun."
    if len(trials.ids) < _MIN_TRIALS:
        return "One trial alone shows nothing of what mattered: that takes several settings."
    if not trials.columns:
        return "All trials have the same values, so no hyperparameter can have mattered."
    if len(set(known)) == 1:
        return (
            f"All {counted(len(known), 'score')} are {return_text(known[0])}: they can't show which hyperparameter "
            f"mattered ({subject.score_name})."
        )
    return ""


def _marks(trials: Trials) -> tuple[str, ...]:
    """Say which marks are not of whole trials."""
    num = {ending: trials.endings.count(ending) for ending in ("cut", "unfinished", "failed")}
    notes = []
    if num["cut"] or num["unfinished"]:
        parts = [f"{counted(num['cut'], 'trial')} that a scheduler cut early"] if num["cut"] else []
        parts += [f"{counted(num['unfinished'], 'trial')} that did not end yet"] if num["unfinished"] else []
        notes.append(f"Hollow or dashed: {' and '.join(parts)}, whose scores are of fewer env steps.")
    if num["failed"]:
        notes.append(f"Crosses: {counted(num['failed'], 'trial')} without a score.")
    return tuple(notes)


def _heat_map(trials: Trials, why_not: str) -> Chart:
    top = _top_two(trials)
    title = "Mean score by " + (" and ".join(column.axis.name for column in top) if len(top) == 2 else "two")
    if not why_not and len(top) < 2:
        why_not = "A heat map takes two hyperparameters, and one was searched."
    whole = [
        index
        for index, ending in enumerate(trials.endings)
        if ending == "whole" and all(column.values[index] is not None for column in top)
    ]
    if not why_not and len(whole) < _MIN_TRIALS:
        why_not = "Fewer than two trials in which both act trained to their end, so there are no means to compare."
    left_out = sum(ending in ("cut", "unfinished") for ending in trials.endings)
    notes: tuple[str, ...] = ()
    if left_out:
        notes = (f"{counted(left_out, 'trial')} that did not train to the end left out.",)
    num_idle = sum(any(column.values[index] is None for column in top) for index in range(len(trials.ids)))
    if len(top) == 2 and num_idle:
        notes += (f"{counted(num_idle, 'trial')} in which one of the two does not act left out.",)
    caption = "Mean score, and number, of the trials in each cell, by the first two hyperparameters of the panels."
    if why_not:
        return Chart("heat_map", "mattered", title, caption, None, why_not)
    (x, x_places), (y, y_places) = (_binned(column, whole) for column in top)
    members: defaultdict[tuple[int, int], list[float]] = defaultdict(list)
    for index, *cell in zip(whole, x_places, y_places, strict=True):
        score = trials.scores[index]
        if score is not None:
            members[cell[0], cell[1]].append(max(-1e100, min(1e100, score)))
    cells = tuple(
        Cell(x_place, y_place, math.fsum(scores) / len(scores), len(scores), max(scores))
        for (x_place, y_place), scores in sorted(members.items())
    )
    return Chart("heat_map", "mattered", title, caption, HeatMap(x, y, trials.score, cells), notes=notes)


def _top_two(trials: Trials) -> Sequence[Column]:
    """Return the most important hyperparameter, and the next one that acts in trials in which it does."""
    for second in trials.columns[1:]:
        first = trials.columns[0]
        both = zip(first.values, second.values, strict=True)
        if sum(None not in values for values in both) >= _MIN_TRIALS:
            return first, second
    return trials.columns[:2]


def _binned(column: Column, indices: Sequence[int]) -> tuple[Axis, list[int]]:
    """Return a hyperparameter as an axis of categories, a range cut into equal parts of its scale."""
    values = [column.values[index] for index in indices]
    if column.axis.kind == "category":
        return column.axis, [int(value or 0) for value in values]
    numbers = np.array(values, dtype=np.float64)
    scaled = np.log10(numbers) if column.axis.kind == "log" else numbers
    num_bins = max(1, min(_MAX_BINS, len(set(values)), round(math.sqrt(len(values)))))
    edges = np.linspace(scaled.min(), scaled.max(), num_bins + 1)
    places = np.clip(np.searchsorted(edges, scaled, side="right") - 1, 0, num_bins - 1)
    shown = 10**edges if column.axis.kind == "log" else edges
    labels = [f"{low} to {high}" for low, high in itertools.pairwise(_told_apart(shown.tolist()))]
    return Axis(column.axis.name, "category", tuple(labels)), [int(item) for item in places]


def _told_apart(numbers: Sequence[float]) -> list[str]:
    """Return numbers in as few digits as tell different ones apart, two at least."""
    for digits in range(2, 16):
        # Twice, as 1,050 of three digits alone is 1.05e+03.
        texts = [f"{float(f'{value:.{digits}g}'):.15g}" for value in numbers]
        if len(set(texts)) == len(set(numbers)):
            break
    return texts
