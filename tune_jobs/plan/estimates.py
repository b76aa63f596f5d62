"""Estimate upper bounds of a trial's env steps, of what it writes to disk, and of its memory."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from policies.envs.images import SeenImage
from policies.envs.masks import seen_by_networks
from policies.envs.own_actions import sizes_of
from policies.envs.spaces import observation_dtype
from policies.hyperparams import DQNHyperparams, Hyperparams, PPOHyperparams, RandomHyperparams
from policies.iteration_length import iteration_length
from policies.portable.convolution import output_shape

if TYPE_CHECKING:
    from policies.envs.make import EnvInfo
    from tune_jobs.spec.sections import StopSpec
    from tune_jobs.spec.sweep_spec import SweepSpec

# The sizes of an RLlib checkpoint without its weights, and of a line of results with its TensorBoard scalars; they
# were measured with Ray 2.60 and rounded up.
_CHECKPOINT_BASE_BYTES = 250_000
_ITERATION_BYTES = 10_000
_BYTES_PER_NUMBER = 4
# The copies of the weights: the network, its copy for sampling, DQN's target network, and Adam's two moments.
_COPIES_OF_WEIGHTS = 6
# The copies of a train batch: as sampled, in the order of its minibatches, and in a gradient step.
_COPIES_OF_BATCH = 3
# The numbers of an env step besides the observation: action, reward, ends, value, advantage, target, distribution.
_NUMBERS_PER_STEP = 12


def max_env_steps(spec: SweepSpec, values: Hyperparams) -> int:
    """Return the most env steps of one trial, which ends with the iteration in which it reaches its cap."""
    return most_env_steps_until(spec.stop, values, spec.resources.num_env_runners)


def most_env_steps_until(stop: StopSpec, values: Hyperparams, num_env_runners: int) -> int:
    """Return the most env steps of a trial with these rules of when it ends; see `max_env_steps`."""
    iteration = _most_of_an_iteration(values, max(1, num_env_runners))
    return min(stop.num_env_steps - 1 + iteration, stop.num_iterations * iteration)


def planned_env_steps(spec: SweepSpec, values: Hyperparams) -> int:
    """Return the env steps after which a trial ends at the latest; its last iteration may go beyond."""
    return min(spec.stop.num_env_steps, spec.stop.num_iterations * iteration_env_steps(values))


def max_iterations(spec: SweepSpec, values: Hyperparams) -> int:
    """Return the most iterations of one trial."""
    return min(spec.stop.num_iterations, math.ceil(spec.stop.num_env_steps / iteration_env_steps(values)))


def _most_of_an_iteration(values: Hyperparams, num_runners: int) -> int:
    """Return the most env steps of one iteration; all sub-environments step together, so the last step overshoots."""
    wanted = asked_env_steps(values)
    if isinstance(values, DQNHyperparams):
        # An iteration ends with a sampling phase, in which each env runner makes its share of train_freq.
        return wanted - 1 + num_runners * (math.ceil(values.train_freq / num_runners) - 1 + values.num_envs)
    together = values.num_envs * num_runners
    return (math.ceil(wanted / together) + 1) * together


def iteration_env_steps(values: Hyperparams) -> int:
    """Return the env steps that an iteration has at least, in whole steps of all of its sub-environments."""
    return iteration_length(vars(values)) or asked_env_steps(values)


def asked_env_steps(values: Hyperparams) -> int:
    """Return the env steps that an iteration is to have, which its whole steps may go beyond."""
    return values.train_batch_size if isinstance(values, PPOHyperparams) else values.env_steps_per_iteration


def max_disk_bytes(spec: SweepSpec, env: EnvInfo, values: Hyperparams) -> int:
    """Estimate the most bytes that one trial's folder holds."""
    iterations = max_iterations(spec, values)
    checkpoint = _CHECKPOINT_BASE_BYTES + _num_weights(env, values) * _BYTES_PER_NUMBER * _COPIES_OF_WEIGHTS
    # The newest and the best; and in a population a copy of another trial's.
    kept = min(max(1, spec.checkpoints.keep) + 1, iterations) + spec.scheduler.is_population
    # There is one checkpoint more while a new one is written and the old one is not yet deleted.
    return (kept + 1) * checkpoint + iterations * _ITERATION_BYTES


def trial_bytes(env: EnvInfo, values: Hyperparams, num_env_steps: int | None = None) -> int:
    """Estimate the memory of one trial, in bytes: weights, train batch and replay memory, without its process's own.

    Args:
        env: Its environment.
        values: Its hyperparameters.
        num_env_steps: Its most env steps, of which a replay memory holds no more transitions; None: any number.
    """
    # Images stay bytes.
    itemsize = np.dtype(observation_dtype(env.observation_space)).itemsize
    observation = math.prod(env.observation_space.shape or ()) * itemsize
    hidden = 0 if isinstance(values, RandomHyperparams) else 2 * sum(values.hidden_sizes) * _BYTES_PER_NUMBER
    windows = _numbers_of_convolutions(env, values) * _BYTES_PER_NUMBER
    total = _num_weights(env, values) * _COPIES_OF_WEIGHTS * _BYTES_PER_NUMBER
    if isinstance(values, PPOHyperparams):
        step = _COPIES_OF_BATCH * (observation + _NUMBERS_PER_STEP * _BYTES_PER_NUMBER) + hidden
        total += values.train_batch_size * step + values.minibatch_size * 2 * windows
    elif isinstance(values, DQNHyperparams):
        # The observations before and after, the action (8 bytes), reward and discount.
        transition = 2 * observation + 4 * _BYTES_PER_NUMBER
        total += values.train_batch_size * (_COPIES_OF_BATCH * transition + hidden + windows)
        held = values.replay_capacity if num_env_steps is None else min(values.replay_capacity, num_env_steps)
        total += (0 if values.replay == "none" else held) * transition
        if values.replay == "prioritized":
            # A tree of sums, two nodes of 8 bytes per transition, whose number is rounded up to a power of 2.
            total += 16 * (1 << (held - 1).bit_length())
    return total


def products_per_image(image: SeenImage, values: Hyperparams) -> int:
    """Return the multiplications of a network, but for its head's, for an observation with an image."""
    if isinstance(values, RandomHyperparams) or values.conv_filters is None:
        return 0
    products = 0
    for number, (channels, kernel, _) in enumerate(values.conv_filters):
        inputs = output_shape(image.shape, values.conv_filters[:number])[2]
        height, width, _ = output_shape(image.shape, values.conv_filters[: number + 1])
        products += height * width * kernel**2 * inputs * channels
    sizes = [math.prod(output_shape(image.shape, values.conv_filters)) + image.num_beside, *values.hidden_sizes]
    return products + sum(inputs * outputs for inputs, outputs in itertools.pairwise(sizes))


def _numbers_of_convolutions(env: EnvInfo, values: Hyperparams) -> int:
    """Return the numbers that the convolutions of one network keep of an image: the windows of kernels, and outputs."""
    if isinstance(values, RandomHyperparams) or values.conv_filters is None or env.image is None:
        return 0
    shape, numbers = env.image.shape, 0
    for number, (channels, kernel, _) in enumerate(values.conv_filters):
        inputs = output_shape(shape, values.conv_filters[:number])[2]
        height, width, _ = output_shape(shape, values.conv_filters[: number + 1])
        numbers += height * width * (kernel**2 * inputs + 2 * channels)
    return numbers


def _num_weights(env: EnvInfo, values: Hyperparams) -> int:
    if isinstance(values, RandomHyperparams):
        return 0
    space: Any = env.action_space
    num_outputs = 2 * (sum(sizes_of(space)) or math.prod(space.shape or ()))
    shape, num_beside = tuple(seen_by_networks(env.observation_space).shape or ()), 0
    weights = 0
    if values.conv_filters is not None and env.image is not None:
        shape, num_beside = env.image.shape, env.image.num_beside
        channels = [shape[-1], *(item[0] for item in values.conv_filters)]
        for (inputs, outputs), (_, kernel, _) in zip(itertools.pairwise(channels), values.conv_filters, strict=True):
            weights += (inputs * kernel**2 + 1) * outputs
        shape = output_shape(shape, values.conv_filters)
    sizes = [math.prod(shape) + num_beside, *values.hidden_sizes, num_outputs + 1]
    weights += sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
    networks = 1 if isinstance(values, DQNHyperparams) else 2  # PPO: policy and value function
    return networks * weights
