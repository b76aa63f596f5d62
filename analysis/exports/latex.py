r"""The settings of a sweep as a LaTeX table, for a paper: \usepackage{booktabs} is all that it needs."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.exports.frames import SweepData, intervals_of, num_solved, ranked_settings
from analysis.objectives import SettingScores, never_reached
from analysis.points import value_text
from analysis.records import Objective
from analysis.statistics import Estimate
from analysis.tables import point_names
from analysis.wording import return_text

NUM_LISTED = 10
_MISSING = "--"
_ESCAPED = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
}  # fmt: skip
_SCORES: dict[Objective, str] = {
    "final": "final return",
    "area": "mean return over training",
    "best": "best evaluation return",
    "steps_to_threshold": "env steps to threshold",
}


def latex_table(data: SweepData, *, name: str, env_id: str, top: int = NUM_LISTED) -> str:
    r"""Return a table of the leading settings: values, seeds, mean, interval over training seeds, seeds that solved.

    Args:
        data: The sweep.
        name: Its name, for the caption and the label `tab:NAME`.
        env_id: Its environment, for the caption.
        top: How many settings it has.
    """
    ranking = ranked_settings(data)
    listed = list(zip(ranking, intervals_of(ranking), strict=True))[:top]
    names = point_names(data.trials)
    solving = data.threshold is not None
    headings = [*names, "seeds", _SCORES[data.objective], r"95\,\% interval", *(["solved"] if solving else [])]
    rows = [_row(item, interval, names, data, solving=solving) for item, interval in listed]
    columns = "l" * len(names) + "r" * (len(headings) - len(names))
    shown = f"The best {len(rows)} of {len(ranking)} settings" if len(rows) < len(ranking) else "Settings"
    lines = [
        r"% In the preamble: \usepackage{booktabs}",
        r"\begin{table}[t]",
        r"\centering",
        f"\\caption{{{escaped(f'{shown} of {name} on {env_id}.')} {_about(listed, data)}}}",
        f"\\label{{tab:{''.join(letter if letter.isalnum() else '-' for letter in name)}}}",
        f"\\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        _line([heading if heading.startswith("95") else escaped(heading) for heading in headings]),
        r"\midrule",
        *map(_line, rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    """Return text as LaTeX prints it."""
    return "".join(_ESCAPED.get(letter, letter) for letter in text)


def _about(listed: Sequence[tuple[SettingScores, Estimate | None]], data: SweepData) -> str:
    """Return what the numbers of the table are."""
    if not listed:
        return "None of its trials has ended with anything to be judged by."
    parts = ["Means over training seeds"]
    if any(interval is not None for _, interval in listed):
        parts.append(r", with moderated $t$ intervals (Smyth, 2004)")
    parts.append("; settings are ranked by the mean that is expected of more seeds.")
    if data.threshold is not None:
        goal = f"{data.threshold:g}"
        parts.append(f" Solved: seeds whose mean training return over 100 episodes reached {_number_of(goal)}.")
    never = never_reached(data.longest)
    if data.objective == "steps_to_threshold" and any(never in item.scores for item, _ in listed):
        parts.append(f" A seed that never reaches it counts as {-never:.0f}, twice the longest training.")
    if any(item.num_failed for item, _ in listed):
        worst = "one that never reaches it" if data.objective == "steps_to_threshold" else "the worst trial"
        parts.append(f" A failed seed counts as {worst}.")
    return "".join(parts)


def _row(
    item: SettingScores, interval: Estimate | None, names: Sequence[str], data: SweepData, *, solving: bool
) -> list[str]:
    in_steps = data.objective == "steps_to_threshold"
    # Fewer env steps are better, so that they are scored below zero.
    ends = [] if interval is None else [interval.lower, interval.upper]
    low_high = sorted(-end for end in ends) if in_steps else ends
    shown = [_shown(value, *low_high, in_steps=in_steps) for value in low_high]
    cells = [
        *(escaped(value_text(item.point, name)) for name in names),
        str(len(item.scores)),
        _shown(-item.mean if in_steps else item.mean, in_steps=in_steps),
        f"{shown[0]} to {shown[1]}" if shown else _MISSING,
    ]
    return [*cells, f"{num_solved(item, data)} of {len(item.scores)}"] if solving else cells


def _shown(value: float, *beside: float, in_steps: bool) -> str:
    return _number_of(f"{max(0.0, value):.0f}" if in_steps else return_text(value, *beside))


def _number_of(text: str) -> str:
    # In text mode a minus would be a hyphen.
    return f"$-${text[1:]}" if text.startswith("-") else text


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
