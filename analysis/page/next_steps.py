"""What to do next, to copy: commands, sweep files, and the setting as other libraries' programs."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analysis.best_records import SettingRecord
from analysis.page.estimates import replicate_takes, takes
from analysis.page.narrowed import narrowed_space
from analysis.page.source import Source, point_text
from analysis.records import TRAINING_LENGTH, whole_length
from analysis.wording import counted

if TYPE_CHECKING:
    from policies.hyperparams import TrainedHyperparams

_OF_THE_RUN = (
    "about", "checkpoints", "confirm", "engine", "iteration_timeout_s", "max_retries", "name", "num_samples",
    "points", "prior", "resources", "scheduler", "search", "space",
)  # fmt: skip
"""Sections of a sweep file that say how it was searched and run, not what was trained."""
_SEEDS_OF_A_SETTING = 5
_LEAST_GOOD = 3


@dataclass(frozen=True)
class Step:
    """Something to do."""

    title: str
    why: str
    text: str
    """What to copy."""
    folded: bool = False
    """Whether it is long, so that it is shown when asked for."""


@dataclass(frozen=True)
class NextSteps:
    """What the section shows; without steps it isn't shown."""

    steps: list[Step]


def section(source: Source) -> NextSteps:
    """Return what the section shows."""
    return NextSteps([*_commands(source), *_narrowed(source), *_setting(source)])


def _commands(source: Source) -> Iterator[Step]:
    path, settings = shlex.quote(source.path), source.settings
    if source.sweep.state in ("created", "interrupted"):
        yield Step("Go on", "The sweep is not finished.", f"tune-jobs resume {path}")
    elif source.sweep.state == "completed" and any(trial.status == "failed" for trial in source.trials):
        why = "Trials that failed count as the worst. Once the cause is mended, this runs them again."
        yield Step("Retry", why, f"tune-jobs resume {path} --retry-failed")
    if not source.is_trained or not source.trials:
        return
    is_open = settings is not None and settings.num_settings > 1 and not source.is_population
    if is_open and not source.nothing_learned:
        about = replicate_takes(source)
        why = "Train the leading settings again with fresh seeds, until it is clear which is the best"
        yield Step("Replicate", f"{why}{f': about {about}' if about else ''}.", f"tune-jobs replicate {path}")
    samples = source.sweep.spec.get("num_samples")
    space = source.sweep.spec.get("space")
    if isinstance(samples, int) and isinstance(space, Mapping) and _is_random(space):
        num_trials = sum(trial.seed_index == 0 for trial in source.trials)
        about = takes(source, len(source.trials)) if num_trials else ""
        why = f"As many samples of the space again{f': about {about}' if about else ''}."
        yield Step("Extend", why, f"tune-jobs extend {path} --num-samples {samples}")


def _is_random(space: Mapping[str, Any]) -> bool:
    """Whether more samples give other points, which those of a grid alone don't."""
    return any(isinstance(domain, Mapping) and "grid" not in domain for domain in space.values())


def _narrowed(source: Source) -> Iterator[Step]:
    spec, ranked = source.sweep.spec, source.ranked
    space = spec.get("space")
    if not isinstance(space, Mapping) or source.is_population or len(ranked) <= _LEAST_GOOD:
        return
    if source.nothing_learned:
        # Where its best lie says nothing of where others might.
        return
    good = ranked[: max(_LEAST_GOOD, len(ranked) // 4)]
    narrowed = narrowed_space(space, [item.point for item in good])
    if narrowed == dict(space):
        return
    search = {name: _filled(spec[name]) for name in ("num_samples", "search", "scheduler") if spec.get(name)}
    trained = _trained(spec)
    if TRAINING_LENGTH in narrowed:
        # The longest of the narrowed space may be another.
        trained["stop"] = {name: value for name, value in trained.get("stop", {}).items() if name != "num_env_steps"}
    content = trained | {"space": narrowed} | search | {"seed": _next_seed(spec)}
    why = (
        f"Where the best {len(good)} of {counted(len(ranked), 'setting')} lie and a little beyond, with another seed. "
        "Save it and launch it by its file's name."
    )
    if max(len(item.scores) for item in ranked) == 1:
        why += " With one seed a setting those are partly lucky ones."
    yield Step("Search a narrower space", why, _yaml(content), folded=True)


def _setting(source: Source) -> Iterator[Step]:
    settings = source.settings
    if settings is None or source.is_population or not source.is_trained:
        return
    spec, best = source.sweep.spec, settings.best
    values = dict(best.point)
    trained = _trained(spec)
    if (length := values.pop(TRAINING_LENGTH, None)) is not None:
        # It is no hyperparameter.
        trained["stop"] = {**trained.get("stop", {}), "num_env_steps": length}
    content = trained | {
        "hyperparams": {**source.sweep.section("hyperparams"), **values},
        "seeds_per_point": _SEEDS_OF_A_SETTING,
        "seed": _next_seed(spec),
    }
    which = point_text(best.point)
    why = f"{which + ', ' if which else ''}with {_SEEDS_OF_A_SETTING} seeds that this sweep has not used."
    yield Step("Train the setting by itself", why, _yaml(content), folded=True)
    yield from _foreign(source, best)


def _foreign(source: Source, best: SettingRecord) -> Iterator[Step]:
    from policies.foreign_code import rllib_program, stable_baselines3_program

    values = _hyperparams(source, best)
    if values is None:
        return
    spec = source.sweep.spec
    env = spec.get("env")
    env = env if isinstance(env, Mapping) else {"id": str(env)}
    env_id, env_args = str(env.get("id", "?")), dict(env.get("args") or {})
    cap = source.sweep.section("stop").get("num_env_steps")
    most = source.sweep.max_iterations
    length = 100_000
    if isinstance(cap, int):
        length = whole_length(best.point, values.model_dump(), num_env_steps=cap, num_iterations=most)
    is_masked = source.sweep.is_masked
    names = ("frame_stack", "pixels", "atari", "action_mask", "own_process", "failure_penalty")
    changed = [
        name for name in names if env.get(name) not in (None, 1, False) and not (is_masked and name == "action_mask")
    ]
    note = f" The env's {', '.join(changed)} {'is' if len(changed) == 1 else 'are'} left out." if changed else ""
    if is_masked:
        note += (
            " The env's mask of actions is left out: what it does not allow is tried there, unless a class that knows "
            "masks is taken, such as MaskablePPO of sb3-contrib."
        )
    flattens = source.sweep.is_flattened
    if spec.get("rl_module"):
        note += " The RLModule of your own is left out."
    for title, program in (
        (
            "The setting in Stable-Baselines3",
            # The record says of actions alone whether they are masked, and those that are have numbers.
            stable_baselines3_program(
                values,
                env_id=env_id,
                env_args=env_args,
                num_env_steps=length,
                flattens=flattens,
                may_be_continuous=not is_masked,
            ),
        ),
        ("The setting in RLlib", rllib_program(values, env_id=env_id, env_args=env_args, flattens=flattens)),
    ):
        why = "The same values in its names; scores may differ, as implementations do." + note
        yield Step(title, " ".join([why, *program.notes]), program.code, folded=True)


def _hyperparams(source: Source, best: SettingRecord) -> TrainedHyperparams | None:
    """Return all hyperparameters of a setting; None if they can't be read, as of another version."""
    from policies.hyperparams import DQNHyperparams, PPOHyperparams

    kinds: dict[str, type[TrainedHyperparams]] = {"ppo": PPOHyperparams, "dqn": DQNHyperparams}
    kind = kinds.get(str(source.sweep.spec.get("algorithm")))
    trial = next((trial for trial in source.trials if trial.trial_id in best.trial_ids), None)
    if kind is None or trial is None:
        return None
    try:
        return kind.model_validate(trial.hyperparams)
    except ValueError:
        return None


def _trained(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a sweep file says of the training: without what is empty, and without how it was searched and run."""
    content = {name: _filled(value) for name, value in spec.items() if name not in _OF_THE_RUN}
    env = spec.get("env")
    if isinstance(env, Mapping) and env.get("args"):
        # What is null or empty there is the environment's own to read.
        content["env"]["args"] = env["args"]
    return {name: value for name, value in content.items() if value not in (None, {})}


def _filled(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    filled = {name: _filled(item) for name, item in value.items()}
    return {name: item for name, item in filled.items() if item not in (None, {})}


def _next_seed(spec: Mapping[str, Any]) -> int:
    seed = spec.get("seed")
    return seed + 1 if isinstance(seed, int) else 1


def _yaml(content: Mapping[str, Any]) -> str:
    import yaml

    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True, default_flow_style=None).rstrip()
