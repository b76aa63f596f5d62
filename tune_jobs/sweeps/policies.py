"""What one can do with a sweep's policies: choose the best, evaluate, film, restore one.

`tune_jobs.sweeps.verbs` has these functions too, beside those for whole sweeps.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.best_records import BestRecord, EvaluationRecord
from policies.arguments import NumEpisodes, Seed, checked
from policies.envs.modules import allowed_again
from policies.files import expanded, is_output_folder
from policies.guard.guard import guarding
from tune_jobs.sweeps.outcome import Progress
from tune_jobs.sweeps.results import Films
from tune_jobs.sweeps.storage import local_path

if TYPE_CHECKING:
    from ray.rllib.algorithms.algorithm import Algorithm


@allowed_again()
@checked
def best(
    sweep: str | Path,
    *,
    storage: str | Path | None = None,
    num_episodes: NumEpisodes = 100,
    progress: Progress = "auto",
) -> BestRecord:
    """Choose a sweep's winner, confirm it on fresh seeds, and copy its policy to best/.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        num_episodes: On how many episodes it is confirmed.
        progress: Whether it is told on standard error how far it is, as for `launch`.

    Raises:
        NotFoundError: There is no such sweep, or none of its trials can win (the message says why).
    """
    from tune_jobs.sweeps.conclude import choose_best
    from tune_jobs.sweeps.live_view import working
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    with working(store.name, "choosing the best policy", progress) as say:
        return choose_best(store, num_episodes, say)


@allowed_again()
@checked
@guarding(start=True)
def evaluate(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    num_episodes: NumEpisodes = 100,
    first_seed: Seed | None = None,
    env_id: str | None = None,
    action: int | Sequence[float] | None = None,
    progress: Progress = "auto",
) -> tuple[EvaluationRecord, EvaluationRecord]:
    """Run greedy episodes of a policy, and of a random one on the same seeds.

    Args:
        source: A sweep (its best), `SWEEP/TRIAL`, a checkpoint folder, a policy file, `random` or `constant`.
        storage: Folder for sweeps.
        num_episodes: How many episodes.
        first_seed: Seeds are this and the next ones; None: seeds that no training or selection uses.
        env_id: An environment other than the policy's own; needed for a baseline.
        action: The action of `constant`; None: 0.
        progress: The same as for `best`.

    Returns:
        The policy's record, and the random policy's.

    Raises:
        NotFoundError: There is no such policy.
    """
    from tune_jobs.sweeps import conclude as finish
    from tune_jobs.sweeps.live_view import working

    with working(str(source), "reading the policy", progress) as say:
        return finish.evaluate(finish.find_policy(source, storage, env_id, action, say), num_episodes, first_seed, say)


@allowed_again()
@checked
@guarding()
def video(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    output: str | Path | None = None,
    seed: Seed | None = None,
    env_id: str | None = None,
    action: int | Sequence[float] | None = None,
    progress: Progress = "auto",
) -> Films:
    """Film a policy.

    Args:
        source: The same as for `evaluate`.
        storage: Folder for sweeps.
        output: File to write, as .mp4 and as .gif; or a folder, that exists or whose name ends with `/`, for files
            called after policy and environment. None: into a sweep's best/ (with the random policy before, and both
            side by side), else into the current folder.
        seed: Episode to film; None: the first confirmation seed, or one that nothing else uses.
        env_id: An environment other than the policy's own; needed for a baseline.
        action: The action of `constant`; None: 0.
        progress: The same as for `best`.

    Returns:
        The files.

    Raises:
        NotFoundError: There is no such policy.
        EnvError: The environment cannot be drawn.
        SpecError: The output is a URL.
    """
    from tune_jobs.sweeps import conclude as finish
    from tune_jobs.sweeps.filming import telling_frames
    from tune_jobs.sweeps.live_view import working

    if output is not None:
        # Before the policy is chosen, which may take minutes.
        local_path(output)
    with working(str(source), "reading the policy", progress) as say:
        found = finish.find_policy(source, storage, env_id, action, say)
        with telling_frames(say, "filming"):
            if output is None and found.store is not None:
                return Films(finish.make_videos(found.store, seed))
            name = str(source).replace("/", "-").lstrip(".-") or "policy"
            target = _film_path(output, f"{name}-{re.sub('[/:]', '-', found.env_id)}.mp4")
            return Films(finish.make_video(found, target, finish.FRESH_SEED if seed is None else seed))


def _film_path(output: str | Path | None, name: str) -> Path:
    """Return the path of a film; it gets the name `name` if `output` names no file."""
    if output is None:
        return Path(name)
    path = expanded(output)
    if str(output).endswith("/") or is_output_folder(path):
        return path / name
    # Another suffix, such as that of `cartpole-v0.5`, is kept.
    return path if path.suffix.lower() in (".mp4", ".gif") else path.with_name(f"{path.name}.mp4")


@checked
def restore(source: str | Path, *, storage: str | Path | None = None) -> Algorithm:
    """Restore a checkpoint as an RLlib `Algorithm` that can continue training.

    Checkpoints of the rllib engine are pickles: restore only sweeps you trust.

    RLlib needs a Ray. Where this process has joined none, one of this machine is started, which runs until
    `ray.shutdown()` or the end of the process; a sweep that is launched meanwhile runs in it.

    Args:
        source: A sweep (its best checkpoint), `SWEEP/TRIAL` (the trial's best), or a checkpoint folder.
        storage: Folder for sweeps.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged, of a baseline, or cannot be restored with exactly the weights that were saved.
        CannotRunError: Ray cannot be started here.
    """
    from tune_jobs.plan.machine import local_machine
    from tune_jobs.sweeps.conclude import find_trained_checkpoint
    from tune_jobs.training.registry import restore_checkpoint

    folder, engine = find_trained_checkpoint(source, storage)
    # Imports Ray, which a wrong name needs not wait for.
    from tune_jobs.ray_tune.cluster import left_running

    with left_running(local_machine()):
        algorithm: Algorithm = restore_checkpoint(folder, engine)
    return algorithm
