"""The points of a sweep: how many there are, what messages call them, and the hyperparameters of their trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from analysis.numbering import first_index
from analysis.records import TRAINING_LENGTH, ChosenPointRecord, ReplicationRecord
from analysis.wording import counted
from policies.errors import SpecError
from policies.hyperparams import Hyperparams, PPOHyperparams, RandomHyperparams, make_hyperparams
from policies.wrong_values import details_of, dotted, explain
from tune_jobs.plan.estimates import asked_env_steps
from tune_jobs.spec.draws import draw_points, num_different, num_points
from tune_jobs.spec.seeds import SEEDS_PER_TRIAL
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import hyperparams_in


def trial_id(index: int) -> str:
    """Return the id of a trial, such as t0007; ids sort by index up to 10,000 trials."""
    return f"t{index:04d}"


def num_points_of(spec: SweepSpec, chosen_points: Sequence[ChosenPointRecord] = ()) -> int:
    """Return the number of a sweep's points, those among them that somebody chose."""
    drawn = spec.num_samples if spec.search.has_model else num_points(spec.space, spec.num_samples)
    return drawn + len(chosen_points)


def repeated_points_notes(spec: SweepSpec) -> list[str]:
    """Return a note if points of a sweep must be the same as others, which then count as settings of their own."""
    if spec.scheduler.is_population:
        return []
    if (
        spec.search.type == "random"
        and spec.num_samples > 1
        and not any(domain.is_random for domain in spec.space.values())
    ):
        repeats = f"The space has no random domain, so num_samples {spec.num_samples} repeats every point"
        return [f"{repeats}; seeds_per_point does that and averages over the seeds."]
    again = "; seeds_per_point trains each again, and averages over the seeds."
    num_tried = num_points_of(spec)
    number = num_different(spec.space, num_tried)
    if number is not None and number < num_tried:
        different = counted(number, "different point")
        return [f"The space has {different}, so some of the {num_tried} that num_samples gives are the same{again}"]
    if spec.search.type != "random" or spec.num_samples == 1 or not any(item.when for item in spec.space.values()):
        return []
    # What is random depends on grids in the end, so that it acts with all samples of their combination, or with none.
    combinations = draw_points(spec.space, 1, spec.seed)
    fixed = sum(not any(spec.space[name].is_random for name in point) for point in combinations)
    without = f"No random domain acts in {fixed:,} of the {counted(len(combinations), 'combination')} of grids"
    return [f"{without}, so num_samples {spec.num_samples} repeats what has them{again}"] if fixed else []


def num_trials_of(
    spec: SweepSpec,
    replications: Sequence[ReplicationRecord] = (),
    chosen_points: Sequence[ChosenPointRecord] = (),
) -> int:
    """Return the number of a sweep's trials, those among them of chosen points and of more seeds of some points."""
    searched = num_points_of(spec, chosen_points) * spec.seeds_per_point
    return searched + sum(len(item.points) for item in replications)


def point_hyperparams(
    spec: SweepSpec,
    point: Mapping[str, Any],
    point_index: int | None,
    replications: Sequence[ReplicationRecord] = (),
) -> Hyperparams:
    """Return all hyperparameters of a point's trials, validated.

    Args:
        spec: The sweep.
        point: The searched values.
        point_index: The point's index; None: it is not one of the sweep's yet.
        replications: More seeds of some points, oldest first; they decide which trial is a point's first.

    Raises:
        SpecError: The values contradict each other.
    """
    place = place_of_point(spec, point, point_index, replications)
    try:
        values = make_hyperparams(spec.algorithm, {**spec.hyperparams, **hyperparams_in(point)})
    except ValidationError as error:
        problems = "; ".join(f"{dotted(detail['loc'])} {explain(detail)}".strip() for detail in details_of(error))
        raise SpecError(
            f"The values of {place} don't go together: {problems}",
            "Give other values."
            if point_index is None
            else "Correct hyperparams or space so that every combination is valid; --dry-run lists the points.",
        ) from error
    _check_length(spec, point, values, place)
    if isinstance(values, RandomHyperparams) and spec.resources.num_env_runners:
        raise SpecError(
            f"resources.num_env_runners is {spec.resources.num_env_runners}, but the baseline {spec.algorithm} plays "
            "in one process.",
            "Leave resources.num_env_runners out, or set num_envs to play in several sub-environments.",
        )
    num_streams = values.num_envs * max(1, spec.resources.num_env_runners)
    if num_streams > SEEDS_PER_TRIAL:
        raise SpecError(
            f"The values of {place} make {num_streams} sub-environments (num_envs {values.num_envs}, "
            f"resources.num_env_runners {spec.resources.num_env_runners}), more than the {SEEDS_PER_TRIAL} "
            "that a trial has seeds for.",
            "Lower num_envs or resources.num_env_runners.",
        )
    return values


def _check_length(spec: SweepSpec, point: Mapping[str, Any], values: Hyperparams, place: str) -> None:
    """Check that a point's own length of training is one: of another number of iterations than none."""
    if TRAINING_LENGTH not in point:
        return
    length = int(point[TRAINING_LENGTH])
    least, longest = asked_env_steps(values), spec.stop.num_env_steps
    if length < least:
        name = "train_batch_size" if isinstance(values, PPOHyperparams) else "env_steps_per_iteration"
        raise SpecError(
            f"The values of {place} don't go together: {TRAINING_LENGTH} {length:,} is less than one iteration, which "
            f"has {least:,} env steps ({name}), and a training has one at least.",
            f"Raise the least length in space.{TRAINING_LENGTH}, or lower {name}.",
        )
    if length > longest:
        raise SpecError(
            f"{TRAINING_LENGTH} {length:,} of {place} is more than {longest:,}, the longest training of the sweep.",
            "Give a shorter one, or launch a new sweep.",
        )


def place_of_point(
    spec: SweepSpec,
    point: Mapping[str, Any] | None,
    point_index: int | None,
    replications: Sequence[ReplicationRecord] = (),
) -> str:
    """Return what messages call a point; its arguments are those of `point_hyperparams`.

    A point of None is one that the search method has yet to choose.
    """
    if point is None:
        shown = f"chosen by {spec.search.type}"
    else:
        shown = ", ".join(f"{name} {value}" for name, value in point.items()) or "no searched values"
    if point_index is None:
        return f"the new point ({shown})"
    first = trial_id(first_index(point_index, spec.seeds_per_point, replications))
    return f"point {point_index} ({shown}; first trial {first})"
