"""The scores that presets have to reach, each with the reason for its threshold."""

from __future__ import annotations

from dataclasses import dataclass

NUM_EPISODES = 100
"""Greedy episodes of each training seed's best checkpoint."""


@dataclass(frozen=True)
class Target:
    """What a preset has to reach. All that is given has to hold."""

    reason: str
    """Why this much."""
    score: float | None = None
    """Median over training seeds of the mean return over `NUM_EPISODES` greedy episodes."""
    max_env_steps: int | None = None
    """No seed's trial may take more."""
    solve_within: int | None = None
    """The median over seeds of the env steps until training returns `solve_return` over 100 episodes is less."""
    solve_return: float | None = None
    """For `solve_within` and the table's column; None: the env's threshold."""
    full_episodes: tuple[int, int, float] | None = None
    """(so many, of the first so many greedy episodes, have this return); the median over seeds."""
    times_random: float | None = None
    """The median score over random play's mean return. A preset whose comment says that it does not beat random play
    is no miss."""


def _mean(score: float, reason: str) -> Target:
    return Target(reason, score=score)


TARGETS: dict[str, Target] = {
    "cartpole-dqn-replay": _mean(
        195, "CartPole-v0 counts as solved at 195; the tutorial reports 200 steps 'somewhat consistently'"
    ),
    "cartpole-dqn-keras": Target(
        "CartPole-v1 counts as solved at 475; in the tutorial 16 of 20 test episodes reach 500",
        score=475,
        full_episodes=(19, 20, 500),
    ),
    "cartpole-dql-last": Target(
        "the tutorial's learner without replay averages about 15, no more than random play", times_random=3
    ),
    "cartpole-dql-replay": _mean(195, "the tutorial's passes its goal line at 195 after about 60 episodes"),
    "cartpole-dql-double": _mean(300, "the tutorial's stays above 300"),
    "cartpole-dql-soft": _mean(300, "the tutorial's does about as well as with hard updates"),
    "cartpole-ppo-single": Target(
        "CartPole-v0 counts as solved at 195; the tutorial needs 35 iterations of 4,000 env steps for it",
        score=195,
        solve_within=35 * 4_000,
        solve_return=195,
    ),
    "cartpole-ppo-tuned": Target(
        "500 is the most that CartPole-v1 gives, from few env steps", score=500.0, max_env_steps=60_000
    ),
    "cartpole-dqn-tuned": Target(
        "500 is the most that CartPole-v1 gives, from few env steps", score=500.0, max_env_steps=50_000
    ),
    "acrobot-ppo": _mean(-85, "Acrobot-v1 counts as solved at -100; good published policies reach about -80"),
    "acrobot-dqn": _mean(-85, "as acrobot-ppo"),
    "lunarlander-ppo": _mean(240, "LunarLander counts as solved at 200; 240 lands reliably and without detours"),
    "lunarlander-dqn": _mean(240, "as lunarlander-ppo"),
    "pendulum-ppo": _mean(-200, "swinging up costs about -150 from most starts; random play returns about -1,200"),
}
"""By preset. Where there is a preset `<name>-fixed`, the target is that one's: the settings of `<name>` are its
source's, and what they reach is measured and shown beside it."""


@dataclass(frozen=True)
class Task:
    """One preset to run."""

    preset: str
    target: Target | None
    """None: measured beside its fixed sibling, with nothing to reach."""
    shown_target: Target
    """Whose threshold stands in the table, in either case."""


def tasks(presets: set[str], wanted: tuple[str, ...] = ()) -> tuple[list[Task], dict[str, str]]:
    """What to run, in the order of the targets, and what is skipped.

    Args:
        presets: Names of those that exist.
        wanted: Names to keep; none: all.

    Returns:
        The tasks, and for each preset that is skipped the reason.

    Raises:
        ValueError: A wanted name has no target.
    """
    found, skipped = [], {}
    for name, target in TARGETS.items():
        fixed = f"{name}-fixed"
        if name in presets:
            found.append(Task(name, None if fixed in presets else target, target))
        else:
            skipped[name] = "there is no preset of this name"
        if fixed in presets:
            found.append(Task(fixed, target, target))
    known = {task.preset for task in found} | skipped.keys()
    if unknown := set(wanted) - known:
        raise ValueError(f"no target for {', '.join(sorted(unknown))}; there are: {', '.join(sorted(known))}")
    if not wanted:
        return found, skipped
    return (
        [task for task in found if task.preset in wanted],
        {name: reason for name, reason in skipped.items() if name in wanted},
    )
