"""The sweep file as a typed, frozen model: everything about a sweep that a person decides.

A `SweepSpec` is valid by itself: its hyperparameters exist for its algorithm and accept every value their
domains can give. `tune_jobs.plan.sweep_plan` finds out whether the environment
exists and the machine is large enough. `tune_jobs.spec.file` reads files, presets and `--set`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Self

from pydantic import (
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from analysis.wording import counted
from policies.errors import SpecError
from policies.portable.file import BASELINE_KINDS
from tune_jobs.spec.condition_problems import condition_problems
from tune_jobs.spec.engines import find_engine
from tune_jobs.spec.hyperparam_problems import hyperparam_problems
from tune_jobs.spec.messages import problems_of
from tune_jobs.spec.problems import Problem, WrongSpecError
from tune_jobs.spec.rules import env_problems, search_problems, why_none
from tune_jobs.spec.sections import NAME_PATTERN, NAME_RULE, SweepFields
from tune_jobs.spec.training_length import length_problems, with_longest

STORED = {"is_stored": True}
"""The context in which a spec is validated that an older version may have written."""
_LATER = frozenset({"resources.num_gpus", "space.target_update_unit"})
"""The settings of which 0.1.0 launched sweeps that are refused now: they are read, and nothing more of them trains."""


class SweepSpec(SweepFields):
    """One sweep: what is searched, for how long, and with which resources."""

    @model_validator(mode="before")
    @classmethod
    def _stops_at_the_longest(cls, data: Any) -> Any:
        return with_longest(data) if isinstance(data, Mapping) else data

    @model_validator(mode="wrap")
    @classmethod
    def _is_right(cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        """Check the whole sweep too, and report problems in the sweep file's words; SpecErrors pass unchanged."""
        try:
            spec = handler(data)
        except ValidationError as error:
            raise WrongSpecError.of("SweepSpec", problems_of(error, data)) from error
        of_conditions = condition_problems(
            spec.algorithm, spec.hyperparams, spec.space, are_grids_tried=spec.search.type == "random"
        )
        problems = hyperparam_problems(spec.algorithm, spec.hyperparams, spec.space) + of_conditions
        # Points are counted there, which takes conditions that are right; those of unknown names were not looked at.
        if not problems or not any(domain.when for domain in spec.space.values()):
            found = _section_problems(spec)
            problems += found if info.context != STORED else [each for each in found if each.path not in _LATER]
        if problems:
            raise WrongSpecError.of("SweepSpec", problems)
        return spec


def check_trainable(spec: SweepSpec) -> None:
    """Check that a sweep that is read from its record may train more, as one that is launched now.

    Raises:
        WrongSpecError: An older version launched it with a setting that is refused now.
    """
    if problems := [each for each in _section_problems(spec) if each.path in _LATER]:
        raise WrongSpecError.of(spec.name or "sweep", problems)


def check_sweep_name(name: str) -> str:
    """Return the name of a new sweep if it is allowed as a folder's name, and names no baseline policy.

    Raises:
        SpecError: It is not allowed.
    """
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise SpecError(f"The sweep name {name!r} is not allowed.", f"Use {NAME_RULE}.")
    if name in BASELINE_KINDS:
        raise SpecError(
            f"The sweep name {name!r} is not allowed: for `tune-jobs evaluate` and `video` it is the {name} policy.",
            f"Use another, such as {name_after(name)!r}.",
        )
    return name


def name_after(stem: str) -> str:
    """Return the name of a new sweep that is called after its file or preset, which may be called as a baseline is."""
    return f"{stem}-sweep" if stem in BASELINE_KINDS else stem


def _section_problems(spec: SweepFields) -> list[Problem]:
    """Return the settings that contradict each other."""
    found = (*env_problems(spec), *search_problems(spec), *length_problems(spec))
    problems = [Problem(path, text) for path, text in found]
    grace, cap, resources = spec.scheduler.grace_env_steps, spec.stop.num_env_steps, spec.resources
    if spec.scheduler.type != "none" and grace is not None and grace >= cap:
        text = f"{grace} is not less than stop.num_env_steps, {cap}: no trial would ever be ended early"
        problems.append(Problem("scheduler.grace_env_steps", text))
    needed = 1 + resources.num_env_runners
    if resources.num_cpus is not None and resources.num_cpus < needed:
        text = (
            f"{resources.num_cpus} is fewer than the {needed} that a trial with "
            f"{counted(resources.num_env_runners, 'env runner')} needs; leave it out to get just those"
        )
        problems.append(Problem("resources.num_cpus", text))
    if resources.num_gpus > 1:
        text = (
            f"{resources.num_gpus:g} is not allowed: a trial computes on one GPU at most, and so does a pack of "
            "trials; use 1, or the share of one GPU that each takes, such as 0.25. More GPUs train more trials at once"
        )
        problems.append(Problem("resources.num_gpus", text))
    wished = find_engine(spec.engine)
    if wished is not None and (reason := why_none(wished, spec)) is not None and not wished.gives_way:
        text = f"{wished.name} cannot train any of the trials: {reason}. Set engine: auto, which takes one that can"
        problems.append(Problem("engine", text))
    return problems
