"""The written programs for Stable-Baselines3 learn from batches as large as ours; a note tells of other minibatches."""

from pathlib import Path
from typing import Any

import pytest

from policies.foreign_code import ForeignProgram, stable_baselines3_program
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack


def for_sb3(values: PPOHyperparams) -> ForeignProgram:
    return stable_baselines3_program(values, env_id="CartPole-v1", env_args={}, num_env_steps=10_000)


def of_an_iteration(values: PPOHyperparams) -> tuple[int, int]:
    """The env steps and updates of an iteration in a pack."""
    envs = make_packed_envs("CartPole-v1", {}, values.num_envs, kind="vectorised", num_processes=0)
    stack = make_stack(values, envs, "cpu")
    stack.add(new_member("m", values, 1, envs.observation_space, envs.action_space), 1)
    stack.train_iteration()
    member = stack.member("m")
    return member.num_env_steps, member.num_updates


@pytest.mark.parametrize(("train_batch_size", "num_envs"), [(700, 512), (1000, 16), (1000, 7), (1024, 8), (4, 8)])
def test_sb3_samples_as_many_env_steps_as_a_pack(train_batch_size: int, num_envs: int) -> None:
    values = PPOHyperparams(train_batch_size=train_batch_size, minibatch_size=4, num_envs=num_envs, hidden_sizes=(4,))
    num_env_steps, _ = of_an_iteration(values)
    program = for_sb3(values)
    assert f"n_steps={num_env_steps // num_envs}," in program.code
    assert not any("train batch is" in note for note in program.notes)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize(("train_batch_size", "minibatch_size", "num_epochs"), [(50, 30, 10), (64, 30, 1), (60, 30, 3)])
def test_minibatches_that_sb3_makes_otherwise_are_told(
    train_batch_size: int, minibatch_size: int, num_epochs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = PPOHyperparams(
        train_batch_size=train_batch_size, minibatch_size=minibatch_size, num_epochs=num_epochs, num_envs=2,
        hidden_sizes=(4,),
    )  # fmt: skip
    pytest.importorskip("stable_baselines3")
    # Stable-Baselines3 makes a folder for each model, of which nobody would take it away.
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    names: dict[str, Any] = {}
    # The last line trains.
    exec(for_sb3(values).code.rsplit("\n", 1)[0], names)
    model = names["model"]
    step, num_updates = model.policy.optimizer.step, [0]

    def counted() -> None:
        num_updates[0] += 1
        step()

    monkeypatch.setattr(model.policy.optimizer, "step", counted)
    model.learn(train_batch_size)
    rest, ours = train_batch_size % minibatch_size, of_an_iteration(values)[1]
    told = (
        f"Updates per train batch: SB3 {num_updates[0]}, the last of each epoch with {rest} env steps, ours {ours}, "
        f"each with {minibatch_size}."
    )
    found = [note for note in for_sb3(values).notes if note.startswith("Updates per train batch")]
    assert found == ([told] if rest else [])


def test_advantages_that_sb3_standardises_otherwise_are_told() -> None:
    told = "SB3 standardises advantages over each minibatch, ours over the whole train batch."
    assert for_sb3(PPOHyperparams()).notes == (told,)
    assert for_sb3(PPOHyperparams(normalize_advantages=False)).notes == ()
    assert for_sb3(PPOHyperparams(train_batch_size=256, minibatch_size=256)).notes == ()
