"""The short path of `DQNLearner` computes what RLlib's own learner computes."""

from typing import Any

import pytest
import torch

from policies.hyperparams import DQNHyperparams

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

MODULE = "default_policy"


def make(**values: Any) -> Any:
    from policies.rllib.config import build_algorithm_config

    hyperparams = DQNHyperparams(hidden_sizes=(8,), gamma=0.9, **values)
    return build_algorithm_config(hyperparams, env_id="CartPole-v1", seed=3).build_algo()


def random_batch(size: int, *, seed: int) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    terminated = torch.rand(size, generator=generator) < 0.3
    n_step = torch.randint(1, 4, (size,), generator=generator).float()
    batch = {
        "obs": torch.randn(size, 4, generator=generator),
        "new_obs": torch.randn(size, 4, generator=generator),
        "actions": torch.randint(2, (size,), generator=generator),
        "rewards": 3 * torch.randn(size, generator=generator),
        "weights": torch.rand(size, generator=generator),
    }
    return batch, terminated, n_step


def rllib_forward_train(module: Any, batch: dict[str, torch.Tensor]) -> Any:
    """What RLlib's default module gives its learner, from our module's networks."""
    from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule

    return DefaultDQNTorchRLModule._forward_train(module, batch)


@pytest.mark.parametrize("double_q", [True, False])
@pytest.mark.parametrize("td_loss", ["huber", "mse"])
@pytest.mark.parametrize("dueling", [True, False])
def test_loss_and_gradients_are_rllibs(double_q: bool, td_loss: str, dueling: bool) -> None:
    from ray.rllib.algorithms.dqn.torch.dqn_torch_learner import DQNTorchLearner

    algo = make(double_q=double_q, td_loss=td_loss, dueling=dueling)
    learner = algo.learner
    module = learner.module[MODULE]
    batch, terminated, n_step = random_batch(32, seed=0)
    with torch.no_grad():
        for weight in module.encoder.parameters():
            weight.add_(0.3 * torch.randn(weight.shape))  # or online and target network would be the same

    def gradients(loss: torch.Tensor) -> list[torch.Tensor]:
        learner.get_optimizer(MODULE).zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        return [param.grad.clone() for param in learner.get_optimizer(MODULE).param_groups[0]["params"]]

    ours, td_errors, _ = learner.loss({**batch, "discounts": 0.9**n_step * ~terminated}, module._forward_train(batch))
    our_gradients = gradients(ours)
    config = learner.config.copy(copy_frozen=False)
    config.td_error_loss_fn = td_loss
    theirs = DQNTorchLearner.compute_loss_for_module(
        learner,
        module_id=MODULE,
        config=config,
        batch={**batch, "terminateds": terminated, "n_step": n_step},
        fwd_out=rllib_forward_train(module, batch),
    )
    torch.testing.assert_close(ours, theirs)
    assert len(our_gradients) == (6 if dueling else 4)
    for mine, other in zip(our_gradients, gradients(theirs), strict=True):
        torch.testing.assert_close(mine, other)
        assert mine.abs().sum() > 0
    assert td_errors.shape == (32,)
    algo.stop()


def test_a_loss_that_is_no_number_is_not_hidden() -> None:
    """RLlib's learner zeroes NaN gradients and goes on as if nothing was wrong; the trial must fail instead."""
    algo = make(learning_starts=0, env_steps_per_iteration=40)
    with torch.no_grad():
        algo.learner.module[MODULE].af.bias.fill_(float("nan"))
    algo.train()
    weights = algo.learner.module[MODULE].encoder.state_dict()
    assert not all(torch.isfinite(weight).all() for weight in weights.values())
    algo.stop()


@pytest.mark.parametrize("num_env_runners", [0, 2])
def test_results_tell_of_the_last_episodes_as_rllibs_do(num_env_runners: int) -> None:
    """For whoever goes on with a restored algorithm; the returns are those of the episodes that a trial counts."""
    from policies.rllib.config import build_algorithm_config

    hyperparams = DQNHyperparams(hidden_sizes=(8,), env_steps_per_iteration=300, num_envs=2)
    config = build_algorithm_config(hyperparams, env_id="CartPole-v1", seed=3, num_env_runners=num_env_runners)
    algo = config.reporting(metrics_num_episodes_for_smoothing=20).build_algo()

    def drawn(runner: Any) -> list[tuple[float, int]]:
        return list(runner.pop_finished_episodes())

    for expected_iterations in (1, 2):
        result = algo.train()["env_runners"]
        if num_env_runners:
            parts = algo.env_runner_group.foreach_env_runner(drawn, local_env_runner=False)
        else:
            parts = [drawn(algo.env_runner)]
        assert sum(map(len, parts)) > 0
        recent = list(algo._last_episodes)
        # The newest are those of this iteration; by runner, as they come.
        assert {episode for part in parts for episode in part} >= set(recent[-5:])
        returns, lengths = zip(*recent, strict=True)
        assert len(recent) <= 20
        assert result["episode_return_mean"] == pytest.approx(sum(returns) / len(returns))
        assert (result["episode_return_min"], result["episode_return_max"]) == (min(returns), max(returns))
        assert result["episode_len_mean"] == pytest.approx(sum(lengths) / len(lengths))
        assert (result["episode_len_min"], result["episode_len_max"]) == (min(lengths), max(lengths))
        assert result["num_episodes_lifetime"] == algo.num_episodes
        assert result["num_env_steps_sampled_lifetime"] == algo.num_env_steps >= 300 * expected_iterations
    algo.stop()
