"""The next point to try, by whichever search method: in a sweep, or of any list of points that were tried.

Within a sweep `propose_point` is asked, with the records of its trials. What asks without a sweep, such as a benchmark
of the methods, needs neither Ray nor a folder:

    space = load_spec({..., "space": {"lr": {"loguniform": [1e-5, 1e-1]}}}).space
    known = []
    for index in range(32):
        point = next_point("tpe", space, known, index, seed=0)
        known.append(KnownPoint(point, scores=(train(point, seed=0), train(point, seed=1), None)))

A `KnownPoint` (`tune_jobs.search.history`) is a point, the scores of its seeds (None: that one failed), whether it
still runs (`is_running=True`: others are proposed meanwhile), what it had come to at the rungs of a scheduler that it
passed, and, if it was ended at one, that rung and the share of its training that it has had. One that somebody else
tried (`is_own=False`) tells as much, and may be proposed.

One more method is one more module with a function that is a `tune_jobs.search.asking.Method`, a row of `_METHODS`, and
its name in `tune_jobs.spec.sections`.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.points import meaning_of
from analysis.records import TRAINING_LENGTH, PriorRecord, TrialRecord
from policies import random_streams
from policies.errors import CannotRunError, SpecError
from tune_jobs.search.asking import Check, Method, Question
from tune_jobs.search.history import History, KnownPoint
from tune_jobs.search.one_thread import one_thread
from tune_jobs.search.parts import Parts
from tune_jobs.search.prior import weighed_prior, with_prior
from tune_jobs.search.startup import is_enough
from tune_jobs.search.two_objectives import weighed
from tune_jobs.search.warped import rank_of
from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.sweep_spec import SweepSpec

_NUM_DRAWN = 1_000
"""Random points of which one has values that go together, or the search ends."""
_MANY_FAILED = 1 / 3
"""From this share on, a model is told of failures even where all others are equally good."""


@dataclass(frozen=True)
class _ByModule:
    """A method that is loaded when it is asked first, as what it computes with takes a second to load."""

    module: str
    """Of this package; its function `propose` is the method."""
    needs: str | None = None
    """What has to be installed beside tune-jobs, as it is imported."""
    called: str = ""
    """What people call that."""
    extra: str = ""
    """The extra of tune-jobs that installs it."""

    def load(self) -> Method:
        method: Method = importlib.import_module(f"tune_jobs.search.{self.module}").propose
        return method


_METHODS: Mapping[str, _ByModule] = {
    "forest": _ByModule("forest", needs="sklearn", called="scikit-learn", extra="forest"),
    "gp": _ByModule("gp"),
    "tpe": _ByModule("tpe", needs="optuna", called="Optuna", extra="tpe"),
}


def check_installed(method: str) -> None:
    """Check that what a search method needs is installed.

    Args:
        method: `search.type` of a sweep.

    Raises:
        CannotRunError: It isn't; the hint says how to install it.
    """
    known = _METHODS.get(method)
    if known is not None and known.needs is not None and importlib.util.find_spec(known.needs) is None:
        raise CannotRunError(
            f"search.type is {method}, which needs {known.called}, and that is not installed.",
            f"Install it with `pip install 'tune-jobs[{known.extra}]'`, or set search.type to random.",
        )


def propose_point(
    spec: SweepSpec,
    records: Sequence[TrialRecord],
    drawn_index: int,
    check: Check,
    prior: Sequence[PriorRecord] = (),
    *,
    history: History | None = None,
) -> dict[str, Any]:
    """Choose the next point of a sweep by its search method.

    Where the sweep asks for score and cost, the methods are told of both (`two_objectives`).

    The same records give the same point. As long as fewer than `search.num_startup_trials` points have ended, or too
    little of them was trained (see `next_point`), or all that have ended are equally good, the point is the random one
    of its index, or another random one where its values contradict each other or were tried before.

    Args:
        spec: The sweep.
        records: The records of all its trials.
        drawn_index: The index of the point to choose, among those that nobody chose.
        check: Raises SpecError for a point whose values contradict each other; then another is proposed.
        prior: What the search began with. Its points count as ended.
        history: Remembers what the records of this sweep told before, which saves time; None: nothing does.

    Raises:
        SpecError: None of many proposals is valid.
        CannotRunError: What the method needs is not installed.
    """
    known = (history or History(spec)).known_points(records)
    # Where all scores are equal nothing was learnt, and of trainings that learn nothing the shortest is no find.
    if spec.objective.cost is not None and not (
        TRAINING_LENGTH in spec.space and _are_all_equal(with_prior(known, prior))
    ):
        known = weighed(known, drawn_index, spec.seed)
        prior = [weighed_prior(each, drawn_index, spec.seed) for each in prior]
    return next_point(
        spec.search.type, spec.space, with_prior(known, prior), drawn_index, seed=spec.seed,
        num_startup_trials=spec.search.num_startup_trials, num_points=spec.num_samples, check=check,
    )  # fmt: skip


def next_point(
    method: str,
    space: Mapping[str, Domain],
    known: Sequence[KnownPoint],
    index: int,
    *,
    seed: int,
    num_startup_trials: int = 10,
    num_points: int | None = None,
    check: Check = lambda _: None,
) -> dict[str, Any]:
    """Return the next point to try.

    Args:
        method: `random`, or another `search.type` of sweeps.
        space: Domains by name. Grids are lists to choose from.
        known: What was tried before, in order, and what is being tried.
        index: The index of the point, from 0: its random numbers belong to it.
        seed: At least 0; the same seed, index and known points give the same point.
        num_startup_trials: How many points have to end before a model proposes points; until then they are random, and
            as long as all that ended are equally good. Those that a scheduler ended count for the share of their
            training that they have had (decision 40).
        num_points: How many points the search will give in all: when a third of those that don't run have ended, a
            model proposes the next ones however little these were trained. None: not known.
        check: Raises SpecError for a point whose values contradict each other; then another is proposed, except by
            `random`, whose points are all known and checked before.

    Raises:
        SpecError: None of many proposals is valid.
        CannotRunError: What the method needs is not installed.
        KeyError: There is no such method.
    """
    check_installed(method)
    if method == "random":
        return _new_draw(space, known, index, seed, lambda _: None)
    if not is_enough(known, num_startup_trials, num_points) or _are_all_equal(known):
        return _new_draw(space, known, index, seed, check)
    propose, parts = _METHODS[method].load(), Parts(space)
    if parts.are_the_same:
        with one_thread():
            return propose(Question(space, known, index, seed), check)
    seen = [replace(item, point=parts.values_of(item.point)) for item in known]
    question = Question(parts.space, seen, index, seed, parts)
    with one_thread():
        return parts.point_of(propose(question, lambda values: check(parts.point_of(values))))


def _are_all_equal(known: Sequence[KnownPoint]) -> bool:
    """Return whether nothing tells points that ended apart, but a few that failed.

    A model of them knows but where they are. It would go where they are not, and most of such places are in corners of
    the space, while what is to be found is usually in none (decision 40). A few failures say as little: the model would
    go as far from them as it can. Of many it learns what to leave out.
    """
    ended = [point for point in known if not point.is_running]
    scored = [point for point in ended if point.score is not None]
    ranks = map(rank_of, scored if len(ended) - len(scored) < _MANY_FAILED * len(ended) else ended)
    first = next(ranks, None)
    return all(rank == first for rank in ranks)


def _valid_draw(space: Mapping[str, Domain], index: int, seed: int, check: Check) -> dict[str, Any]:
    """Return the random point of an index, or the next of its stream whose values go together.

    Of those that are asked for while the first ones still run, no plan has looked at any.
    """
    last_error: SpecError | None = None
    for point in itertools.islice(_draws(space, index, seed), _NUM_DRAWN):
        try:
            check(point)
        except SpecError as error:
            last_error = error
        else:
            return point
    assert last_error is not None
    raise last_error


def _new_draw(
    space: Mapping[str, Domain], known: Sequence[KnownPoint], index: int, seed: int, check: Check
) -> dict[str, Any]:
    """Return the random point of an index, or the next of its stream that is valid and was not tried before."""
    tried = {meaning_of(item.point) for item in known if item.is_own}

    def check_new(point: dict[str, Any]) -> None:
        if meaning_of(point) in tried:
            raise SpecError("It was tried before.")
        check(point)

    try:
        return _valid_draw(space, index, seed, check_new)
    except SpecError:
        # A space may have no other.
        return _valid_draw(space, index, seed, check)


def _draws(space: Mapping[str, Domain], index: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yield the random point of an index, and others of its stream without end."""
    yield draw_point(space, index, seed)
    rng = random_streams.model_draws(seed, index)
    while True:
        yield Conditions(space).stripped({name: domain.sample(rng) for name, domain in space.items()})
