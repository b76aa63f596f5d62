"""How to repeat a sweep: the command and its file, every hyperparameter, versions, CPU and seeds."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from analysis.domains import arguments_of, conditions_of, kind_of
from analysis.numbering import first_index
from analysis.page.source import Source
from analysis.records import ChosenPointRecord, SweepRecord
from analysis.report_data import run_time_of
from analysis.report_tables import Cell, Table
from analysis.tables import cell_value
from analysis.wording import NONE, moment, number, seed_range, shown_part

_MAX_CPUS = 4


@dataclass(frozen=True)
class Repeat:
    """What the section shows."""

    facts: list[tuple[str, str]]
    spec_yaml: str
    """The resolved sweep file."""
    command: str
    others: str
    """From which trial on a launch of that file gives other trials, and why; empty: it gives all that it names."""
    injected_yaml: str
    """The points that `inject` added, which the file has not; empty: there are none."""
    reproduce: str
    """The command that runs one trial again and compares; empty: none has ended, or they are a population's."""
    hyperparams: Table


def section(source: Source) -> Repeat:
    """Return what the section shows."""
    import yaml

    def as_yaml(data: object) -> str:
        return str(yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None))

    injected = _injected(source.sweep)
    return Repeat(
        facts=[*facts(source.sweep), *_machines(source)],
        spec_yaml=as_yaml(source.sweep.spec),
        command=f"tune-jobs launch {shlex.quote(f'{source.sweep.name}.yaml')} --name {shlex.quote(_again(source))}",
        others=_others(source),
        injected_yaml=as_yaml([item.point for item in injected]) if injected else "",
        reproduce=_reproduce(source),
        hyperparams=hyperparam_table(source.sweep),
    )


def _injected(sweep: SweepRecord) -> tuple[ChosenPointRecord, ...]:
    given = sweep.spec.get("points")
    # Those of the sweep file come first.
    return sweep.chosen_points[len(given) if isinstance(given, list) else 0 :]


def _others(source: Source) -> str:
    """Return from which trial on the sweep file gives others than the sweep has.

    A launch of the file draws all of its points first, and more seeds come last. Where a point was injected, or a
    setting got a seed, before the sweep was extended, what came later has another number, and with it other seeds.
    """
    sweep = source.sweep
    seeds = sweep.spec.get("seeds_per_point")
    if type(seeds) is not int or seeds < 1:
        return ""
    first, why = [], []
    if injected := _injected(sweep):
        first.append(first_index(injected[0].num_points, seeds, sweep.replications))
        why.append("points were injected")
    num_points = 1 + max((trial.point_index for trial in source.trials), default=-1)
    if sweep.replications and (before := sweep.replications[0].num_points) < num_points:
        first.append(before * seeds)
        why.append("the sweep was extended after settings had been given more seeds")
    return f"From t{min(first):04d} on a launch gives other trials, as {' and '.join(why)}." if first else ""


def facts(sweep: SweepRecord) -> list[tuple[str, str]]:
    """Return when, with what and on which seeds the sweep ran."""
    ran = run_time_of(sweep)
    rows = [
        ("started", moment(sweep.started_at)),
        ("ended", moment(sweep.ended_at)),
        *([("time in all", ran)] if ran else []),
        ("sweep seed", str(sweep.spec.get("seed", NONE))),
        ("training seeds", "of each trial, in the table above: they follow from the sweep seed"),
        ("evaluation seeds", seed_range(sweep.evaluation_seeds)),
        ("confirmation seeds", seed_range(sweep.confirmation_seeds)),
        ("address", sweep.address or "this machine"),
        ("git commit", sweep.git_commit or NONE),
    ]
    return rows + sorted(sweep.versions.items())


def hyperparam_table(sweep: SweepRecord) -> Table:
    """Return every hyperparameter of the algorithm: what it was in the sweep, its default, and other names for it."""
    from policies.foreign_names import FOREIGN_NAMES, LIBRARIES, names_for
    from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM

    algorithm = str(sweep.spec.get("algorithm"))
    # Found by comparison, as records are not trusted to name an algorithm that there is.
    known = next((name for name in FOREIGN_NAMES if name == algorithm), None)
    if known is None:
        return Table([], [])
    space, fixed = (sweep.section(name) for name in ("space", "hyperparams"))
    rows = []
    for name, field in HYPERPARAMS_BY_ALGORITHM[known].model_fields.items():
        default = _text(field.get_default(call_default_factory=True))
        if name in space:
            text, kind = f"searched, {_domain(space[name])}", "searched"
        elif name in fixed:
            text, kind = _text(fixed[name]), ""
        else:
            text, kind = default, "pending"
        others = [
            ", ".join(other.name for other in names_for(known, name) if other.library == library) or NONE
            for library in LIBRARIES
        ]
        cells = [Cell(name, name), Cell(text, text, f"wide {kind}".strip()), Cell(default, default)]
        rows.append([*cells, *(Cell(other, other, "wide") for other in others)])
    return Table(["hyperparameter", "in this sweep", "default", *LIBRARIES.values()], rows)


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return number(cell_value(value))


def _domain(domain: Any) -> str:
    """Return a domain in words: "loguniform from 1e-05 to 0.01", "grid of 32, 64"."""
    kind, ends = kind_of(domain), arguments_of(domain)
    if not kind:
        return str(domain)
    if conditions := conditions_of(domain):
        return f"{_domain({kind: ends})}, when {_needed(conditions)}"
    if kind == "layers" and isinstance(ends, Mapping):
        numbers = ends.get("number")
        number_text = " to ".join(map(_text, numbers)) if isinstance(numbers, list | tuple) else _text(numbers)
        return f"{number_text} layers, the size of each {_domain(ends.get('sizes'))}"
    if not isinstance(ends, list | tuple):
        return f"{kind} {ends}"
    texts = [_text(value) for value in ends]
    if kind in ("grid", "choice"):
        return f"{kind} of {', '.join(texts)}"
    step = f" in steps of {texts[2]}" if len(texts) == 3 else ""
    return f"{kind} from {texts[0]} to {' '.join(texts[1:2])}{step}"


def _needed(conditions: Mapping[str, Any]) -> str:
    """Return conditions in words: "replay is prioritized or none, and n_step is 3"."""
    return ", and ".join(
        f"{name} is {' or '.join(map(_text, given)) if isinstance(given, list | tuple) else _text(given)}"
        for name, given in conditions.items()
    )


def _machines(source: Source) -> list[tuple[str, str]]:
    """Return the CPUs that trials were trained on, on which the rounding of numbers depends."""
    cpus: dict[str, None] = {}
    for trial in source.trials:
        # Records of older versions don't say it.
        if "cpu" in trial.ran_with:
            cpus[", ".join(filter(None, (trial.ran_with["cpu"], trial.ran_with.get("instructions"))))] = None
    shown = "; ".join(list(cpus)[:_MAX_CPUS])
    more = f" and {len(cpus) - _MAX_CPUS} others" if len(cpus) > _MAX_CPUS else ""
    return [("CPU", f"{shown}{more}" if cpus else "not recorded; other CPUs round differently")]


def _reproduce(source: Source) -> str:
    if source.is_population:
        return ""
    ended = [trial.trial_id for trial in source.trials if trial.status == "completed"]
    which = source.winner or next(iter(ended), None)
    return "" if which is None else f"tune-jobs reproduce {shlex.quote(shown_part(source.path, which))}"


def _again(source: Source) -> str:
    return f"{source.sweep.name}-again"
