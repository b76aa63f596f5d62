"""Choose the policy to deploy: the leading checkpoints of all trials play more episodes, and the worst are rejected.

The episodes have evaluation seeds, those behind the ones that trials were evaluated on; the winner and the runners-up
are then confirmed on confirmation seeds, which decide nothing. How much is played depends on the sweep file and on the
env steps of episodes, never on time: an equal sweep has an equal winner on any machine. See decision 31.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

from analysis.best_records import BestRecord, CandidateRecord, ChoiceRecord, EvaluationRecord
from analysis.records import TrialRecord
from analysis.selection import (
    TrialScore,
    is_current,
    no_usable_trial,
    policy_candidates,
    tie_key,
)
from analysis.successive_rejects import Played, Rejects, successive_rejects
from policies.acting.evaluate import MAX_EPISODE_STEPS, Episodes
from policies.acting.load import policy_from_portable
from policies.acting.policy import Policy
from policies.errors import EnvError, NotFoundError, TuneJobsError
from policies.guard.guarded import check_env, evaluate_policies
from policies.portable.file import PortablePolicy, read_policy
from policies.portable.network import network_to_json
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.seeds import MAX_EPISODES, evaluation_seeds
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.candidates import leave_out, read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.store.transitions import with_checkpoints
from tune_jobs.sweeps.current_best import winner_in_best_alone
from tune_jobs.sweeps.forecast import caps_of

MOST_CANDIDATES = 16
"""How many policies play at most."""
MOST_READ = 4 * MOST_CANDIDATES
"""How many checkpoints are read at most to find them; some may be damaged, or be the same policy as another."""
EPISODES_A_CANDIDATE = 100
"""How many episodes a candidate plays on average at most: few if it is rejected early, hundreds if it stays."""
MAX_ENV_STEPS = 250_000
MIN_ENV_STEPS = 20_000
SHARE_OF_TRAINING = 0.25
"""What all rounds may take at most: this share of the sweep's env steps, within these limits."""
NUM_RUNNERS_UP = 3
RUNNER_UP_ENV_STEPS = 50_000
"""About how many env steps the confirmation of one runner-up may take."""


@dataclass(frozen=True)
class ChosenPolicy:
    """The policy to deploy, not confirmed yet."""

    trial: TrialRecord
    policy: PortablePolicy
    choice: ChoiceRecord
    runners_up: tuple[tuple[int, PortablePolicy], ...]
    """The policies that come next, each with its place in `choice`."""


@dataclass(frozen=True)
class Candidate:
    """A checkpoint that plays, and its policy."""

    scored: TrialScore
    policy: PortablePolicy


def choose_policy(
    store: Sweep,
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    num_processes: int = 1,
    say: Callable[[str], None] = lambda _: None,
) -> ChosenPolicy:
    """Choose the policy to deploy among the kept checkpoints of all trials.

    Args:
        store: The sweep.
        spec: Its sweep file.
        trials: The result of `read_trials`.
        num_processes: In how many processes at once slow environments are played at most.
        say: Told how far the rounds are.

    Raises:
        NoUsableTrialError: No trial has a checkpoint that can be deployed; the message says why.
        EnvError: The environment cannot be made.
    """
    known = policy_candidates(trials)
    if not known:
        raise no_usable_trial(trials)
    env_id, env_args, timeout_s = spec.env.id, spec.env.wrapped_args, spec.iteration_timeout_s
    max_env_steps = most_env_steps(spec, trials)
    cap = check_env(env_id, env_args, timeout_s=timeout_s).max_episode_steps or MAX_EPISODE_STEPS
    # One episode of each is played in any case.
    num_wanted = max(1, min(MOST_CANDIDATES, max_env_steps // cap))
    candidates, left_out = read_candidates(store, known, num_wanted)
    if not candidates:
        raise no_usable_trial([with_checkpoints(trial, ()) for trial in trials])
    policies = [
        policy_from_portable(item.policy, description=f"{store.name}/{item.scored.trial.trial_id}")
        for item in candidates
    ]
    num_first = spec.evaluation.num_episodes
    num_more = min(MAX_EPISODES - num_first, EPISODES_A_CANDIDATE * len(candidates))
    seeds = evaluation_seeds(spec.seed, num_first + num_more)[num_first:]

    num_env_steps = 0

    def play(numbers: Sequence[int], first: int, count: int) -> Sequence[Played]:
        nonlocal num_env_steps
        total = len(numbers) * count
        so_far = f"{num_env_steps:,} of at most {max_env_steps:,} env steps"
        played = evaluate_policies(
            [policies[number] for number in numbers], env_id=env_id, env_args=env_args,
            seeds=seeds[first : first + count], timeout_s=timeout_s, num_processes=num_processes,
            told=lambda begun: say(f"choosing the best policy: {so_far}; {episode_of(begun, total)}"),
        )  # fmt: skip
        num_env_steps += sum(sum(each.lengths) for each in played if isinstance(each, Episodes))
        return played

    rejects = successive_rejects(
        [item.scored.score for item in candidates],
        num_first,
        [tie_key(item.scored) for item in candidates],
        play,
        max_episodes=num_more,
        max_env_steps=max_env_steps,
    )
    choice = ChoiceRecord(
        candidates=(*_records(rejects, candidates), *left_out),
        num_known=len(known),
        num_evaluation_episodes=num_first,
        first_seed=seeds[0] if rejects.num_episodes else None,
        num_rounds=rejects.num_rounds,
        num_episodes=rejects.num_episodes,
        num_env_steps=rejects.num_env_steps,
        max_env_steps=max_env_steps,
        note=rejects.note,
    )
    ranked = [candidates[standing.number] for standing in rejects.standings]
    able = [place for place, standing in enumerate(rejects.standings) if place and not standing.failed]
    runners_up = tuple((place, ranked[place].policy) for place in able[:NUM_RUNNERS_UP])
    return ChosenPolicy(ranked[0].scored.trial, ranked[0].policy, choice, runners_up)


def _records(rejects: Rejects, candidates: Sequence[Candidate]) -> list[CandidateRecord]:
    records = []
    for standing in rejects.standings:
        scored = candidates[standing.number].scored
        lower, upper = standing.interval() or (None, None)
        records.append(
            CandidateRecord(
                checkpoint=scored.checkpoint,
                point=scored.trial.point_at(scored.checkpoint.iteration),
                num_episodes=standing.num_episodes,
                score=standing.score,
                lower=lower,
                upper=upper,
                rejected_in=standing.rejected_in,
                reason=standing.reason,
            )
        )
    return records


def most_env_steps(spec: SweepSpec, trials: Sequence[TrialRecord]) -> int:
    """Return how many env steps the rounds may take, by what the sweep may train."""
    share = int(SHARE_OF_TRAINING * sum(caps_of(spec, trials).values()))
    return max(MIN_ENV_STEPS, min(MAX_ENV_STEPS, share))


def with_runners_up(
    chosen: ChosenPolicy, confirmation: EvaluationRecord, timeout_s: float, num_processes: int = 1,
    say: Callable[[str], None] = lambda _: None,
) -> ChoiceRecord:  # fmt: skip
    """Confirm the runners-up on the seeds that the winner was confirmed on, or the first of them where they are long.

    Args:
        chosen: What was chosen.
        confirmation: The winner's confirmation.
        timeout_s: How long one call of the environment may take.
        num_processes: In how many processes at once slow environments are played at most.
        say: Told how far it is.
    """
    choice = chosen.choice
    if not chosen.runners_up:
        return choice
    length = max(1.0, sum(confirmation.lengths) / confirmation.num_episodes)
    seeds = confirmation.seeds[: max(1, int(RUNNER_UP_ENV_STEPS / length))]
    policies: list[Policy] = [policy_from_portable(policy) for _, policy in chosen.runners_up]
    try:
        played: Sequence[Played] = evaluate_policies(
            policies, env_id=confirmation.env_id, env_args=confirmation.env_args, seeds=seeds, timeout_s=timeout_s,
            num_processes=num_processes,
            told=lambda begun: say(f"confirming the runners-up: {episode_of(begun, len(policies) * len(seeds))}"),
        )  # fmt: skip
    except EnvError as error:
        note = f"The runners-up could not be confirmed: {error.message}"
        return choice.model_copy(update={"note": " ".join(filter(None, (choice.note, note)))})
    candidates, notes = list(choice.candidates), [choice.note]
    for (place, _), result in zip(chosen.runners_up, played, strict=True):
        candidate = candidates[place]
        who = f"{candidate.checkpoint.trial_id} at {candidate.checkpoint.num_env_steps:,} env steps"
        if isinstance(result, TuneJobsError):
            notes.append(f"{who} could not be confirmed: {result.message}")
            continue
        record = confirmation.model_copy(
            update={"policy": who, "seeds": result.seeds, "returns": result.returns, "lengths": result.lengths}
        )
        candidates[place] = candidate.model_copy(update={"confirmation": record})
    return choice.model_copy(update={"candidates": tuple(candidates), "note": " ".join(filter(None, notes))})


def episode_of(begun: int, total: int) -> str:
    """Return how far episodes are, such as "episode 3 of 100"."""
    return f"episode {max(1, min(begun, total)):,} of {total:,}"


def confirmed_best(store: Sweep) -> BestRecord | None:
    """Return the winner that was confirmed before.

    Returns:
        None: it is missing or damaged, or it would be chosen among other candidates now. Where all checkpoints were
            deleted, there are none, and it stays.
    """
    try:
        best = store.read_best()
        read_policy(store.best_folder)
        trials = read_trials(store)
        if not policy_candidates(trials) and winner_in_best_alone(store) is not None:
            return best
        store.trial(best.checkpoint.trial_id).verify_checkpoint(best.checkpoint.iteration)
        budget = most_env_steps(stored_spec(store.read_record()), trials)
    except TuneJobsError:
        return None
    same_budget = best.choice is None or best.choice.max_env_steps == budget
    return best if same_budget and is_current(best, trials) else None


def read_candidates(
    store: Sweep, known: Sequence[TrialScore], num_wanted: int
) -> tuple[list[Candidate], list[CandidateRecord]]:
    """Read the policies that play: the first ones whose files are whole, each policy once.

    Args:
        store: The sweep.
        known: All that may be chosen, in order.
        num_wanted: How many play at most.

    Returns:
        The candidates; and records of the others that were read, with the reason.
    """
    found: dict[str, Candidate] = {}
    left_out: list[CandidateRecord] = []
    with contextlib.closing(_fetched(store, known, num_wanted)) as fetched:
        for num_read, scored in enumerate(fetched, 1):
            _take(store, scored, found, left_out)
            # Before the next ones are fetched.
            if len(found) == num_wanted or (found and num_read >= MOST_READ):
                break
    return list(found.values()), left_out


def _fetched(store: Sweep, known: Sequence[TrialScore], num_wanted: int) -> Generator[TrialScore]:
    """Yield what may be chosen, in order; as many as may be wanted are fetched together."""
    for first in range(0, len(known), num_wanted):
        some = known[first : first + num_wanted]
        with store.reading(results=False, checkpoints=[scored.checkpoint for scored in some]):
            yield from some


def _take(store: Sweep, scored: TrialScore, found: dict[str, Candidate], left_out: list[CandidateRecord]) -> None:
    """Read a policy, and add it to what plays, or to what is left out with the reason."""
    checkpoint = scored.checkpoint
    try:
        store.trial(checkpoint.trial_id).verify_checkpoint(checkpoint.iteration)
        policy = read_policy(store.checkpoint_folder(checkpoint))
    except NotFoundError as error:
        leave_out(error)
        # A record names no place on a machine.
        left_out.append(_left_out(scored, error.message.replace(f"{store.place}/", "")))
        return
    candidate, key = Candidate(scored, policy), _how_it_acts(policy)
    if key in found:
        same = found[key]
        if scored.score == same.scored.score and tie_key(scored) < tie_key(same.scored):
            found[key], candidate, same = candidate, same, candidate
        first = same.scored.checkpoint
        reason = f"the same policy as {first.trial_id} at {first.num_env_steps:,} env steps"
        left_out.append(_left_out(candidate.scored, reason))
    else:
        found[key] = candidate


def _left_out(scored: TrialScore, reason: str) -> CandidateRecord:
    return CandidateRecord(
        checkpoint=scored.checkpoint,
        point=scored.trial.point_at(scored.checkpoint.iteration),
        num_episodes=0,
        score=scored.score,
        rejected_in=0,
        reason=reason,
    )


def _how_it_acts(policy: PortablePolicy) -> str:
    """Return a digest of all that a policy acts by: equal digests, equal actions."""
    network, tensors = network_to_json(policy.network)
    digest = hashlib.sha256(json.dumps([network, policy.action_transform, sorted(tensors)]).encode())
    for name in sorted(tensors):
        digest.update(tensors[name].tobytes())
    return digest.hexdigest()
