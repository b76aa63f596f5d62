"""PPO's schedules and KL weight over iterations and restores; observation statistics over env runners."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from packed_rllib import episodes_of, make_stack, sample
from ppo_cases import clip_of, current_lr, entropy_weight
from rllib_cases import MODULE, SMALL, Build, env_steps, learner_of, module_of

from policies.errors import CheckpointError
from policies.hyperparams import PPOHyperparams
from policies.packed.member import Weights

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


@pytest.fixture
def build() -> Iterator[Build]:
    """Make a PPO Algorithm from a few hyperparameters; all are stopped at the end."""
    from policies.rllib.config import build_algorithm_config

    built = []

    def make(num_env_runners: int = 0, **values: Any) -> Any:
        hyperparams = PPOHyperparams(**{**SMALL["ppo"], **values})
        config = build_algorithm_config(hyperparams, env_id="CartPole-v1", seed=7, num_env_runners=num_env_runners)
        built.append(config.build_algo())
        return built[-1]

    yield make
    for algo in built:
        algo.stop()


def saved_and_restored(algo: Any, folder: Path, make_new: Callable[[], Any]) -> Any:
    """A second Algorithm with the first one's checkpoint."""
    algo.save_to_path(str(folder))
    restored = make_new()
    restored.restore_from_path(str(folder))
    return restored


def in_first_update(algo: Any, read: Callable[[Any], float]) -> tuple[int, float]:
    """(env steps, what `read` gives in the first update of the next iteration)."""
    learner, seen = learner_of(algo), []
    update = learner._update

    def reading(*args: Any, **kwargs: Any) -> Any:
        seen.append(read(algo))
        return update(*args, **kwargs)

    learner._update = reading
    steps = env_steps(algo.train())
    learner._update = update
    return steps, seen[0]


@pytest.mark.parametrize(("read", "name", "decay"), [
    (current_lr, "lr", "lr_decay_steps"),
    (entropy_weight, "entropy_coeff", "entropy_decay_steps"),
    (clip_of, "clip_param", "clip_decay_steps"),
])  # fmt: skip
def test_schedules_go_on_after_a_restore(
    build: Build, tmp_path: Path, read: Callable[[Any], float], name: str, decay: str
) -> None:
    values = {name: 0.1, f"{name}_final": 0.02, decay: 400}
    algo = build(**values)
    for _ in range(2):
        algo.train()
    restored = saved_and_restored(algo, tmp_path, lambda: build(**values))
    steps, value = in_first_update(restored, read)
    assert 190 <= steps <= 200  # the third iteration's
    assert value == pytest.approx(0.1 - 0.08 * steps / 400, rel=1e-3)


def test_the_kl_weight_moves_in_training_and_is_restored(build: Build, tmp_path: Path) -> None:
    values = {"use_kl_loss": True, "kl_coeff": 0.4, "kl_target": 1e-9, "lr": 1e-2, "num_epochs": 4}
    algo = build(**values)
    for iteration in (1, 2):
        algo.train()
        # Each iteration moves the policy by more than twice the target.
        assert float(learner_of(algo).curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.4 * 1.5**iteration)
    restored = saved_and_restored(algo, tmp_path, lambda: build(**values))
    assert float(learner_of(restored).curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.9)
    # Population based training goes on from another trial's checkpoint with a kl_coeff of its own.
    mutated = saved_and_restored(algo, tmp_path / "mutated", lambda: build(**{**values, "kl_coeff": 0.6}))
    assert float(learner_of(mutated).curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.6)


def test_the_statistics_of_returns_are_restored_and_grow_on(build: Build, tmp_path: Path) -> None:
    algo = build(2, normalize_rewards=True)
    steps = 0
    for _ in range(2):
        steps = env_steps(algo.train())
    before = vars(learner_of(algo).return_statistics)
    # Those of both env runners' steps.
    assert before["count"] == pytest.approx(steps + 1e-4)
    assert learner_of(algo)._returns.keys()
    restored = saved_and_restored(algo, tmp_path, lambda: build(normalize_rewards=True))
    assert vars(learner_of(restored).return_statistics) == before
    later = env_steps(restored.train())
    assert learner_of(restored).return_statistics.count == pytest.approx(later + 1e-4)
    without = build()
    without.save_to_path(str(tmp_path / "without"))
    with pytest.raises(CheckpointError, match="no statistics of the return"):
        learner_of(restored).set_state(learner_of(without).get_state())


def test_returns_go_on_from_chunk_to_chunk_as_in_a_pack(build: Build) -> None:
    """The same fragments give a pack and RLlib's learner the same statistics, which a pack's checkpoint hands over."""
    from policies.packed.to_rllib import to_algorithm

    stack = make_stack("CartPole-v1", [{"normalize_rewards": True, "train_batch_size": 80}])
    learner = learner_of(build(normalize_rewards=True))
    ids = ["first"] * 4
    for number in range(3):
        fragment = sample(stack).fragment
        chunks, expected = [], []
        for row in range(4):
            start = 0
            for episode in episodes_of(fragment, row, "CartPole-v1", fragment.last[row]):
                episode.id_ = f"{row} {ids[row]}"
                episode.rewards.data = np.ones_like(episode.rewards.data)
                if episode.is_done:
                    ids[row] = f"{number} {start}"
                chunks.append(episode)
                expected.append(fragment.rewards[start : start + len(episode), row])
                start += len(episode)
        found = learner._with_normalized_rewards(chunks)
        (member,) = stack.members
        assert vars(learner.return_statistics) == pytest.approx(vars(member.return_statistics), rel=1e-9)
        for episode, rewards in zip(found, expected, strict=True):
            np.testing.assert_allclose(episode.get_rewards(), rewards, rtol=1e-6)
    assert fragment.ended.any()
    stack.envs.close()
    algorithm = to_algorithm(member, env_id="CartPole-v1", env_args={})
    assert vars(learner_of(algorithm).return_statistics) == vars(member.return_statistics)
    algorithm.stop()


def first_ratios(algo: Any) -> torch.Tensor:
    """exp(log probability in the first update - in sampling) of the rows that are env steps."""
    learner, module = learner_of(algo), module_of(algo)
    ratios: list[torch.Tensor] = []
    update = learner._update

    def reading(batch: Any, *args: Any, **kwargs: Any) -> Any:
        if not ratios:
            rows = batch[MODULE]
            with torch.no_grad():
                logits = module.forward_train(rows)["action_dist_inputs"]
            now = torch.distributions.Categorical(logits=logits).log_prob(rows["actions"])  # type: ignore[no-untyped-call]
            ratios.append(torch.exp(now - rows["action_logp"])[rows["loss_mask"]])
        return update(batch, *args, **kwargs)

    learner._update = reading
    algo.train()
    learner._update = update
    return ratios[0]


def runner_statistics(algo: Any) -> list[Weights]:
    return [
        {name: np.asarray(value) for name, value in state.items() if name.startswith("obs_")}
        for state in algo.env_runner_group.foreach_env_runner(
            lambda runner: {name: value.numpy() for name, value in runner.module.state_dict().items()},
            local_env_runner=False,
        )
    ] or [{name: value.numpy() for name, value in algo.env_runner.module.state_dict().items() if name[:4] == "obs_"}]


@pytest.mark.parametrize("num_env_runners", [0, 2])
def test_sampling_and_training_use_the_same_statistics(build: Build, num_env_runners: int) -> None:
    algo = build(num_env_runners, normalize_observations=True, lr=1e-2, vf_share_layers=True)
    for _ in range(3):
        # Statistics move by a lot in the first iterations: with newer ones the ratios would be far from 1.
        ratios = first_ratios(algo)
        assert len(ratios) > 20
        torch.testing.assert_close(ratios, torch.ones_like(ratios), rtol=1e-4, atol=1e-4)
        statistics = runner_statistics(algo)
        assert len(statistics) == max(1, num_env_runners)
        for found in statistics:
            for name in ("obs_mean", "obs_var", "obs_count"):
                np.testing.assert_array_equal(found[name], module_of(algo).state_dict()[name].numpy())


def test_statistics_are_of_the_env_steps_alone(build: Build) -> None:
    """RLlib's batch has a row more for each episode chunk, which would be counted twice."""
    algo = build(normalize_observations=True)
    steps = env_steps(algo.train())
    assert int(module_of(algo).obs_count) == steps


def test_statistics_are_restored_and_grow_on(build: Build, tmp_path: Path) -> None:
    algo = build(normalize_observations=True)
    algo.train()
    before = {name: value.clone() for name, value in module_of(algo).state_dict().items()}
    restored = saved_and_restored(algo, tmp_path, lambda: build(normalize_observations=True))
    for name, value in module_of(restored).state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0)
    ratios = first_ratios(restored)
    torch.testing.assert_close(ratios, torch.ones_like(ratios), rtol=1e-4, atol=1e-4)
    assert int(module_of(restored).obs_count) > int(before["obs_count"])
