"""Conclude a sweep after its trials: best, evaluate, video, report. None of this starts Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.best_records import BestRecord, EvaluationRecord
from analysis.records import CheckpointRecord
from analysis.selection import NoUsableTrialError
from analysis.selection import best_checkpoint as best_of
from policies.acting.baselines import BASELINES, ConstantPolicy
from policies.acting.load import load_policy, policy_from_portable
from policies.acting.policy import Policy, RandomPolicy
from policies.envs.modules import allow_modules
from policies.envs.wrappers import RESERVED
from policies.errors import CheckpointError, EnvError, NotFoundError, SpecError, TuneJobsError
from policies.files import expanded
from policies.guard.guard import CALL_TIMEOUT_S, guarding
from policies.guard.guarded import check_env, evaluate_policy, full_id, record_comparison, record_video
from policies.hyperparams import ConstantHyperparams
from policies.portable.file import is_policy_folder, read_policy
from tune_jobs.spec.engines import Engine
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.seeds import confirmation_seeds
from tune_jobs.store.candidates import leave_out, read_results, read_trials
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.store.manifests import is_checkpoint, verify_checkpoint
from tune_jobs.store.presence import is_file
from tune_jobs.store.writable import check_best_writable
from tune_jobs.sweeps.current_best import has_current_best
from tune_jobs.sweeps.drawing import write_report
from tune_jobs.sweeps.drive import cpus_for_episodes
from tune_jobs.sweeps.meanwhile import write_unless_outdated
from tune_jobs.sweeps.policy_choice import choose_policy, episode_of, with_runners_up
from tune_jobs.sweeps.read_only import policy_to_deploy
from tune_jobs.sweeps.settings import judged
from tune_jobs.sweeps.sources import find_sweep, names_baseline
from tune_jobs.sweeps.storage import split_trial
from tune_jobs.training.registry import engine_of_checkpoint

# The first seed of `evaluate` if no sweep gives one; it is never one of training, evaluation or confirmation.
FRESH_SEED = 2**31

_handed_out: list[Sweep] = []
"""Sweeps of which callers have a folder."""


@guarding()
def choose_best(store: Sweep, num_episodes: int = 100, say: Callable[[str], None] = lambda _: None) -> BestRecord:
    """Choose the policy to deploy, confirm it and the runners-up on seeds of their own, and copy it to best/.

    Args:
        store: The sweep.
        num_episodes: On how many episodes it is confirmed.
        say: Told what is done, as it begins and goes on.

    Raises:
        NoUsableTrialError: No trial can win; the message says why.
        CheckpointError: The record of the sweep or of a trial is damaged.
        EnvError: The environment raised an error, hung, or ended its process.
        CannotRunError: The sweep may only be read.
    """
    check_best_writable(store)
    with store.reading():
        sweep = _trusted(store).read_record()
        # Of a sweep with a damaged trial nothing is chosen anew: the trial may be the one that would win.
        store.read_trials()
        spec = stored_spec(sweep)
        trials, results = read_trials(store), read_results(store)
    num_processes = cpus_for_episodes(sweep.address)
    chosen = choose_policy(store, spec, trials, num_processes, say)
    winner = chosen.choice.winner
    seeds = confirmation_seeds(spec.seed, num_episodes)
    policy = policy_from_portable(chosen.policy, description=f"{store.name}/{chosen.trial.trial_id}")
    env_id, env_args, timeout_s = spec.env.id, spec.env.wrapped_args, spec.iteration_timeout_s
    random = random_policy(env_id, env_args, timeout_s)

    def played(policy: Policy, what: str) -> EvaluationRecord:
        return run_evaluation(
            policy, env_id, env_args, seeds, timeout_s, num_processes=num_processes, what=what, say=say
        )

    confirmation = played(policy, "confirming the best policy")
    record = BestRecord(
        checkpoint=winner.checkpoint,
        point=winner.point,
        seed=chosen.trial.seed,
        selection_score=winner.score,
        confirmation=confirmation,
        random=played(random, "playing at random, to compare with it"),
        settings=judged(spec, trials, results, confirmation.threshold),
        choice=with_runners_up(chosen, confirmation, timeout_s, num_processes, say),
    )
    return write_unless_outdated(store, sweep, record, chosen.policy)


@guarding()
def run_evaluation(
    policy: Policy, env_id: str, env_args: dict[str, Any], seeds: Sequence[int], timeout_s: float, *,
    num_processes: int, what: str, say: Callable[[str], None],
) -> EvaluationRecord:  # fmt: skip
    """Play a policy's greedy episodes, one per seed, and let `say` be told `what` is done, and how far it is.

    The other arguments are those of `evaluate_policy`.
    """
    episodes = evaluate_policy(
        policy, env_id=env_id, env_args=env_args, seeds=seeds, timeout_s=timeout_s, num_processes=num_processes,
        told=lambda begun: say(f"{what}: {episode_of(begun, len(seeds))}"),
    )  # fmt: skip
    return EvaluationRecord(
        policy=policy.description,
        env_id=env_id,
        env_args=env_args,
        seeds=episodes.seeds,
        returns=episodes.returns,
        lengths=episodes.lengths,
        threshold=check_env(env_id, env_args, timeout_s=timeout_s).threshold,
    )


def random_policy(env_id: str, env_args: dict[str, Any], timeout_s: float = CALL_TIMEOUT_S) -> RandomPolicy:
    """Return a random policy for an environment, to compare trained policies with."""
    env = check_env(env_id, env_args, timeout_s=timeout_s)
    return RandomPolicy(env.observation_space, env.action_space, env_id=env.env_id, env_args=env.env_args)


@dataclass(frozen=True)
class PolicySource:
    """A policy, the environment it acts in, and where it came from."""

    policy: Policy
    env_id: str
    env_args: dict[str, Any]
    store: Sweep | None = None
    """The sweep, if the policy is a sweep's best."""
    timeout_s: float = CALL_TIMEOUT_S
    """How long one call of the environment may take."""


@guarding()
def find_policy(
    source: str | Path,
    storage: str | Path | None = None,
    env_id: str | None = None,
    action: int | Sequence[float] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> PolicySource:
    """Find a policy by any kind of source.

    Args:
        source: A sweep (its best; chosen now if it has not been, or was before the sweep was trained on),
            `SWEEP/TRIAL` (its best checkpoint), a checkpoint folder, a policy file, or a baseline: `random` or
            `constant`, unless there is a sweep of that name and no `env_id`.
        storage: The folder in which sweeps are looked up by name.
        env_id: The environment it acts in; None: the one it was trained in. A baseline needs one.
        action: The action of `constant`; None: 0.
        say: Told how far it is where the best is chosen now.

    Raises:
        NotFoundError: There is no such thing.
        CheckpointError: It is damaged.
        SpecError: A baseline is given no environment, or an action that the environment does not have; or an action is
            given for another policy.
    """
    text = str(source)
    if text in BASELINES and (env_id is not None or action is not None or names_baseline(text, storage)):
        return _baseline(text, env_id, action)
    _refuse_action(text, action)
    path = expanded(text)
    store: Sweep | None = None
    timeout_s = CALL_TIMEOUT_S
    if is_checkpoint(path):
        verify_checkpoint(path)
        policy = load_policy(path)
    elif is_file(path) or is_policy_folder(path):
        policy = load_policy(path)
    else:
        store, trial_id = _sweep_and_trial(text, storage)
        timeout_s = stored_spec(store.read_record()).iteration_timeout_s
        if trial_id is None:
            policy = policy_to_deploy(store, choose_best, say)
        else:
            checkpoint = store.checkpoint_folder(best_checkpoint(store, trial_id))
            verify_checkpoint(checkpoint)
            policy = load_policy(checkpoint)
            store = None
    named = policy.env_id if env_id is None else env_id
    if named != policy.env_id:
        named = full_id(named, timeout_s=timeout_s)  # `Pendulum` may be the policy's own Pendulum-v1
    if named != policy.env_id:
        # The constructor's arguments are those of the other environment; the wrappers are the policy's.
        wrappers = {key: value for key, value in policy.env_args.items() if key in RESERVED}
        return PolicySource(policy, named, wrappers, timeout_s=timeout_s)
    return PolicySource(policy, policy.env_id, dict(policy.env_args), store, timeout_s)


def _baseline(name: str, env_id: str | None, action: int | Sequence[float] | None) -> PolicySource:
    if env_id is None:
        raise SpecError(
            f"A {name} policy has no environment of its own.", "Name one with --env, such as --env CartPole-v1."
        )
    if name == "random":
        _refuse_action(name, action)
        return PolicySource(random_policy(env_id, {}), env_id, {})
    if action is None:
        action = ConstantHyperparams().action
    chosen = action if isinstance(action, int) else tuple(float(number) for number in action)
    env = check_env(env_id, {})
    policy = ConstantPolicy(env.observation_space, env.action_space, chosen, env_id=env.env_id, env_args=env.env_args)
    return PolicySource(policy, env_id, {})


@guarding()
def evaluate(
    source: PolicySource, num_episodes: int, first_seed: int | None, say: Callable[[str], None]
) -> tuple[EvaluationRecord, EvaluationRecord]:
    """Play greedy episodes of a policy, and of a random one on the same seeds; see `verbs.evaluate`."""
    first = FRESH_SEED if first_seed is None else first_seed
    seeds = range(first, first + num_episodes)
    env_id, env_args, timeout_s = source.env_id, source.env_args, source.timeout_s
    cpus = cpus_for_episodes(None)

    def played(policy: Policy, what: str) -> EvaluationRecord:
        return run_evaluation(policy, env_id, env_args, seeds, timeout_s, num_processes=cpus, what=what, say=say)

    record = played(source.policy, "playing")
    return record, played(random_policy(env_id, env_args, timeout_s), "playing at random, to compare with it")


def _refuse_action(source: str, action: int | Sequence[float] | None) -> None:
    if action is not None:
        raise SpecError(
            f"The action {action!r} was given for {source!r}; only 'constant' takes one.", "Leave the action out."
        )


def _sweep_and_trial(text: str, storage: str | Path | None) -> tuple[Sweep, str | None]:
    try:
        return _trusted(find_sweep(text, storage)), None
    except NotFoundError:
        sweep, trial_id = split_trial(text)
        if not sweep:
            raise
        try:
            return _trusted(find_sweep(sweep, storage)), trial_id
        except NotFoundError as error:
            raise NotFoundError(
                f"No sweep, trial, checkpoint or policy file {text!r}: {error.message}", error.hint
            ) from error


def _trusted(store: Sweep) -> Sweep:
    """Return the sweep, and allow the modules that were allowed for it, which its environment may need."""
    allow_modules(store.read_record().allowed_modules)
    return store


def best_checkpoint(store: Sweep, trial_id: str) -> CheckpointRecord:
    """Return the checkpoint of one trial with the highest evaluation return.

    Raises:
        NotFoundError: There is no such trial, or it has no evaluated checkpoint.
    """
    trials = {record.trial_id: record for record in read_trials(store)}
    if trial_id not in trials:
        raise NotFoundError(
            f"Sweep {store.name} has no trial {trial_id!r}; it has {len(trials)} trials.",
            f"List them with `tune-jobs trials {name_in_commands(store.place)}`.",
        )
    # A trial that failed later may still be evaluated, though it cannot win.
    found = best_of(trials[trial_id].checkpoints)
    if found is None:
        raise NotFoundError(
            f"Trial {trial_id} of sweep {store.name} has no checkpoint with a score.",
            f"See why with `tune-jobs trials {name_in_commands(store.place)}`.",
        )
    return found


def find_checkpoint(source: str | Path, storage: str | Path | None = None) -> Path:
    """Return a verified checkpoint folder: a sweep's best, `SWEEP/TRIAL`'s best, or the given folder.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged.
    """
    folder = expanded(source)
    if not is_checkpoint(folder):
        store, trial_id = _sweep_and_trial(str(source), storage)
        if trial_id is not None:
            record = best_checkpoint(store, trial_id)
        elif has_current_best(store):
            record = store.read_best().checkpoint
        else:
            record = choose_best(store).checkpoint
        folder = store.checkpoint_folder(record)
        # Of a sweep in an object store, it is removed with the store.
        _handed_out.append(store)
    verify_checkpoint(folder)
    return folder


def find_trained_checkpoint(source: str | Path, storage: str | Path | None = None) -> tuple[Path, Engine]:
    """Return a verified checkpoint from which training can continue, and the engine that wrote it.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged, or its engine is not RLlib's or the packed one.
    """
    folder = find_checkpoint(source, storage)
    saved, engine = read_policy(folder), engine_of_checkpoint(folder)
    if engine.restore is None:
        what = f"baseline {saved.algorithm}" if saved.algorithm in BASELINES else f"engine {engine.name}"
        raise CheckpointError(
            f"{folder} is of the {what}, which is not an RLlib algorithm: there is nothing to restore.",
            "Load its policy with load_policy, or restore a trial of ppo or dqn.",
        )
    return folder, engine


@guarding()
def make_videos(store: Sweep, seed: int | None = None) -> dict[str, Path]:
    """Film a random policy (before) and the winner (after) on one seed, alone and side by side, into best/.

    Returns:
        before_mp4, after_mp4, after_gif and before_after_mp4.
    """
    check_best_writable(store)
    source = find_policy(store.place)
    best = store.read_best()
    chosen = best.confirmation.seeds[0] if seed is None else seed
    before = random_policy(source.env_id, source.env_args, source.timeout_s)
    # A baseline has not been trained, so its caption does not say so.
    trained = not isinstance(source.policy, RandomPolicy | ConstantPolicy)
    first = "before training: random" if trained else before.description
    second = f"after training: {best.checkpoint.trial_id}" if trained else source.policy.description
    with store.writing_films() as paths:
        record_comparison(
            before,
            source.policy,
            env_id=source.env_id,
            env_args=source.env_args,
            seed=chosen,
            captions=(first, second),
            left_mp4=paths["before_mp4"],
            right_mp4=paths["after_mp4"],
            right_gif=paths["after_gif"],
            both_mp4=paths["before_after_mp4"],
            timeout_s=source.timeout_s,
        )
    # Where they are kept; a store may have had them made elsewhere.
    return dict(store.films())


def make_video(source: PolicySource, output: Path, seed: int) -> dict[str, Path]:
    """Film one episode of any policy: MP4 and GIF, with the name of `output` and the two suffixes."""
    mp4, gif = output.with_suffix(".mp4"), output.with_suffix(".gif")
    record_video(
        source.policy, env_id=source.env_id, env_args=source.env_args, seeds=seed, mp4=mp4, gif=gif,
        timeout_s=source.timeout_s,
    )  # fmt: skip
    return {"mp4": mp4, "gif": gif}


@guarding()
def make_report(
    store: Sweep, why_no_best: TuneJobsError | None = None, say: Callable[[str], None] = lambda _: None
) -> Path:
    """Write the sweep's tables, figures and HTML report; works without a winner, and says why there is none.

    Args:
        store: The sweep.
        why_no_best: Why its winner could not be confirmed just now; None: it was confirmed, or this was not tried.
        say: Told how far it is where the winner is chosen now, and that the report is written then.
    """
    best = None
    if why_no_best is None:
        try:
            best = _known_best(store, say)
        except (EnvError, NoUsableTrialError, CheckpointError) as error:
            why_no_best = error
    if isinstance(why_no_best, NoUsableTrialError):  # the report finds the reason in the trials
        why_no_best = None
    say("writing the report")
    return write_report(store, best, why_no_best)


def _known_best(store: Sweep, say: Callable[[str], None]) -> BestRecord:
    """Return the confirmed winner, which is confirmed now if it has not been."""
    try:
        return store.read_best()
    except NotFoundError as error:
        if isinstance(error, CheckpointError):
            leave_out(error)
        return choose_best(store, say=say)
