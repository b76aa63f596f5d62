"""Turn RLlib's weights into a portable policy, and restore RLlib checkpoints as an `Algorithm`.

A restore succeeds with exactly the weights that were saved, or raises an error. RLlib's own `from_checkpoint` only
warns when a module class cannot be imported or a key is missing, and continues with fresh weights.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core import DEFAULT_MODULE_ID

from policies.acting.policy import action_transform
from policies.errors import CheckpointError, TuneJobsError
from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks.portable_weights import check_scale, network_from_weights, normalization_in
from policies.networks.rl_modules import RL_MODULE_KEY, import_module_class
from policies.portable.file import (
    ModuleWeights,
    PolicyNetwork,
    PortablePolicy,
    describe_space,
)
from policies.rllib.old_names import old_names

Weights = Mapping[str, NDArray[Any]]

_RESTORE_HINT = "Use another checkpoint of the trial; training cannot continue from this one."


def _module_network(algorithm: Algorithm, class_path: str) -> PolicyNetwork:
    """Return what a module of the user's own is rebuilt from, with the weights that acting needs."""
    module = _modules(algorithm)["learner"]
    weights = ModuleWeights(class_path, dict(module.model_config), module.get_state(inference_only=True))
    return PolicyNetwork(kind="module", layers=(), module=weights)


def portable_policy(
    algorithm: Algorithm,
    hyperparams: TrainedHyperparams,
    *,
    env_id: str,
    env_args: dict[str, Any],
    training: dict[str, Any] | None = None,
) -> PortablePolicy:
    """Return the greedy policy of a running Algorithm, with all that it needs to act without RLlib.

    Raises:
        CheckpointError: Its network is not the one the hyperparameters describe.
    """
    module = algorithm.get_module()
    observation_space, action_space = module.observation_space, module.action_space
    class_path = module.model_config.get(RL_MODULE_KEY)
    if class_path is None:
        network = network_from_weights(learner_weights(algorithm), hyperparams, observation_space, action_space)
    else:
        network = _module_network(algorithm, class_path)
    return PortablePolicy(
        network=network,
        algorithm="ppo" if isinstance(hyperparams, PPOHyperparams) else "dqn",
        env_id=env_id,
        env_args=env_args,
        observation_space=describe_space(observation_space),
        action_space=describe_space(action_space),
        action_transform=action_transform(action_space),
        training=training or {},
    )


def learner_weights(algorithm: Algorithm) -> dict[str, NDArray[Any]]:
    """Return the learner's weights of its only RLModule, as NumPy arrays."""
    weights: dict[str, NDArray[Any]] = algorithm.learner_group.get_weights()[DEFAULT_MODULE_ID]
    return weights


def restore_algorithm(
    rllib_checkpoint: Path, expected: PolicyNetwork | None = None, *, max_env_runners: int | None = None
) -> Algorithm:
    """Restore an RLlib checkpoint as an `Algorithm` that can continue training.

    RLlib's checkpoints are pickles: restore only what you trust. Callers check the manifest's hashes first.
    What was trained on a GPU goes on on the CPU where PyTorch sees none.

    Args:
        rllib_checkpoint: The folder RLlib's `save_to_path` wrote.
        expected: The network that was saved beside it; the restored weights must be equal to it.
        max_env_runners: The most env runners that there are CPUs for: what had more samples in this process. None: as
            many as it had, for which RLlib waits without an end where there are no CPUs for them.

    Raises:
        CheckpointError: RLlib cannot restore it, or the weights are not the expected ones.
    """
    if expected is not None and expected.module is not None:
        # Imported before RLlib does: RLlib would use another class if this one is missing.
        import_module_class(expected.module.class_path)
    try:
        with old_names():
            place = str(rllib_checkpoint.absolute())
            algorithm = Algorithm.from_checkpoint(place, **_settings_of_this_machine(rllib_checkpoint, max_env_runners))
    except Exception as error:
        raise CheckpointError(f"RLlib cannot restore {rllib_checkpoint}: {error!r}.", _RESTORE_HINT) from error
    try:
        _check_module_classes(algorithm)
        if expected is not None:
            check_weights(algorithm, expected)
    except TuneJobsError as error:
        algorithm.stop()
        raise CheckpointError(f"{rllib_checkpoint}: {error.message}", _RESTORE_HINT) from error
    if algorithm.config.sample_timeout_s is not None:
        # Written before samples had no limit.
        config = algorithm.config.copy(copy_frozen=False)
        config.env_runners(sample_timeout_s=None)
        config.freeze()
        algorithm.config = config
    _send_weights(algorithm)
    return algorithm


def _settings_of_this_machine(rllib_checkpoint: Path, max_env_runners: int | None) -> dict[str, Any]:
    """Return the config to restore a checkpoint with, if it can't be the saved one as that asks for what isn't here."""
    has_gpu = torch.cuda.is_available()
    if has_gpu and max_env_runners is None:
        return {}
    # What RLlib itself makes the Algorithm of.
    made_of = pickle.loads((rllib_checkpoint / Algorithm.CLASS_AND_CTOR_ARGS_FILE_NAME).read_bytes())  # noqa: S301
    (saved,), _ = made_of["ctor_args_and_kwargs"]
    others = {}
    if saved["num_gpus_per_learner"] and not has_gpu:
        others["num_gpus_per_learner"] = 0
    if max_env_runners is not None and saved["num_env_runners"] > max_env_runners:
        others["num_env_runners"] = 0
    return {"config": {**saved, **others}} if others else {}


def take_over_state(algorithm: Algorithm, rllib_checkpoint: Path, expected: PolicyNetwork) -> None:
    """Give a new Algorithm the state of a checkpoint, but keep the Algorithm's own settings.

    Weights, target networks, observation statistics, the optimizer's moments and the counters are the checkpoint's.
    Learning rate, betas and the like stay the Algorithm's, although RLlib's optimizer state has the old ones (2.60).

    Args:
        algorithm: A new one, with networks of the same shapes. It is stopped if this fails.
        rllib_checkpoint: The folder RLlib's `save_to_path` wrote; a pickle, as in `restore_algorithm`.
        expected: The network that was saved beside it.

    Raises:
        CheckpointError: RLlib cannot restore it, or the weights are not the expected ones.
    """
    settings = [
        {name: value for name, value in group.items() if name != "params"} for group in _optimizer_groups(algorithm)
    ]
    try:
        with old_names():
            algorithm.restore_from_path(str(rllib_checkpoint.absolute()))
        for group, own in zip(_optimizer_groups(algorithm), settings, strict=True):
            group.update(own)
        check_weights(algorithm, expected)
        _send_weights(algorithm)
    except TuneJobsError as error:
        algorithm.stop()
        raise CheckpointError(f"{rllib_checkpoint}: {error.message}", _RESTORE_HINT) from error
    except Exception as error:
        algorithm.stop()
        raise CheckpointError(f"RLlib cannot restore {rllib_checkpoint}: {error!r}.", _RESTORE_HINT) from error


def _send_weights(algorithm: Algorithm) -> None:
    """Send the learner's weights to env runners in other processes, once more.

    RLlib (2.60) sends a new Algorithm's weights and those of a restore one after the other, and drops the second where
    the first have not arrived: the runner would sample with an untrained policy.
    """
    group = algorithm.env_runner_group
    if not group.num_remote_env_runners():
        return
    # Calls are done in their order: what was sent before has arrived when this one is answered.
    group.foreach_env_runner(_nothing, local_env_runner=False)
    group.sync_weights(from_worker_or_learner_group=algorithm.learner_group, inference_only=True)


def _nothing(_: Any) -> None:
    """Be answered."""


def _optimizer_groups(algorithm: Algorithm) -> list[dict[str, Any]]:
    """Return the optimizer's parameter groups, each with its settings, as in torch."""
    learner = algorithm.learner_group._learner  # noqa: SLF001 - RLlib has no public way to the local one
    return [group for _, item in learner.get_optimizers_for_module(DEFAULT_MODULE_ID) for group in item.param_groups]


def _modules(algorithm: Algorithm) -> dict[str, Any]:
    """Return the RLModules of this process: the learner's, and the env runner's if it is here."""
    modules = {"learner": algorithm.learner_group._learner.module[DEFAULT_MODULE_ID]}  # noqa: SLF001
    runner = algorithm.env_runner
    if runner is not None and runner.module is not None:
        modules["env runner"] = runner.module
    return modules


def _check_module_classes(algorithm: Algorithm) -> None:
    for source, module in _modules(algorithm).items():
        class_path = module.model_config.get(RL_MODULE_KEY)
        if class_path is not None and type(module) is not import_module_class(class_path):
            raise CheckpointError(
                f"the restored {source} has a module of class {type(module).__name__}, but {class_path} was saved.",
                _RESTORE_HINT,
            )


def check_weights(algorithm: Algorithm, expected: PolicyNetwork) -> None:
    """Check that an Algorithm's learner and its env runner have exactly a network's weights.

    Raises:
        CheckpointError: They differ, or networks see observations times another factor.
    """
    modules = _modules(algorithm)
    for module in modules.values():
        check_scale(module.observation_space, expected)
    sources = {source: module.get_state() for source, module in modules.items()}
    for source, weights in sources.items():
        held = {np.asarray(value).tobytes() for value in weights.values()}
        if "obs_mean" in weights:
            normalization = normalization_in(weights)
            held |= {normalization.mean.tobytes(), normalization.std.tobytes()}
        for place, arrays in expected.parts().items():
            if any(array.tobytes() not in held for array in arrays):
                raise CheckpointError(
                    f"the restored {source} does not hold the saved weights of {place}.", _RESTORE_HINT
                )
