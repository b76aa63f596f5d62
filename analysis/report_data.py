"""What a sweep was about, from its record: its env, its algorithm, its goal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from analysis.best_records import BestRecord
from analysis.records import SweepRecord, finite_or_none
from analysis.wording import duration
from policies.portable.file import BASELINE_KINDS

_ATARI_FRAMES = ("frame_skip", "noop_max")
_VERSION = re.compile(r"-v\d+")


def goal_of(sweep: SweepRecord, best: BestRecord | None) -> float | None:
    """Return the return that counts as solved: the objective's own threshold, else the env's, else the stop rule's."""
    own = finite_or_none(sweep.section("objective").get("threshold"))
    if own is not None:
        return own
    planned = finite_or_none(best.confirmation.threshold if best is not None else None)
    planned = finite_or_none(sweep.env_threshold) if planned is None else planned
    if planned is not None:
        return planned
    # Records of former versions have none.
    import gymnasium

    # gymnasium.spec() would import the module that an id such as "module:Env-v0" names, so the registry is read.
    env_spec = gymnasium.registry.get(env_of(sweep))
    known = finite_or_none(env_spec.reward_threshold) if env_spec is not None else None
    if known is not None:
        return known
    stop = sweep.section("stop")
    wanted = [finite_or_none(stop.get(name)) for name in ("evaluation_return", "training_return")]
    return next((value for value in wanted if value is not None), None)


def env_of(sweep: SweepRecord) -> str:
    """Return the env id of a sweep, from its resolved spec."""
    env = sweep.spec.get("env")
    return str(env.get("id", "?")) if isinstance(env, Mapping) else str(env)


def are_one_env(first: str, second: str) -> bool:
    """Return whether two env ids may be of one environment.

    Earlier records have the id as it was typed, perhaps without its version, and don't tell which one it meant.
    """
    short, long = sorted((first, second), key=len)
    return first == second or _VERSION.fullmatch(long.removeprefix(short)) is not None


def env_arguments_of(sweep: SweepRecord) -> dict[str, Any]:
    """Return what a sweep gives its environment that may change returns.

    That are its arguments and, of an Atari game, how many frames an action lasts and how many no-ops begin a game. What
    is made of observations doesn't change returns, nor what training alone sees.
    """
    env = sweep.section("env")
    atari = env.get("atari")
    frames = {f"atari.{name}": atari.get(name) for name in _ATARI_FRAMES} if isinstance(atari, Mapping) else {}
    return {**(env.get("args") or {}), **frames}


def algorithm_of(sweep: SweepRecord) -> str:
    """Return the sweep's algorithm as a heading names it: "PPO", "Random play"."""
    name = str(sweep.spec.get("algorithm", "?"))
    return {"random": "Random play", "constant": "A constant action"}.get(name, name.upper())


def about_of(sweep: SweepRecord) -> dict[str, str]:
    """Look up what the sweep file says of the sweep, for the head of the page: title, description, expected."""
    told = sweep.section("about")
    return {name: str(told.get(name) or "") for name in ("title", "description", "expected")}


def run_time_of(sweep: SweepRecord) -> str:
    """Say how long a sweep ran; empty: not known, as the time is recorded when a run ends, and none has."""
    if sweep.run_time_s == 0:
        return ""
    told = duration(sweep.run_time_s)
    return f"{told} before this run" if sweep.state == "running" else told


def is_trained(sweep: SweepRecord) -> bool:
    """Whether a sweep's policies learn, which those of baselines don't."""
    return sweep.spec.get("algorithm") not in BASELINE_KINDS
