"""Names of Stable-Baselines3 and RLlib: each leads to one of ours that exists, and is answered with it."""

import json
from typing import Any, get_args

import pytest
from click.testing import CliRunner
from spec_errors import MINIMAL, errors

from policies.foreign_names import FOREIGN_NAMES
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm, PPOHyperparams
from tune_jobs.cli.commands import cli
from tune_jobs.spec.hyperparam_table import hyperparam_table, range_text

ALGORITHMS: tuple[Algorithm, ...] = get_args(Algorithm)
DQN = {**MINIMAL, "algorithm": "dqn"}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_table_of_names_is_whole(algorithm: Algorithm) -> None:
    fields = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    for foreign in FOREIGN_NAMES[algorithm]:
        assert set(foreign.ours) <= fields.keys(), foreign
        assert foreign.ours or foreign.difference, foreign
        if foreign.name in fields:
            # A name of ours that means something else there is told in the table alone: it can't be an error.
            assert foreign.name in foreign.ours, foreign
    names = [(foreign.library, foreign.name) for foreign in FOREIGN_NAMES[algorithm]]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("section", ["hyperparams", "space"])
@pytest.mark.parametrize(
    ("name", "answer"),
    [
        (
            "n_steps",
            (
                "Did you mean 'train_batch_size'? That is SB3's n_steps; it counts each environment's steps: "
                "train_batch_size is n_steps x n_envs."
            ),
        ),
        ("ent_coef", "Did you mean 'entropy_coeff'? That is SB3's ent_coef."),
        ("clip_range", "Did you mean 'clip_param'? That is SB3's clip_range"),
        ("batch_size", "Did you mean 'minibatch_size'? That is SB3's batch_size."),
        ("learning_rate", "Did you mean 'lr'? That is SB3's learning_rate; a schedule from a to b"),
        ("vf_coef", "Did you mean 'vf_loss_coeff'? That is SB3's vf_coef."),
        ("max_grad_norm", "Did you mean 'grad_clip'? That is SB3's max_grad_norm."),
        ("n_epochs", "Did you mean 'num_epochs'? That is SB3's n_epochs."),
        ("norm_reward", "Did you mean 'normalize_rewards'? That is SB3's norm_reward; of VecNormalize"),
        ("normalize", "Did you mean 'normalize_observations' and 'normalize_rewards'?"),
        ("train_batch_size_per_learner", "Did you mean 'train_batch_size'? That is RLlib's train_batch_size_per_le"),
        ("lambda_", "Did you mean 'gae_lambda'? That is RLlib's lambda_."),
        ("clip_range_vf", "Did you mean 'vf_clip_range'? That is SB3's clip_range_vf; SB3 counts the limited value's"),
        ("normalize_advantage", "Did you mean 'normalize_advantages'? That is SB3's normalize_advantage; over the"),
        ("target_kl", "SB3's target_kl is no hyperparameter here: it ends an iteration's epochs early"),
        ("total_timesteps", "SB3's total_timesteps is no hyperparameter here: set stop.num_env_steps."),
        ("buffer_size", "(dqn has it: SB3's buffer_size is replay_capacity there.)"),
        ("train_freq", "(dqn has it.)"),
    ],
)
def test_a_foreign_name_under_ppo_is_answered_with_ours(section: str, name: str, answer: str) -> None:
    fields: dict[str, Any] = {section: {name: 3 if section == "hyperparams" else {"grid": [1, 2]}}}
    message = errors(**fields)
    assert message.startswith(f"sweep: {section}.{name}: ppo has no hyperparameter {name!r}. {answer}")


@pytest.mark.parametrize(
    ("name", "answer"),
    [
        ("batch_size", "Did you mean 'train_batch_size'? That is SB3's batch_size."),
        ("buffer_size", "Did you mean 'replay_capacity'? That is SB3's buffer_size."),
        ("n_steps", "Did you mean 'n_step'? That is SB3's n_steps."),
        ("exploration_fraction", "epsilon_decay is in env steps: exploration_fraction x SB3's total_timesteps"),
        ("gradient_steps", "updates_per_env_step is gradient_steps / (SB3's train_freq x n_envs)"),
        ("training_intensity", "updates_per_env_step is training_intensity / train_batch_size"),
        ("rollout_fragment_length", "train_freq is rollout_fragment_length x num_envs x env runners"),
        ("epsilon", "Did you mean 'epsilon_initial' and 'epsilon_decay' and 'epsilon_final'?"),
        ("normalize", "Did you mean 'normalize_observations'? That is SB3's normalize; of RL Zoo; rewards are"),
        ("norm_reward", "(ppo has it: SB3's norm_reward is normalize_rewards there.)"),
        ("clip_range", "(ppo has it: SB3's clip_range is clip_param there.)"),
        ("num_epochs", "(ppo has it.)"),
        ("noisy", "RLlib's noisy is no hyperparameter here: there are no noisy networks"),
    ],
)
def test_a_foreign_name_under_dqn_is_answered_with_ours(name: str, answer: str) -> None:
    assert answer in errors(base=DQN, hyperparams={name: 1})


def test_dqns_target_network_is_updated_by_the_name_of_the_field() -> None:
    # The model has a property of SB3's name, which is no field.
    answer = (
        "Did you mean 'target_update_freq'? That is SB3's target_update_interval; SB3 updates it between training "
        "phases alone: target_update_freq is at least SB3's train_freq x n_envs."
    )
    assert answer in errors(base=DQN, hyperparams={"target_update_interval": 1})


@pytest.mark.parametrize(
    ("library", "name", "difference"),
    [
        ("SB3", "tau", "tau to 1 - (1 - SB3's tau) ^ (target_update_freq / target_update_interval)"),
        ("RLlib", "tau", "set target_update_freq, without which a tau below 1 acts after each update"),
        ("RLlib", "target_network_update_freq", "rounded up to a multiple of train_freq"),
        ("SB3", "learning_starts", "SB3's actions are all random until then"),
    ],
)
def test_dqns_names_that_mean_something_else_there_are_told(library: str, name: str, difference: str) -> None:
    (found,) = [row for row in FOREIGN_NAMES["dqn"] if (row.library, row.name) == (library, name)]
    assert difference in found.difference
    assert difference in " ".join(run("dqn").split())


def test_a_foreign_name_in_set_is_answered_too() -> None:
    assert "Did you mean 'entropy_coeff'?" in errors(overrides=["hyperparams.ent_coef=0.01"])
    assert "Did you mean 'entropy_coeff'?" in errors(overrides=["space.ent_coef={uniform: [0, 0.01]}"])
    assert "Did you mean 'entropy_coeff'?" in errors(overrides=["space.ent_coef={unifrom: [0, 0.01]}"])


# -- the command


def test_every_hyperparameter_is_listed_with_what_the_model_says() -> None:
    table = hyperparam_table("ppo")
    assert [row.name for row in table.hyperparams] == list(PPOHyperparams.model_fields)
    rows = {row.name: row for row in table.hyperparams}
    assert (rows["lr"].default, rows["lr"].values) == (3e-4, "number > 0")
    assert rows["lr"].meaning == PPOHyperparams.model_fields["lr"].description
    assert rows["num_envs"].values == "whole number from 1 to 512"
    assert rows["activation"].values.startswith("linear, relu")
    assert rows["hidden_sizes"].values == "whole number ≥ 1 or list of: whole number ≥ 1"
    assert [(row.library, row.name) for row in rows["gae_lambda"].elsewhere] == [
        ("SB3", "gae_lambda"), ("RLlib", "lambda_"), ("RLlib", "lambda"),
    ]  # fmt: skip


def test_a_limit_that_is_left_out_is_told() -> None:
    rows = {row.name: row for row in hyperparam_table("dqn").hyperparams}
    assert rows["adam_beta1"].values == "number ≥ 0, < 1"
    assert rows["tau"].values == "number > 0, ≤ 1"
    assert range_text({"type": "number"}) == ""


def run(*arguments: str) -> str:
    result = CliRunner().invoke(cli, ["hyperparams", *arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_command_lists_one_algorithm(algorithm: Algorithm) -> None:
    lines = run(algorithm).splitlines()
    for name, field in HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields.items():
        assert any(line.startswith(f"{name}: ") for line in lines), name
        assert present_words(field.description) <= set(" ".join(lines).split())
    (table,) = json.loads(run(algorithm, "--json"))
    assert table["algorithm"] == algorithm


def present_words(text: str | None) -> set[str]:
    assert text
    return set(text.split())


def test_the_command_lists_all_algorithms_and_names_differences() -> None:
    text = run()
    for algorithm in ALGORITHMS:
        assert f"Hyperparameters of {algorithm}\n" in text
    assert "    Stable-Baselines3: n_steps (it counts each environment's steps: " in text
    assert "SB3: target_kl: it ends an iteration's epochs early" in text
    assert [table["algorithm"] for table in json.loads(run("--json"))] == list(ALGORITHMS)


def test_an_unknown_algorithm_names_the_nearest() -> None:
    result = CliRunner().invoke(cli, ["hyperparams", "pppo"])
    assert result.exit_code == 2
    assert "There is no algorithm 'pppo'. Did you mean 'ppo'?" in result.stderr
