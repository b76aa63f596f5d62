"""Every hyperparameter is found again where it acts: in the network, the optimizer, the loss, the replay buffer.

RLlib takes some settings and ignores them; so nothing here looks at the `AlgorithmConfig` alone. A case is a function
that builds an Algorithm and raises AssertionError unless its hyperparameter acts; one test calls the case of each
field, another fails for a field without one.
"""

import numpy as np
import pytest
import torch
from torch import nn

from policies.hyperparams import (
    ACTIVATIONS,
    HYPERPARAMS_BY_ALGORITHM,
    DQNHyperparams,
    PPOHyperparams,
    make_hyperparams,
)

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

MODULE = "default_policy"
# Small, so that a case takes a tenth of a second; a case changes what it is about.
SMALL = {
    "ppo": {"hidden_sizes": (8,), "train_batch_size": 64, "minibatch_size": 32, "num_epochs": 1, "num_envs": 2},
    "dqn": {"hidden_sizes": (8,), "env_steps_per_iteration": 20, "learning_starts": 0, "train_batch_size": 8},
}
CASES = {}


def reaches(*algorithms, field):
    """Make a function the case of a field."""

    def add(check):
        for algorithm in algorithms:
            assert (algorithm, field) not in CASES
            CASES[algorithm, field] = check
        return check

    return add


@pytest.fixture
def build():
    """Make an Algorithm from a few hyperparameters; all are stopped at the end."""
    from policies.rllib_config import build_algorithm_config

    built = []

    def make(algorithm, env_id="CartPole-v1", num_env_runners=0, **values):
        hyperparams = make_hyperparams(algorithm, {**SMALL[algorithm], **values})
        config = build_algorithm_config(hyperparams, env_id=env_id, seed=1024, num_env_runners=num_env_runners)
        built.append(config.build_algo())
        return built[-1]

    yield make
    for algo in built:
        algo.stop()


# -- what the cases look at


def learner_of(algo):
    return algo.learner_group._learner


def module_of(algo):
    return learner_of(algo).module[MODULE]


def modules_of(algo):
    """The network that learns, and the one that acts."""
    return module_of(algo), algo.env_runner.module


def loss_config(algo):
    return learner_of(algo).config.get_config_for_module(MODULE)


def linears(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def optimizer_of(algo):
    return learner_of(algo).get_optimizer(MODULE)


def count_updates(algo):
    """A list to which each gradient step from now on adds the number of its rows."""
    sizes = []
    learner = learner_of(algo)
    update = learner._update

    def counted(batch, *args, **kwargs):
        sizes.append(len(batch[MODULE]["obs"]))
        return update(batch, *args, **kwargs)

    learner._update = counted
    return sizes


def env_steps(result):
    return int(result["env_runners"]["num_env_steps_sampled_lifetime"])


# -- PPO and DQN


@reaches("ppo", "dqn", field="hidden_sizes")
def check_hidden_sizes(build, algorithm):
    for sizes in ((7,), (12, 5, 9)):
        for module in modules_of(build(algorithm, hidden_sizes=sizes)):
            encoders = [module.encoder]
            if algorithm == "ppo":
                encoders = [module.encoder.actor_encoder]
                if not module.inference_only:
                    encoders.append(module.encoder.critic_encoder)
            for encoder in encoders:
                assert [layer.out_features for layer in linears(encoder)] == list(sizes)
            head = module.pi if algorithm == "ppo" else module.af
            # One linear layer: RLlib would put a hidden layer of its own before DQN's outputs.
            assert [(layer.in_features, layer.out_features) for layer in linears(head)] == [(sizes[-1], 2)]


@reaches("ppo", "dqn", field="activation")
def check_activation(build, algorithm):
    expected = {"linear": None, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "elu": nn.ELU, "gelu": nn.GELU}
    assert set(expected) == set(ACTIVATIONS)
    for activation, kind in expected.items():
        for module in modules_of(build(algorithm, hidden_sizes=(8, 6), activation=activation)):
            encoder = module.encoder.actor_encoder if algorithm == "ppo" else module.encoder
            found = [type(layer) for layer in encoder.net.mlp if not isinstance(layer, nn.Linear)]
            assert found == ([] if kind is None else [kind] * 2), activation
            head = module.pi if algorithm == "ppo" else module.af
            assert all(isinstance(layer, nn.Linear) for layer in head.net.mlp)


@reaches("ppo", "dqn", field="lr")
def check_lr(build, algorithm):
    algo = build(algorithm, lr=1.7e-3)
    for _ in range(2):
        assert [group["lr"] for group in optimizer_of(algo).param_groups] == [1.7e-3]
        assert isinstance(optimizer_of(algo), torch.optim.Adam)
        algo.train()


@reaches("ppo", "dqn", field="grad_clip")
def check_grad_clip(build, algorithm):
    for clip in (None, 0.25):
        learner = learner_of(build(algorithm, grad_clip=clip))
        gradients = {reference: torch.full_like(param, 3.0) for reference, param in learner._params.items()}
        before = torch.sqrt(sum((value**2).sum() for value in gradients.values()))
        after = torch.sqrt(sum((value**2).sum() for value in learner.postprocess_gradients(gradients).values()))
        assert float(before) > 10
        assert float(after) == pytest.approx(float(before) if clip is None else clip, rel=1e-3)


@reaches("ppo", "dqn", field="num_envs")
def check_num_envs(build, algorithm):
    for env_id in ("CartPole-v1", "Acrobot-v1"):  # physics of its own, and a loop over envs
        runner = build(algorithm, env_id, num_envs=5).env_runner
        assert runner.num_envs == runner.env.num_envs == 5
        assert runner.env.observation_space.shape[0] == 5


# -- PPO


def ppo_loss(algo, hyperparams):
    """(RLlib's loss, the loss by its definition) of one batch whose ratios and values are beyond every clip."""
    learner, module = learner_of(algo), module_of(algo)
    rng = torch.Generator().manual_seed(0)
    batch = {
        "obs": torch.randn(64, 4, generator=rng),
        "actions": torch.randint(2, (64,), generator=rng),
        "action_logp": -0.2 - torch.rand(64, generator=rng),
        "action_dist_inputs": torch.randn(64, 2, generator=rng),
        "advantages": torch.randn(64, generator=rng),
        "value_targets": 6 * torch.randn(64, generator=rng),
    }
    with torch.no_grad():
        out = module.forward_train(batch)
        theirs = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=batch, fwd_out=out)
        now = torch.distributions.Categorical(logits=out["action_dist_inputs"])
        then = torch.distributions.Categorical(logits=batch["action_dist_inputs"])
        ratio = torch.exp(now.log_prob(batch["actions"]) - batch["action_logp"])
        clipped = torch.clamp(ratio, 1 - hyperparams.clip_param, 1 + hyperparams.clip_param)
        loss = -torch.min(batch["advantages"] * ratio, batch["advantages"] * clipped).mean()
        value_loss = (module.compute_values(batch) - batch["value_targets"]) ** 2
        if hyperparams.vf_clip_param is not None:
            value_loss = value_loss.clamp(0, hyperparams.vf_clip_param)
        loss += hyperparams.vf_loss_coeff * value_loss.mean() - hyperparams.entropy_coeff * now.entropy().mean()
        if hyperparams.use_kl_loss:
            loss += hyperparams.kl_coeff * torch.distributions.kl_divergence(then, now).mean()
    return float(theirs), float(loss)


def check_loss(build, **values):
    """The loss is the one these values define, and not the one without them."""
    fixed = {key: value for key, value in values.items() if key == "use_kl_loss"} if len(values) > 1 else {}
    losses = []
    for changed in (fixed, values):
        hyperparams = PPOHyperparams(**{**SMALL["ppo"], **changed})
        theirs, ours = ppo_loss(build("ppo", **changed), hyperparams)
        assert theirs == pytest.approx(ours, rel=1e-4)
        losses.append(theirs)
    assert abs(losses[1] - losses[0]) > 1e-3


@reaches("ppo", field="clip_param")
def check_clip_param(build, _):
    check_loss(build, clip_param=0.03)


@reaches("ppo", field="vf_clip_param")
def check_vf_clip_param(build, _):
    check_loss(build, vf_clip_param=2.5)


@reaches("ppo", field="vf_loss_coeff")
def check_vf_loss_coeff(build, _):
    check_loss(build, vf_loss_coeff=0.2)


@reaches("ppo", field="entropy_coeff")
def check_entropy_coeff(build, _):
    check_loss(build, entropy_coeff=0.3)


@reaches("ppo", field="use_kl_loss")
def check_use_kl_loss(build, _):
    check_loss(build, use_kl_loss=True)


@reaches("ppo", field="kl_coeff")
def check_kl_coeff(build, _):
    check_loss(build, use_kl_loss=True, kl_coeff=0.9)


@reaches("ppo", field="kl_target")
def check_kl_target(build, _):
    for target, factor in ((0.01, 1.5), (0.03, 1.0), (0.2, 0.5)):
        algo = build("ppo", use_kl_loss=True, kl_coeff=0.4, kl_target=target)
        learner = learner_of(algo)
        learner._update_module_kl_coeff(module_id=MODULE, config=loss_config(algo), kl_loss=0.05)
        assert float(learner.curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.4 * factor)


@reaches("ppo", field="vf_share_layers")
def check_vf_share_layers(build, _):
    names = {share: set(module_of(build("ppo", vf_share_layers=share)).state_dict()) for share in (False, True)}
    assert {name.split(".")[1] for name in names[False] if name.startswith("encoder")} == {
        "actor_encoder",
        "critic_encoder",
    }
    assert {name.split(".")[1] for name in names[True] if name.startswith("encoder")} == {"encoder"}


def advantages(algo, rewards, values_are_zero=True):
    """Advantages and value targets of one terminated episode, from the learner's own pipeline."""
    from ray.rllib.core.learner.training_data import TrainingData
    from ray.rllib.env.single_agent_episode import SingleAgentEpisode

    for layer in linears(module_of(algo).vf):
        nn.init.zeros_(layer.weight)
        nn.init.ones_(layer.bias)  # the value function says 1 everywhere
    length = len(rewards)
    episode = SingleAgentEpisode(
        observations=list(np.zeros((length + 1, 4), np.float32)),
        actions=[0] * length,
        rewards=list(rewards),
        terminated=True,
        extra_model_outputs={"action_logp": [0.0] * length, "action_dist_inputs": [np.zeros(2, np.float32)] * length},
        observation_space=algo.env_runner.env.single_observation_space,
        action_space=algo.env_runner.env.single_action_space,
        len_lookback_buffer=0,
    ).to_numpy()
    batch = learner_of(algo)._make_batch_if_necessary(TrainingData(episodes=[episode]))[MODULE]
    return np.asarray(batch["value_targets"])[:length]


def expected_targets(rewards, gamma, gae_lambda):
    advantage, targets = 0.0, []
    for step in reversed(range(len(rewards))):
        following = 0.0 if step == len(rewards) - 1 else 1.0
        advantage = rewards[step] + gamma * following - 1.0 + gamma * gae_lambda * advantage
        targets.insert(0, advantage + 1.0)
    return targets


@reaches("ppo", field="gamma")
def check_ppo_gamma(build, _):
    for gamma in (0.0, 0.6):
        found = advantages(build("ppo", gamma=gamma), [1.0, 5.0, 2.0])
        np.testing.assert_allclose(found, expected_targets([1.0, 5.0, 2.0], gamma, 0.95), rtol=1e-5)


@reaches("ppo", field="gae_lambda")
def check_gae_lambda(build, _):
    for gae_lambda in (0.0, 0.3):
        found = advantages(build("ppo", gae_lambda=gae_lambda), [1.0, 5.0, 2.0])
        np.testing.assert_allclose(found, expected_targets([1.0, 5.0, 2.0], 0.99, gae_lambda), rtol=1e-5)


@reaches("ppo", field="train_batch_size")
def check_ppo_train_batch_size(build, _):
    algo = build("ppo", train_batch_size=96)
    steps = [env_steps(algo.train()) for _ in range(3)]
    # All sub-environments step together, and one may only reset in the last step.
    assert [96 <= after - before < 98 for before, after in zip([0, *steps], steps, strict=False)] == [True] * 3


@reaches("ppo", field="minibatch_size")
def check_minibatch_size(build, _):
    algo = build("ppo", minibatch_size=16)
    sizes = count_updates(algo)
    algo.train()
    assert set(sizes) == {16}


@reaches("ppo", field="num_epochs")
def check_num_epochs(build, _):
    counts = {}
    for num_epochs in (1, 4):
        algo = build("ppo", num_epochs=num_epochs)
        sizes = count_updates(algo)
        algo.train()
        counts[num_epochs] = sum(sizes)
    # RLlib adds a row an episode chunk for the value after its end, and fills the last minibatch up.
    assert 64 <= counts[1] < 64 + 64
    assert 4 * 64 <= counts[4] < 4 * (64 + 32)
    assert counts[4] > 3 * counts[1] - 32


# -- DQN


def sampled_batches(algo, num_iterations=1):
    """What the loss was computed from, update by update."""
    batches = []
    learner = learner_of(algo)
    update = learner._update

    def spied(batch, *args, **kwargs):
        batches.append({key: value.numpy().copy() for key, value in batch[MODULE].items()})
        return update(batch, *args, **kwargs)

    learner._update = spied
    for _ in range(num_iterations):
        algo.train()
    return batches


@reaches("dqn", field="gamma")
def check_dqn_gamma(build, _):
    algo = build("dqn", gamma=0.5, n_step=3)
    rewards = np.concatenate([batch["rewards"] for batch in sampled_batches(algo, 3)])
    # CartPole gives 1 a step: three steps of it, discounted; fewer at the end of what was sampled.
    assert set(np.round(rewards, 6)) == {1.0, 1.5, 1.75}
    assert np.mean(rewards == 1.75) > 0.5
    assert q_target(algo, next_online=[0.0, 1.0], next_target=[3.0, 2.0], n_step=2) == pytest.approx(0.5**2 * 2.0)


@reaches("dqn", field="n_step")
def check_n_step(build, _):
    batches = sampled_batches(build("dqn", gamma=1.0, n_step=4), 3)
    assert set(np.concatenate([batch["n_step"] for batch in batches])) == {4}
    rewards = np.concatenate([batch["rewards"] for batch in batches])
    assert max(rewards) == np.median(rewards) == 4.0


def q_target(algo, *, next_online, next_target, n_step=1):
    """What Q(s, a) = 0 is moved to for reward 0, given the next state's Q-values; from the Huber loss beyond 1."""
    learner = learner_of(algo)
    batch = {
        "actions": torch.zeros(2, dtype=torch.long),
        "rewards": torch.zeros(2),
        "terminateds": torch.zeros(2),
        "n_step": torch.full((2,), float(n_step)),
        "weights": torch.ones(2),
    }
    out = {
        "qf_preds": torch.zeros(2, 2),
        "qf_next_preds": torch.tensor([next_online] * 2),
        "qf_target_next_preds": torch.tensor([next_target] * 2),
    }
    loss = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=batch, fwd_out=out)
    loss = float(loss)
    return (2 * loss) ** 0.5 if loss < 0.5 else loss + 0.5


@reaches("dqn", field="double_q")
def check_double_q(build, _):
    for double_q, expected in ((True, 2.0), (False, 6.0)):
        algo = build("dqn", double_q=double_q, gamma=1.0)
        # The online network prefers action 0, the target network action 1.
        assert q_target(algo, next_online=[1.0, 0.0], next_target=[2.0, 6.0]) == pytest.approx(expected)


@reaches("dqn", field="dueling")
def check_dueling(build, _):
    obs = torch.randn(5, 4)
    for dueling in (True, False):
        module = module_of(build("dqn", dueling=dueling))
        assert any(name.startswith("vf.") for name in module.state_dict()) == dueling
        raw = module.af(module.encoder({"obs": obs})["encoder_out"])
        q_values = module.compute_q_values({"obs": obs})["qf_preds"]
        if dueling:
            value = module.vf(module.encoder({"obs": obs})["encoder_out"])
            raw = value + raw - raw.mean(dim=1, keepdim=True)
        torch.testing.assert_close(q_values, raw)


@reaches("dqn", field="train_batch_size")
def check_dqn_train_batch_size(build, _):
    batches = sampled_batches(build("dqn", train_batch_size=13))
    assert {len(batch["obs"]) for batch in batches} == {13}


@reaches("dqn", field="env_steps_per_iteration")
def check_env_steps_per_iteration(build, _):
    algo = build("dqn", env_steps_per_iteration=37)
    assert [env_steps(algo.train()) for _ in range(2)] == [37, 74]


@reaches("dqn", field="training_intensity")
def check_training_intensity(build, _):
    # (intensity, sub-environments): updates for 48 env steps, 8 transitions an update
    for intensity, num_envs, expected in ((None, 1, 48), (None, 4, 12), (2.0, 1, 12), (16.0, 4, 96)):
        algo = build("dqn", training_intensity=intensity, env_steps_per_iteration=48, num_envs=num_envs)
        sizes = count_updates(algo)
        steps = env_steps(algo.train())
        assert abs(len(sizes) - expected * steps / 48) <= 1 + 0.1 * expected, (intensity, num_envs, len(sizes), steps)


def test_training_intensity_is_the_same_with_env_runners(build):
    # RLlib counts one sampling process too many, and would make twice the updates.
    values = {"training_intensity": 16.0, "env_steps_per_iteration": 96, "num_envs": 4}
    algo = build("dqn", num_env_runners=1, **values)
    sizes = count_updates(algo)
    steps = env_steps(algo.train())
    assert 14 <= sum(sizes) / steps <= 16


@reaches("dqn", field="adam_epsilon")
def check_adam_epsilon(build, _):
    algo = build("dqn", adam_epsilon=1e-4)
    assert [group["eps"] for group in optimizer_of(algo).param_groups] == [1e-4]


def target_update(algo, num_env_steps):
    """(online, target before, target after) of one weight, when an update ends at so many env steps."""
    module = module_of(algo)
    online, target = module.af.net.mlp[0].weight, module._target_af.net.mlp[0].weight
    with torch.no_grad():
        online += 1.0
    before = target.clone()
    learner_of(algo).after_gradient_based_update(timesteps={"num_env_steps_sampled_lifetime": num_env_steps})
    return online, before, target


@reaches("dqn", field="target_network_update_freq")
def check_target_network_update_freq(build, _):
    algo = build("dqn", target_network_update_freq=70)
    changed = {}
    for num_env_steps in (60, 69, 70, 100, 139, 140):
        _, before, after = target_update(algo, num_env_steps)
        changed[num_env_steps] = not torch.equal(before, after)
    assert changed == {60: False, 69: False, 70: True, 100: False, 139: False, 140: True}


@reaches("dqn", field="tau")
def check_tau(build, _):
    for tau in (0.25, 1.0):
        online, before, after = target_update(build("dqn", tau=tau, target_network_update_freq=1), 10)
        torch.testing.assert_close(after, tau * online + (1 - tau) * before)
        assert not torch.equal(before, after)


@reaches("dqn", field="replay_capacity")
def check_replay_capacity(build, _):
    algo = build("dqn", replay_capacity=60, env_steps_per_iteration=400)
    assert algo.local_replay_buffer.capacity == 60
    algo.train()
    # It drops whole episodes and never the one being added to, so it may be over by one.
    assert algo.local_replay_buffer.get_num_timesteps() < 400 / 2


@reaches("dqn", field="learning_starts")
def check_learning_starts(build, _):
    algo = build("dqn", learning_starts=50)
    sizes = count_updates(algo)
    counts = []
    for _ in range(4):
        algo.train()
        counts.append(len(sizes))
    assert counts == [0, 0, 11, 31]


@reaches("dqn", field="prioritized_replay")
def check_prioritized_replay(build, _):
    from ray.rllib.utils.replay_buffers import EpisodeReplayBuffer, PrioritizedEpisodeReplayBuffer

    for prioritized, kind in ((False, EpisodeReplayBuffer), (True, PrioritizedEpisodeReplayBuffer)):
        algo = build("dqn", prioritized_replay=prioritized)
        assert type(algo.local_replay_buffer) is kind
        batches = sampled_batches(algo, 2)
        weights = np.concatenate([batch["weights"] for batch in batches]) if "weights" in batches[0] else np.ones(1)
        assert bool(np.ptp(weights)) == prioritized


def epsilon_at(algo, num_env_steps):
    schedule = algo.env_runner.module.epsilon_schedule
    schedule.update(num_env_steps)
    return float(schedule.get_current_value())


@reaches("dqn", field="epsilon_initial")
def check_epsilon_initial(build, _):
    assert epsilon_at(build("dqn", epsilon_initial=0.7), 0) == pytest.approx(0.7)


@reaches("dqn", field="epsilon_final")
def check_epsilon_final(build, _):
    algo = build("dqn", epsilon_final=0.2)
    assert [epsilon_at(algo, steps) for steps in (10_000, 50_000)] == pytest.approx([0.2, 0.2])


@reaches("dqn", field="epsilon_decay_steps")
def check_epsilon_decay_steps(build, _):
    algo = build("dqn", epsilon_initial=0.9, epsilon_final=0.1, epsilon_decay_steps=80)
    assert epsilon_at(algo, 40) == pytest.approx(0.5)
    # And it moves on with the env steps of the trial, from one iteration to the next.
    seen = []
    for _ in range(3):
        algo.train()
        seen.append(float(algo.env_runner.module.epsilon_schedule.get_current_value()))
    assert seen == pytest.approx([0.9 - 0.01 * steps for steps in (19, 39, 59)], abs=0.011)


# -- the tests


@pytest.mark.parametrize(("algorithm", "field"), sorted(CASES))
def test_every_hyperparameter_acts(build, algorithm, field):
    CASES[algorithm, field](build, algorithm)


def test_every_hyperparameter_has_a_case():
    """Whoever adds one: build_algorithm_config must hand it on, and a case above must show that it acts."""
    fields = {(name, field) for name, model in HYPERPARAMS_BY_ALGORITHM.items() for field in model.model_fields}
    assert set(CASES) == fields


def test_defaults_are_the_ones_of_the_hyperparameters(build):
    """A field that is left out has the default that its description states, not RLlib's."""
    for algorithm, model in HYPERPARAMS_BY_ALGORITHM.items():
        fields = model.model_fields
        for module in modules_of(build(algorithm, hidden_sizes=fields["hidden_sizes"].default)):
            encoder = module.encoder.actor_encoder if algorithm == "ppo" else module.encoder
            assert [layer.out_features for layer in linears(encoder)] == [64, 64]
            kind = {"tanh": nn.Tanh, "relu": nn.ReLU}[fields["activation"].default]
            assert sum(isinstance(layer, kind) for layer in encoder.modules()) == 2


def test_the_seed_reaches_environment_and_runner(build):
    algo = build("ppo")
    assert algo.env_runner.config.seed == 1024
    assert algo.env_runner._seed == 1024


@pytest.mark.parametrize("num_env_runners", [0, 2])
def test_resources_are_what_the_plan_counts(num_env_runners):
    """Trap: RLlib's default of two env runners makes three CPUs a trial, which a laptop of two never has."""
    from policies.rllib_config import build_algorithm_config

    for hyperparams in (PPOHyperparams(), DQNHyperparams()):
        config = build_algorithm_config(hyperparams, env_id="CartPole-v1", seed=0, num_env_runners=num_env_runners)
        assert (config.num_env_runners, config.num_learners, config.num_cpus_for_main_process) == (
            num_env_runners,
            0,
            1,
        )
        assert config.num_gpus_per_learner == 0
        # A failing env must end the trial: RLlib's restarts of it have no cap.
        assert not config.restart_failed_env_runners
        assert not config.restart_failed_sub_environments
