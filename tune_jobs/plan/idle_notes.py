"""Find a sweep's idle hyperparameters: refuse a search over one that changes nothing, and note the others.

`policies.idle.find` decides when a hyperparameter is idle. This module finds the points where it is, and words the
notes. A search is refused only if no two values of its space could give different trials; a fixed value is never
refused.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analysis.points import lacks
from analysis.records import TRAINING_LENGTH
from policies.errors import SpecError
from policies.hyperparams import DQNHyperparams, Hyperparams
from policies.idle.find import NO_UPDATE, RULES, Limits, Rule, idle_rule
from tune_jobs.plan.estimates import max_env_steps, max_iterations
from tune_jobs.spec.conditions import Conditions, named_values
from tune_jobs.spec.domains import Domain, Grid, Layers, Listed, Range
from tune_jobs.spec.training_length import as_trained

if TYPE_CHECKING:
    from policies.envs.make import EnvInfo
    from tune_jobs.spec.sweep_spec import SweepSpec

_MOST_COMBINATIONS = 20_000
"""The most combinations of other searched values that are checked; with more, a search is not refused."""
_MOST_NAMED = 8
"""The most points that a note lists by number; more are counted."""
_DIVIDED_BY_NUM_ENVS = {"ppo": "train_batch_size", "dqn": "train_freq"}
"""What rules that divide have to do with num_envs: whether one holds may change with every step of either."""
_LEAST_SHARE = 0.1
"""The share of the points from which on a note says that values of a range act alike."""


@dataclass(frozen=True)
class _Points:
    """What is known about a sweep's points."""

    spec: SweepSpec
    env: EnvInfo
    values: tuple[Hyperparams | None, ...]
    """All hyperparameters of each point; None: the search method chooses them when the trial starts."""
    is_packed: tuple[bool, ...]
    points: tuple[Mapping[str, Any] | None, ...]
    """The searched values of each point: of what acts in it."""

    @functools.cached_property
    def known(self) -> list[tuple[int, Hyperparams, Limits]]:
        """The index, the hyperparameters and the limits of each point that is known."""
        return [
            (index, values, self.limits(values, as_trained(self.spec, point or {}), is_packed=is_packed))
            for index, (values, point, is_packed) in enumerate(
                zip(self.values, self.points, self.is_packed, strict=True)
            )
            if values is not None
        ]

    def limits(self, values: Hyperparams, spec: SweepSpec, *, is_packed: bool) -> Limits:
        """Return the limits of a trial with these hyperparameters."""
        return Limits(
            num_env_steps=max_env_steps(spec, values),
            num_iterations=max_iterations(spec, values),
            max_episode_steps=self.env.max_episode_steps,
            is_packed=is_packed,
        )


def idle_notes(
    spec: SweepSpec,
    env: EnvInfo,
    values: Sequence[Hyperparams | None],
    is_packed: Sequence[bool],
    points: Sequence[Mapping[str, Any] | None],
    *,
    may_refuse: bool = True,
) -> tuple[str, ...]:
    """Return the plan's notes on hyperparameters that can't act.

    Args:
        spec: The sweep.
        env: Its environment.
        values: All hyperparameters of each point; None: not known yet. At least one point is known.
        is_packed: Whether a pack trains each point's trials.
        points: The searched values of each point, without what does not act in it; None: not known yet.
        may_refuse: Whether the sweep is new. One that exists already may continue, whatever it searches.

    Raises:
        SpecError: The sweep is new, and a search in it can't change anything.
    """
    known = _Points(spec, env, tuple(values), tuple(is_packed), tuple(points))
    names = [name for name in dict.fromkeys([*spec.space, *spec.hyperparams]) if _is_looked_at(spec, name)]
    searched = {name: _values_of(spec.space[name]) for name in names if name in spec.space}
    never: dict[str, str] = {}
    for name in names:
        own = searched.get(name, [getattr(known.known[0][1], name)])
        is_search = len(own) > 1
        if (reason := _why_it_never_acts(known, name, own, is_search=is_search)) is not None:
            never[name] = reason
    refused = {name: reason for name, reason in never.items() if len(searched.get(name, ())) > 1}
    if refused and may_refuse:
        told = "; ".join(f"space.{name}: {reason}" for name, reason in refused.items())
        raise SpecError(
            f"{_listed(refused)} searched, but can't act in any point, so no trial would differ by it: {told}.",
            "Take it out of space, or change what keeps it from acting.",
        )
    notes = [f"{_place(spec, name)} can't act: {reason}." for name, reason in never.items()]
    for name in searched:
        if name not in never:
            notes += _partial_notes(known, name)
    return (*_no_update_notes(known), *notes)


def _listed(names: Mapping[str, Any]) -> str:
    places = [f"space.{name}" for name in names]
    return f"{', '.join(places)} {'is' if len(places) == 1 else 'are'}"


def _is_looked_at(spec: SweepSpec, name: str) -> bool:
    if name == TRAINING_LENGTH:
        return False  # what a training does depends on its length, always
    if spec.rl_module is not None and name.startswith("epsilon_"):
        return False  # the module is a user's own, and may explore as it likes
    return bool(RULES[spec.algorithm][name])


def _place(spec: SweepSpec, name: str) -> str:
    return f"space.{name}" if name in spec.space else f"hyperparams.{name}"


def _values_of(domain: Domain) -> list[Any]:
    """Return values that represent a domain: most rules change at most once between the ends of a range."""
    if isinstance(domain, Listed):
        return list(domain.values)
    if isinstance(domain, Layers):
        return [value for _, value in domain.probes()]
    low, high = domain.bounds
    ends = [int(low), int(high)] if domain.is_whole else [low, high]
    return ends if low < high else ends[:1]


def _named(space: Mapping[str, Domain], name: str) -> list[Any]:
    """Return the values of a range that conditions name, as they may hold with no value between its ends but those."""
    domain = space[name]
    if not isinstance(domain, Range):
        return []
    given = [other.when[name] for other in space.values() if other.when and name in other.when]
    return [domain.of_code(domain.code_of(value)) for each in given for value in named_values(domain, each)]


def _why_it_never_acts(points: _Points, name: str, own: Sequence[Any], *, is_search: bool) -> str | None:
    """Return why no value of a hyperparameter acts, whatever values the others have; None if one may act.

    Args:
        points: The sweep's points.
        name: The hyperparameter's name.
        own: Its values.
        is_search: Whether the hyperparameter is searched: then values that all act alike count as idle.
    """
    if not is_search and (own[0] is None or own[0] is False):
        return None  # it is switched off
    spec = points.spec
    rules = [rule for rule in RULES[spec.algorithm][name] if is_search or not (rule.of_value or rule is NO_UPDATE)]
    if not rules:
        return None
    reads = {read for rule in rules for read in rule.reads if read in spec.space}
    related = {other: spec.space[other] for other in spec.space if other in _with_conditions_of(spec, reads | {name})}
    others = {read: _values_of(domain) + _named(related, read) for read, domain in related.items() if read != name}
    others = {read: list({json.dumps(value): value for value in values}.values()) for read, values in others.items()}
    why = _rules_that_hold(points, name, own, rules, others=others)
    if any(rule.divides for rule in why):
        divided = [read for read in ("num_envs", _DIVIDED_BY_NUM_ENVS[spec.algorithm]) if read in others]
        steps = {read: related[read].all_values(_MOST_COMBINATIONS) for read in divided}
        whole = {read: values for read, values in steps.items() if values is not None}
        # Of too many steps, it is not known that none lets it act.
        why = _rules_that_hold(points, name, own, rules, others=others | whole) if whole == steps else {}
    # Without a reason there were no values with which it acts.
    return "; or ".join(why.values()) or None


def _rules_that_hold(
    points: _Points, name: str, own: Sequence[Any], rules: Sequence[Rule], *, others: Mapping[str, Sequence[Any]]
) -> dict[Rule, str]:
    """Return the rules by which a hyperparameter is idle with each combination of other values, with their reasons.

    Args:
        points: The sweep's points.
        name: The hyperparameter's name.
        own: Its values.
        rules: Those that may hold.
        others: Values of what these read.

    Returns:
        Nothing if it acts with some of the values, or if they are too many to tell.
    """
    if math.prod(map(len, others.values())) * len(own) > _MOST_COMBINATIONS:
        return {}
    spec = points.spec
    related = {other: domain for other, domain in spec.space.items() if other in others or other == name}
    base, conditions = points.known[0][1], Conditions(related)
    why: dict[Rule, str] = {}
    for combination in itertools.product(*others.values()):
        given = dict(zip(others, combination, strict=True))
        if conditions:
            acting = conditions.acting(given | {name: own[0]})
            if name in related and name not in acting:
                continue
            given = {other: given[other] if other in acting else spec.value_without(other) for other in given}
        found = [_first_rule(points, rules, base.model_copy(update={**given, name: value})) for value in own]
        if any(one is None for one in found):
            return {}
        classes = {rule for rule, _ in filter(None, found) if rule.of_value}
        if len(classes) > 1:  # values of different classes act differently
            return {}
        for rule, reason in filter(None, found):
            why.setdefault(rule, reason)
    return why


def _with_conditions_of(spec: SweepSpec, names: Iterable[str]) -> set[str]:
    """Return names and all that their conditions depend on."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in spec.space and name not in found:
            found.add(name)
            waiting += spec.space[name].when or {}
    return found


def _first_rule(points: _Points, rules: Sequence[Rule], values: Hyperparams) -> tuple[Rule, str] | None:
    limits = points.limits(values, points.spec, is_packed=all(points.is_packed))
    for rule in sorted(rules, key=lambda rule: rule.of_value):
        if rule.holds(values, limits):
            return rule, rule.reason(values, limits)
    return None


def _partial_notes(points: _Points, name: str) -> list[str]:
    """Return the notes on a searched hyperparameter that acts, or may act, in some points only."""
    spec, by_rule = points.spec, dict[Rule, tuple[str, list[int]]]()
    for index, found, limits in points.known:
        if lacks(points.points[index] or {}, name):
            continue
        if (rule := idle_rule(spec.algorithm, name, found, limits)) is not None:
            by_rule.setdefault(rule, (rule.reason(found, limits), []))[1].append(index)
    notes = []
    for rule, (reason, indexes) in by_rule.items():
        if rule is NO_UPDATE:
            continue  # noted once for all hyperparameters
        if rule.of_value:
            values = {repr(getattr(points.values[index], name)) for index in indexes}
            is_rare = isinstance(spec.space[name], Range) and len(indexes) < _LEAST_SHARE * len(points.known)
            if len(values) < 2 or is_rare:
                continue
            notes.append(f"space.{name}: its values act alike in {_which(points, indexes)}: {reason}.")
        else:
            notes.append(f"space.{name} can't act in {_which(points, indexes)}: {reason}.{_later(points, name, rule)}")
    return notes


def _later(points: _Points, name: str, rule: Rule) -> str:
    """Return what may change that a searched hyperparameter is idle by a rule, and how to search only where it acts."""
    spec = points.spec
    others = [other for other in rule.reads if other in spec.space and other != name]
    if not others:
        return ""
    later = f" A mutation of {', '.join(others)} may change that." if spec.scheduler.is_population else ""
    return later + (_condition(points, name, rule, others[0]) if len(others) == 1 else "")


def _condition(points: _Points, name: str, rule: Rule, other: str) -> str:
    """Return the condition to give a searched hyperparameter, which is idle with some values of another."""
    spec, (_, base, limits) = points.spec, points.known[0]
    domain = spec.space[other]
    is_tried = spec.search.type == "random" and isinstance(spec.space[name], Grid)
    depends_on_it = any(name in each.reads for each in RULES[spec.algorithm][other])
    if depends_on_it or not isinstance(domain, Listed) or (is_tried and not isinstance(domain, Grid)):
        return ""
    acting = [value for value in domain.values if not rule.holds(base.model_copy(update={other: value}), limits)]
    if not 0 < len(acting) < len(domain.values):
        return ""
    condition = f"{other}: {json.dumps(acting[0] if len(acting) == 1 else acting)}".replace('"', "")
    if spec.space[name].when:
        return f" Add {condition} to its when."
    return f" Give it when: {{{condition}}}, and it is searched only where it acts."


def _no_update_notes(points: _Points) -> list[str]:
    """Return the notes on DQN trials that never learn."""
    found: dict[str, list[int]] = {}
    for index, values, limits in points.known:
        if isinstance(values, DQNHyperparams) and NO_UPDATE.holds(values, limits):
            found.setdefault(NO_UPDATE.reason(values, limits), []).append(index)
    return [f"In {_which(points, indexes)} {reason}." for reason, indexes in found.items()]


def _which(points: _Points, indexes: Sequence[int]) -> str:
    """Describe some points in words."""
    num = len(points.known)
    what = "points" if num == len(points.values) else "points that are known"
    if len(indexes) == num:
        return f"all {what}" if len(points.values) > 1 else "the only point"
    named = f" ({', '.join(map(str, indexes))})" if len(indexes) <= _MOST_NAMED else ""
    return f"{len(indexes):,} of {num:,} {what}{named}"
