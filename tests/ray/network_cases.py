"""The cases of the hyperparameters of networks; see `rllib_cases`."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rllib_cases import Build, linears, module_of, modules_of, reaches
from torch import nn

from policies.hyperparams import Algorithm

FILTERS = ((5, 4, 2), (3, 2, 1))


def heads_of(module: Any) -> dict[nn.Linear, float]:
    """{head: gain of its orthogonal weights}"""
    heads = {module.pi: 0.01} if hasattr(module, "pi") else {module.af: 1.0}
    if getattr(module, "vf", None) is not None:
        heads[module.vf] = 1.0
    return heads


@reaches("ppo", "dqn", field="initializer")
def check_initializer(build: Build, algorithm: Algorithm) -> None:
    values = {"hidden_sizes": (40, 30), "activation": "tanh"}
    for initializer in ("torch", "he_uniform", "orthogonal"):
        algo = build(algorithm, initializer=initializer, **values)
        module = module_of(algo)
        heads = heads_of(module)
        layers = [*linears(module.encoder), *heads]
        assert len(layers) >= 4
        for layer in layers:
            weight, fan_in = layer.weight.detach(), layer.in_features
            assert bool((layer.bias == 0).all()) == (initializer != "torch")
            largest = float(weight.abs().max())
            if initializer == "torch":
                assert largest <= 1.001 / fan_in**0.5
            elif initializer == "he_uniform":
                assert 0.6 * (6 / fan_in) ** 0.5 < largest <= 1.001 * (6 / fan_in) ** 0.5
            else:
                gain = heads.get(layer, 5 / 3)
                singular_values = torch.linalg.svdvals(weight).numpy()
                np.testing.assert_allclose(singular_values, gain, rtol=1e-4)
        acting = algo.env_runner.module.state_dict()
        assert all(torch.equal(value, module.state_dict()[name]) for name, value in acting.items())
        for online, target in module.get_target_network_pairs() if algorithm == "dqn" else ():
            assert all(map(torch.equal, online.state_dict().values(), target.state_dict().values()))
    gains = {}
    for activation in ("linear", "relu"):
        module = module_of(build(algorithm, initializer="orthogonal", **{**values, "activation": activation}))
        gains[activation] = float(torch.linalg.svdvals(linears(module)[0].weight.detach())[0])
    assert gains == pytest.approx({"linear": 1.0, "relu": 2**0.5}, rel=1e-4)


@reaches("ppo", "dqn", field="conv_filters")
def check_conv_filters(build: Build, algorithm: Algorithm) -> None:
    algo = build(algorithm, "TestShades-v0", conv_filters=FILTERS, activation="relu", initializer="he_uniform")
    for module in modules_of(algo):
        encoder = module.encoder["actor_encoder"] if algorithm == "ppo" else module.encoder
        kinds = [type(layer) for layer in encoder.conv]
        assert kinds == [nn.Conv2d, nn.ReLU] * 2
        convs = [layer for layer in encoder.conv if isinstance(layer, nn.Conv2d)]
        found = tuple((conv.out_channels, *conv.kernel_size[:1], *conv.stride[:1]) for conv in convs)
        assert found == FILTERS
        # 12 x 9 -> 5 x 3 -> 4 x 2 pixels of 3 channels.
        assert linears(encoder)[0].in_features == 4 * 2 * 3
    module = module_of(algo)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    algo.train()
    for name, value in module.state_dict().items():
        if ".conv." in name and "target" not in name:
            assert not torch.equal(value, before[name]), name


@reaches("ppo", field="free_log_std")
def check_free_log_std(build: Build, algorithm: Algorithm) -> None:
    observations = torch.randn(32, 3, generator=torch.Generator().manual_seed(0))
    for free in (False, True):
        algo = build(algorithm, "Pendulum-v1", free_log_std=free, lr=0.01)
        for trained in (False, True):
            for module in modules_of(algo):
                with torch.no_grad():
                    outputs = module.forward_inference({"obs": observations})["action_dist_inputs"]
                log_stds = outputs[:, 1]
                assert bool((log_stds == log_stds[0]).all()) is free
                # The portable policy and packs read the whole layer.
                assert bool((module.pi.weight[1] == 0.0).all()) is free
                if free:
                    assert bool(log_stds[0] == module.pi.bias[1])
                    assert bool(log_stds[0] == 0.0) is not trained
            algo.train()


@reaches("ppo", "dqn", field="normalize_observations")
def check_normalize_observations(build: Build, algorithm: Algorithm) -> None:
    plain = module_of(build(algorithm, normalize_observations=False))
    assert not [name for name in plain.state_dict() if name.startswith("obs_")]
    algo = build(algorithm, normalize_observations=True)
    module, seen = module_of(algo), []
    update = module.update_observation_statistics

    def spied(observations: NDArray[Any]) -> None:
        seen.append(np.asarray(observations).copy())
        update(observations)

    module.update_observation_statistics = spied
    for _ in range(2):
        algo.train()
    observations = np.concatenate(seen)
    assert len(observations) == int(module.obs_count) > 30
    np.testing.assert_allclose(module.obs_mean, observations.mean(axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(module.obs_var, observations.var(axis=0), rtol=1e-4)
    for name in ("obs_mean", "obs_var", "obs_count"):
        assert torch.equal(algo.env_runner.module.state_dict()[name], module.state_dict()[name])
    # And the networks see them: raw observations, in a network without statistics, give the same outputs.
    scaled = (observations - observations.mean(axis=0)) / np.sqrt(observations.var(axis=0) + 1e-8)
    assert np.abs(scaled).max() < 10
    raw, scaled = (torch.from_numpy(np.asarray(value, np.float32)) for value in (observations, scaled))
    without = {name: value for name, value in module.state_dict().items() if not name.startswith("obs_")}
    if algorithm == "dqn":
        plain.make_target_networks()
    plain.load_state_dict(without)
    ours, theirs = (net._forward_train({"obs": obs, "new_obs": obs}) for net, obs in ((module, raw), (plain, scaled)))
    keys = ["action_dist_inputs", "embeddings"] if algorithm == "ppo" else list(theirs)
    assert len(keys) >= 2
    for key in keys:
        # Variances that are near 0 make observations that differ in the last place differ more when they are scaled.
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-3, atol=1e-4)
    if algorithm == "ppo":
        values = module.compute_values({"obs": raw}), plain.compute_values({"obs": scaled})
        torch.testing.assert_close(*values, rtol=1e-3, atol=1e-4)
