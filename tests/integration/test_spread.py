"""Episodes outside of trials: of slow environments they are played in several processes, with the same results."""

from __future__ import annotations

import os
import time
from collections import Counter
from contextvars import ContextVar
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from policy_factory import make_policy

from policies.acting.evaluate import MAX_ENVS, Episodes, evaluate_policy
from policies.acting.policy import Policy, RandomPolicy
from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from policies.errors import CannotRunError, EnvFailedError, TuneJobsError
from policies.guard import guarded, spread
from policies.guard.guard import EnvGuard, guarding

PATIENT = "odd_envs:Patient"
SEEDS = range(40, 64)


@pytest.fixture(autouse=True)
def _own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["odd_envs"])
    # None that is open around the tests, whose processes stay and which knows environments.
    monkeypatch.setattr("policies.guard.guard._current", ContextVar("guard", default=None))


@pytest.fixture
def policies() -> list[Policy]:
    random = RandomPolicy(*spaces(), env_id=PATIENT)
    return [make_policy(PATIENT, seed=1), random, make_policy(PATIENT, seed=2)]


def spaces() -> tuple[Any, Any]:
    from odd_envs import Patient

    return Patient.observation_space, Patient.action_space


def pids_of(file: Path) -> Counter[int]:
    """How many environments each process has made."""
    return Counter(map(int, file.read_text().split())) if file.exists() else Counter()


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def played(policies: list[Policy], num_processes: int, **env_args: Any) -> list[Episodes | TuneJobsError]:
    return guarded.evaluate_policies(
        policies, env_id=PATIENT, env_args=env_args, seeds=SEEDS, num_processes=num_processes, timeout_s=60
    )


def test_a_slow_env_is_played_in_several_processes_with_equal_results(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]
) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.05)
    pids, one = tmp_path / "pids", tmp_path / "one"
    alone = played(policies, 1, pids=str(one))
    assert played(policies, 3, step_s=0.002, pids=str(pids)) == alone
    assert alone == [evaluate_policy(policy, env_id=PATIENT, seeds=SEEDS) for policy in policies]
    assert len({episodes.returns for episodes in alone if isinstance(episodes, Episodes)}) == 3
    assert (len(pids_of(one)), len(pids_of(pids))) == (1, 3)
    # The first process has made one for the first seed, and for the second one; and each as many as its share is.
    assert sorted(pids_of(pids).values()) == [6, 6, 8]
    assert not any(map(is_running, pids_of(pids)))


def test_one_policy_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.05)
    for number, policy in enumerate(policies):
        pids = tmp_path / str(number)
        args = {"step_s": 0.003, "pids": str(pids)}
        episodes = guarded.evaluate_policy(policy, env_id=PATIENT, env_args=args, seeds=SEEDS, num_processes=2)
        assert episodes == evaluate_policy(policy, env_id=PATIENT, seeds=SEEDS)
        assert len(pids_of(pids)) == 2


def test_a_fast_env_is_played_in_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]) -> None:
    # However much else this machine does.
    monkeypatch.setattr(spread, "_WORTH_S", 60.0)
    pids = tmp_path / "pids"
    played(policies, 8, pids=str(pids))
    assert len(pids_of(pids)) == 1


@pytest.mark.parametrize("case", [(8, 24, 3, 3), (8, 4, 16, 2), (1, 24, 16, 1)])
def test_they_are_no_more_than_what_there_is_to_do(
    monkeypatch: pytest.MonkeyPatch, policies: list[Policy], case: tuple[int, int, int, int]
) -> None:
    num_processes, num_seeds, most, num = case
    monkeypatch.setattr(spread, "_WORTH_S", 1e-6)
    monkeypatch.setattr(spread, "_MOST", most)
    begun: list[int] = []
    begin = EnvGuard.begin

    def noted(guard: EnvGuard, *args: Any, **kwargs: Any) -> Any:
        begun.append(len(kwargs["seeds"]))
        return begin(guard, *args, **kwargs)

    monkeypatch.setattr(EnvGuard, "begin", noted)
    env_args = {"step_s": 0.001}
    told = guarded.evaluate_policies(
        policies, env_id=PATIENT, env_args=env_args, seeds=range(num_seeds), num_processes=num_processes
    )
    first = [] if num_processes == 1 else [1, 1]
    assert begun[: len(first)] == first
    assert len(begun) == len(first) + num
    assert sum(begun) == num_seeds
    assert max(begun[len(first) :]) - min(begun[len(first) :]) <= 1
    assert all(isinstance(each, Episodes) and each.seeds == tuple(range(num_seeds)) for each in told)


def test_what_is_known_of_an_env_is_not_asked_again(monkeypatch: pytest.MonkeyPatch, policies: list[Policy]) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    begun: list[list[int]] = []
    begin = EnvGuard.begin

    def noted(guard: EnvGuard, *args: Any, **kwargs: Any) -> Any:
        begun.append(list(kwargs["seeds"]))
        return begin(guard, *args, **kwargs)

    monkeypatch.setattr(EnvGuard, "begin", noted)
    with guarding():
        played(policies, 2, step_s=0.002)
        assert begun[:2] == [[SEEDS[0]], [SEEDS[1]]]
        begun.clear()
        played(policies, 2, step_s=0.002)
        assert begun == [list(SEEDS[:12]), list(SEEDS[12:])]
        begun.clear()
        # Another env may take longer.
        played(policies, 2, step_s=0.001)
        assert begun[0] == [SEEDS[0]]


def test_an_env_whose_first_episode_was_slow_alone_is_played_in_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]
) -> None:
    pids, wait, begun = tmp_path / "pids", EnvGuard._wait, []

    def noted(guard: EnvGuard, *args: Any) -> Any:
        answer = wait(guard, *args)
        begun.append(len(pids_of(pids)))
        return answer

    monkeypatch.setattr(EnvGuard, "_wait", noted)
    # When each job begins and ends: the first takes a second, the others a hundredth, whatever else this machine does.
    times = iter([0.0, 1.0, 2.0, 2.01, 3.0, 3.01])
    monkeypatch.setattr(spread, "time", SimpleNamespace(monotonic=times.__next__))
    played(policies, 8, pids=str(pids))
    # The first seed, the second one, then all others.
    assert begun == [1, 1, 1]
    assert sum(pids_of(pids).values()) == 1 + 1 + MAX_ENVS


def test_an_error_in_one_part_is_that_of_its_policy(monkeypatch: pytest.MonkeyPatch, policies: list[Policy]) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    # The last seed is played by the last process.
    told = played(policies, 3, step_s=0.002, broken="raise", broken_seed=SEEDS[-1])
    assert [str(each).splitlines()[0] for each in told] == [str(told[0]).splitlines()[0]] * 3
    assert "the motor broke" in str(told[0])
    with guarding(), pytest.raises(TuneJobsError, match="the motor broke"):
        guarded.evaluate_policy(
            policies[0], env_id=PATIENT, seeds=SEEDS, num_processes=3,
            env_args={"step_s": 0.002, "broken": "raise", "broken_seed": SEEDS[-1]},
        )  # fmt: skip


WORDS = {"exit": "ended with exit code 7", "hang": "nothing came back for"}


@pytest.mark.parametrize("broken", WORDS)
@pytest.mark.parametrize("place", [2, -1])
def test_who_ends_or_hangs_in_one_part_ends_all(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy], broken: str, place: int
) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    pids = tmp_path / "pids"
    args = {"step_s": 0.002, "pids": str(pids), "broken": broken, "broken_seed": SEEDS[place]}
    with guarding():
        with pytest.raises(EnvFailedError, match=WORDS[broken]):
            guarded.evaluate_policies(
                policies, env_id=PATIENT, env_args=args, seeds=SEEDS, num_processes=3, timeout_s=5
            )
        # Where it ends at once, the others may not have begun yet.
        assert len(pids_of(pids)) == 3 or (broken == "exit" and place == 2)
        busy = [pid for pid in pids_of(pids) if is_running(pid)]
        # Who had answered before is ready for more; nobody works on what nobody waits for.
        assert len(busy) == (0 if place == 2 else 2)
        # The guard goes on.
        assert played(policies, 3) == [evaluate_policy(policy, env_id=PATIENT, seeds=SEEDS) for policy in policies]
    assert not any(map(is_running, pids_of(pids)))


def test_an_interruption_ends_all(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    pids, wait = tmp_path / "pids", EnvGuard._wait

    def interrupted(guard: EnvGuard, *args: Any) -> Any:
        if len(pids_of(pids)) < 3:
            return wait(guard, *args)
        raise KeyboardInterrupt

    begin = EnvGuard.begin

    def begun(guard: EnvGuard, *args: Any, **kwargs: Any) -> Any:
        result = begin(guard, *args, **kwargs)

        def when_all_play() -> Any:
            while kwargs["max_envs"] < 16 and len(pids_of(pids)) < 3:
                time.sleep(0.01)
            return result()

        return when_all_play

    monkeypatch.setattr(EnvGuard, "_wait", interrupted)
    monkeypatch.setattr(EnvGuard, "begin", begun)
    with guarding():
        with pytest.raises(KeyboardInterrupt):
            played(policies, 3, step_s=0.05, pids=str(pids))
        assert len(pids_of(pids)) == 3
        assert not any(map(is_running, pids_of(pids)))
    assert os.getpid() not in pids_of(pids)


def test_where_one_cannot_begin_nobody_plays_on_and_the_next_answers_are_the_right_ones(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policies: list[Policy]
) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    pids, others = tmp_path / "pids", EnvGuard.others

    def broken(guard: EnvGuard, num: int) -> list[EnvGuard]:
        def begin(**_: Any) -> Any:
            raise CannotRunError("No process can be started.")

        found = others(guard, num)
        for each in found[1:]:
            monkeypatch.setattr(each, "begin", lambda *_, **__: begin())
        return found

    with guarding():
        with monkeypatch.context() as patch:
            patch.setattr(EnvGuard, "others", broken)
            with pytest.raises(CannotRunError):
                played(policies, 3, step_s=0.002, pids=str(pids))
        assert not any(map(is_running, pids_of(pids)))
        assert played(policies, 1) == [evaluate_policy(policy, env_id=PATIENT, seeds=SEEDS) for policy in policies]


def test_an_answer_that_nobody_waited_for_is_not_that_of_the_next_job() -> None:
    with guarding() as guard:
        guard.begin("check_env", "CartPole-v1", env_args={}, algorithm=None)
        told = guard.run("check_env", "Pendulum-v1", env_args={}, algorithm=None)
        assert told["env_id"] == "Pendulum-v1"


def test_it_is_told_how_many_episodes_have_begun(monkeypatch: pytest.MonkeyPatch, policies: list[Policy]) -> None:
    monkeypatch.setattr(spread, "_WORTH_S", 0.01)
    monkeypatch.setattr("policies.guard.guard._LOOK_S", 0.01)
    told: list[int] = []
    guarded.evaluate_policies(
        policies, env_id=PATIENT, env_args={"step_s": 0.005}, seeds=SEEDS, num_processes=3, told=told.append
    )
    assert told == sorted(told)
    # Of three policies.
    assert min(told) >= 0
    assert 2 * len(SEEDS) < max(told) <= 3 * len(SEEDS)
    assert len(set(told)) > 10
