"""The policy to deploy, chosen by more episodes among the checkpoints of all trials: real CartPole, made-up trials."""

import dataclasses
import itertools
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_engine import FakeEngine
from policy_factory import balancing_policy, make_policy
from sweep_folders import MACHINE, SPEC, train

from analysis.best_records import BestRecord, ChoiceRecord
from analysis.selection import NoUsableTrialError
from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import NetworkPolicy
from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from policies.errors import EnvFailedError, NonFiniteWeightsError
from policies.guard import guarded
from policies.portable.file import Layer, PolicyNetwork, PortablePolicy, read_policy
from tests.integration.test_baseline_sweeps import finished_sweep
from tests.narrowing import present
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.seeds import evaluation_seeds
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import policy_choice
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.policy_choice import confirmed_best

HOSTILE = "hostile_envs:Hostile"


class Skilled(FakeEngine):
    """Its policies are given: one an iteration."""

    def __init__(self, *policies: PortablePolicy) -> None:
        super().__init__()
        self.policies = policies

    def policy(self) -> PortablePolicy:
        return dataclasses.replace(self.policies[self.iteration - 1], training={"iteration": self.iteration})


def skilled(skill: str, scale: float = 1.0) -> PortablePolicy:
    """A policy of a skill; policies of two scales act alike but are not the same."""
    portable = balancing_policy("CartPole-v1", skill).portable
    (layer,) = portable.network.layers
    network = PolicyNetwork(portable.network.kind, (Layer(np.float32(scale) * layer.weight, layer.bias),))
    return dataclasses.replace(portable, network=network)


Trials = Sequence[tuple[Sequence[PortablePolicy], Sequence[float]]]


def score_of(scores: Sequence[float]) -> Callable[[int], float]:
    return lambda iteration: scores[iteration - 1]


def make_sweep(folder: Path, trials: Trials, **spec: Any) -> SweepStore:
    """A finished sweep whose trial i has the i-th policies, which scored as told."""
    store = SweepStore(folder)
    store.create()
    made = SweepSpec.model_validate(SPEC | {"num_samples": len(trials), "seeds_per_point": 1} | spec)
    plan = make_plan(made, MACHINE)
    write_new(store, made, plan, None)
    for trial, (policies, scores) in zip(plan.trials, trials, strict=True):
        train(store, trial.trial_id, len(policies), Skilled(*policies), score_of(scores))
    store.write_record(store.read_record().model_copy(update={"state": "completed", "ended_at": 2.0}))
    return store


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., SweepStore]:
    return lambda trials, **spec: make_sweep(tmp_path / "mine", trials, **spec)


def places(choice: ChoiceRecord) -> list[tuple[str, int]]:
    return [(item.checkpoint.trial_id, item.checkpoint.iteration) for item in choice.candidates]


def chosen(store: SweepStore, num_episodes: int = 5) -> tuple[BestRecord, ChoiceRecord]:
    best = finish.choose_best(store, num_episodes)
    return best, present(best.choice)


LUCKY: Trials = [
    ([skilled("poor")], [200.0]),
    ([skilled("wobbly")], [199.0]),
    ([skilled("good")], [198.0]),
    ([skilled("fair")], [197.0]),
]
"""The better a policy is, the less lucky was its evaluation."""


def test_more_episodes_choose_not_the_luckiest_evaluation(make: Callable[..., SweepStore]) -> None:
    store = make(LUCKY)
    best, choice = chosen(store)
    assert places(choice) == [("t0002", 1), ("t0003", 1), ("t0001", 1), ("t0000", 1)]
    assert best.checkpoint == choice.winner.checkpoint
    assert best.point == choice.winner.point == store.trial("t0002").read_record().point
    assert best.selection_score == choice.winner.score
    assert [item.rejected_in for item in choice.candidates] == [None, 3, 2, 1]
    assert choice.winner.num_episodes > choice.candidates[-1].num_episodes > choice.num_evaluation_episodes == 2
    assert choice.num_episodes == sum(item.num_episodes - 2 for item in choice.candidates) <= 400
    assert 0 < choice.num_env_steps <= choice.max_env_steps == 200_000
    assert store.read_best() == best


def test_the_scores_are_those_of_the_evaluation_seeds_behind_the_first(make: Callable[..., SweepStore]) -> None:
    store = make(LUCKY)
    _, choice = chosen(store)
    seeds = evaluation_seeds(0, 10_000)
    assert store.read_record().evaluation_seeds == seeds[:2]
    assert choice.first_seed == seeds[2]
    for item, (policies, scores) in zip(
        reversed(choice.candidates), (LUCKY[0], LUCKY[1], LUCKY[3], LUCKY[2]), strict=True
    ):
        more = seeds[2 : item.num_episodes]
        played = evaluate_policy(NetworkPolicy(policies[0]), env_id="CartPole-v1", seeds=more)
        assert item.score == pytest.approx((2 * scores[0] + sum(played.returns)) / item.num_episodes)
        if item.lower is None:  # equal since, and other than at first: nothing is known of how far they spread
            (only,) = set(played.returns)
            assert only != scores[0]
            continue
        assert item.lower <= item.score <= present(item.upper)
    assert sum(item.lower is not None for item in choice.candidates) == 3


def test_winner_and_runners_up_are_confirmed_on_seeds_that_chose_nothing(make: Callable[..., SweepStore]) -> None:
    best, choice = chosen(make([*LUCKY, ([skilled("poor", 2.0)], [1.0])]), 6)
    assert [item.confirmation is None for item in choice.candidates] == [True, False, False, False, True]
    for item in choice.runners_up:
        confirmation = present(item.confirmation)
        assert confirmation.seeds == best.confirmation.seeds
        assert confirmation.threshold == best.confirmation.threshold == 475.0
        assert confirmation.policy == f"{item.checkpoint.trial_id} at 100 env steps"
    used = set(evaluation_seeds(0, choice.winner.num_episodes))
    assert not used & set(best.confirmation.seeds)
    played = evaluate_policy(NetworkPolicy(skilled("fair")), env_id="CartPole-v1", seeds=best.confirmation.seeds)
    assert present(choice.candidates[1].confirmation).returns == played.returns


def test_candidates_come_from_all_trials_and_all_points(make: Callable[..., SweepStore]) -> None:
    """A point whose mean is worse, and which has a failed seed, may have the best policy."""
    trials: Trials = [
        ([skilled("wobbly")], [300.0]),
        ([skilled("wobbly", 2.0)], [300.0]),
        ([skilled("poor"), skilled("good"), skilled("poor", 2.0)], [10.0, 290.0, 20.0]),
        ([skilled("poor", 3.0)], [1.0]),
    ]
    store = make(trials, num_samples=2, seeds_per_point=2)
    lost = store.trial("t0003")
    lost.write_record(lost.read_record().model_copy(update={"status": "failed", "error": "boom"}))
    best, choice = chosen(store)
    assert (best.checkpoint.trial_id, best.checkpoint.iteration) == ("t0002", 2)
    assert ("t0003", 1) not in places(choice)
    assert choice.num_known == len(choice.candidates) == 5


def test_equal_to_the_last_episode_fewer_env_steps_win(make: Callable[..., SweepStore]) -> None:
    twins: Trials = [
        ([skilled("poor"), skilled("good")], [10.0, 500.0]),
        ([skilled("good", 2.0)], [500.0]),
        ([skilled("fair")], [500.0]),
    ]
    best, choice = chosen(make(twins))
    assert best.checkpoint.trial_id == "t0001"
    assert places(choice)[1] == ("t0000", 2)
    assert choice.candidates[1].num_episodes == choice.winner.num_episodes
    assert choice.candidates[1].reason == "a tie, from more env steps"


def test_one_policy_in_several_checkpoints_plays_once(make: Callable[..., SweepStore]) -> None:
    best, choice = chosen(make([([skilled("fair"), skilled("fair")], [50.0, 50.0]), ([skilled("fair")], [50.0])]))
    assert (best.checkpoint.trial_id, best.checkpoint.iteration) == ("t0000", 1)
    assert [item.rejected_in for item in choice.candidates] == [None, 0, 0]
    assert {item.reason for item in choice.candidates[1:]} == {"the same policy as t0000 at 100 env steps"}
    assert (choice.num_rounds, choice.num_episodes, choice.first_seed, len(choice.played)) == (0, 0, None, 1)


def test_a_checkpoint_that_cannot_be_read_is_left_out_with_the_reason(
    make: Callable[..., SweepStore], caplog: pytest.LogCaptureFixture
) -> None:
    store = make(LUCKY)
    (store.trial("t0002").checkpoint_folder(1) / "policy.safetensors").write_bytes(b"")
    best, choice = chosen(store)
    assert best.checkpoint.trial_id == "t0003"
    (left_out,) = [item for item in choice.candidates if item.rejected_in == 0]
    assert left_out.checkpoint.trial_id == "t0002"
    assert "trials/t0002/checkpoints/000001" in left_out.reason
    assert str(store.folder) not in left_out.reason
    assert "t0002/checkpoints/000001" in caplog.text
    assert len(choice.played) == 3


def test_with_no_whole_checkpoint_there_is_no_best(make: Callable[..., SweepStore]) -> None:
    store = make(LUCKY[:2])
    for trial_id in ("t0000", "t0001"):
        (store.trial(trial_id).checkpoint_folder(1) / "policy.json").write_text("{}")
    with pytest.raises(NoUsableTrialError, match="2 without a kept checkpoint"):
        chosen(store)


def break_weights(monkeypatch: pytest.MonkeyPatch, *trial_ids: str) -> None:
    """Let the weights of trials not be finite; a trial itself would have failed by them."""
    real = read_policy

    def read(folder: Path) -> PortablePolicy:
        return skilled("good", float("nan")) if folder.parts[-3] in trial_ids else real(folder)

    monkeypatch.setattr(policy_choice, "read_policy", read)


def test_weights_that_are_not_finite_lose_with_the_reason(
    make: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(LUCKY)
    break_weights(monkeypatch, "t0000")
    best, choice = chosen(store)
    assert best.checkpoint.trial_id == "t0002"
    (lost,) = [item for item in choice.candidates if item.reason]
    assert (lost.checkpoint.trial_id, lost.rejected_in, lost.confirmation) == ("t0000", 1, None)
    assert "nan" in lost.reason.lower()


def test_a_sweep_of_nothing_but_broken_weights_says_so(
    make: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(LUCKY[:2])
    break_weights(monkeypatch, "t0000", "t0001")
    with pytest.raises(NonFiniteWeightsError):
        chosen(store)


def test_an_env_that_fails_meanwhile_leaves_the_choice_to_what_is_known(
    make: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the policy can be confirmed in it is seen afterwards."""

    def fail(*_: object, **__: object) -> Sequence[Any]:
        raise EnvFailedError("it hangs in step()")

    store = make(LUCKY)
    monkeypatch.setattr(policy_choice, "evaluate_policies", fail)
    best, choice = chosen(store)
    assert best.checkpoint.trial_id == "t0000"
    assert "Round 1 could not be played: it hangs in step()" in choice.note
    assert "The runners-up could not be confirmed: it hangs in step()" in choice.note
    assert choice.runners_up == ()


def test_the_choice_is_the_same_again_and_whatever_order_trials_ended_in(
    make: Callable[..., SweepStore], tmp_path: Path
) -> None:
    best, _ = chosen(make(LUCKY))
    assert finish.choose_best(SweepStore(tmp_path / "mine"), 5) == best


def test_a_winner_stays_until_there_are_other_candidates(make: Callable[..., SweepStore]) -> None:
    store = make(LUCKY)
    best, choice = chosen(store)
    assert confirmed_best(store) == best
    shutil.rmtree(store.trial("t0000").checkpoint_folder(1))
    assert confirmed_best(store) is None, "a candidate is missing"
    best, choice = chosen(store)
    assert confirmed_best(store) == best
    older = best.model_copy(update={"choice": choice.model_copy(update={"max_env_steps": 1})})
    store.write_best(older, read_policy(store.best_folder))
    assert confirmed_best(store) is None, "fewer env steps were played than would be now"


def test_the_winner_of_an_older_version_stays_if_its_rule_would_choose_it(make: Callable[..., SweepStore]) -> None:
    store = make(LUCKY)
    best, choice = chosen(store)
    policy = read_policy(store.best_folder)
    store.write_best(best.model_copy(update={"choice": None}), policy)
    assert confirmed_best(store) is None
    first = choice.candidates[-1].checkpoint
    store.write_best(best.model_copy(update={"choice": None, "checkpoint": first}), policy)
    assert present(confirmed_best(store)).checkpoint == first


@pytest.mark.parametrize("algorithm", ["random", "constant"])
def test_a_baseline_has_one_candidate_however_often_it_was_kept(tmp_path: Path, algorithm: Any) -> None:
    best, choice = chosen(finished_sweep(tmp_path, algorithm))
    assert len(choice.candidates) > 1
    assert len(choice.played) == 1
    assert best.checkpoint == choice.winner.checkpoint
    assert choice.num_env_steps == 0


def test_many_policies_play_as_each_would_alone() -> None:
    policies = [NetworkPolicy(skilled(skill)) for skill in ("good", "fair", "poor", "wobbly")]
    together = guarded.evaluate_policies(policies, env_id="CartPole-v1", seeds=range(20))
    assert together == [evaluate_policy(policy, env_id="CartPole-v1", seeds=range(20)) for policy in policies]


@pytest.fixture
def hostile(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Sequence[Any]]:
    """Evaluates three policies in an environment that does what it is told."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["hostile_envs"])
    policies = [make_policy(HOSTILE, seed=seed) for seed in range(3)]

    def play(**env_args: Any) -> Sequence[Any]:
        return guarded.evaluate_policies(policies, env_id=HOSTILE, env_args=env_args, seeds=[1, 2], timeout_s=2)

    return play


def test_an_env_that_an_earlier_policy_broke_is_made_anew_for_the_next(hostile: Callable[..., Sequence[Any]]) -> None:
    """Two episodes are 40 steps of each env; its 50th is in the second policy's episodes, and never in one's own."""
    played = hostile(how="fail", at=50, num_steps=40)
    assert [result.returns for result in played] == [(40.0, 40.0)] * 3
    failed = hostile(how="fail", at=30, num_steps=40)
    assert all("the motor broke" in result.message for result in failed)


@pytest.mark.parametrize(("how", "words"), [("exit", "ended with exit code 7"), ("hang", "hangs in step")])
def test_an_env_that_ends_or_hangs_ends_them_all(hostile: Callable[..., Sequence[Any]], how: str, words: str) -> None:
    with pytest.raises(EnvFailedError, match=words):
        hostile(how=how, at=3)


def test_all_is_played_with_the_cpus_that_there_are_and_tells_how_far_it_is(
    make: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finish, "cpus_for_episodes", {None: 3}.__getitem__)
    asked: list[int] = []
    said: list[str] = []

    def noted(play: Callable[..., Any]) -> Callable[..., Any]:
        def played(*args: Any, **kwargs: Any) -> Any:
            asked.append(kwargs["num_processes"])
            kwargs["told"](7)
            return play(*args, **kwargs)

        return played

    monkeypatch.setattr(policy_choice, "evaluate_policies", noted(guarded.evaluate_policies))
    monkeypatch.setattr(finish, "evaluate_policy", noted(guarded.evaluate_policy))
    best = finish.choose_best(make(LUCKY), 5, said.append)
    # In each round, the winner's confirmation, the random policy's and that of the runners-up.
    assert len(asked) >= present(best.choice).num_rounds + 3
    assert set(asked) == {3}
    phases = [list(group) for _, group in itertools.groupby(said, lambda text: text.split(":")[0])]
    assert [group[0].split(":")[0] for group in phases] == [
        "choosing the best policy", "confirming the best policy", "playing at random, to compare with it",
        "confirming the runners-up",
    ]  # fmt: skip
    assert phases[0][0] == "choosing the best policy: 0 of at most 200,000 env steps; episode 4 of 4"
    # The env steps of the rounds before.
    assert len({text.split(";")[0] for text in phases[0]}) >= present(best.choice).num_rounds > 1
    assert [group[0].split(": ")[1] for group in phases[1:]] == [
        "episode 5 of 5", "episode 5 of 5", "episode 7 of 15",
    ]  # fmt: skip
