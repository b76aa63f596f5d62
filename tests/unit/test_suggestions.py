"""The name that was probably meant: one rule for fields, domains, presets, sweeps, environments and their arguments."""

import pytest

from policies.suggestions import did_you_mean


@pytest.mark.parametrize(
    ("name", "known", "expected"),
    [
        ("gama", ["gamma", "lr"], " Did you mean 'gamma'?"),
        ("CartPole-PPO", ["cartpole-ppo", "lunar"], " Did you mean 'cartpole-ppo'?"),
        ("environment", ["env", "seed"], " Did you mean 'env'?"),
        ("ENVIRONMENT", ["env", "seed"], " Did you mean 'env'?"),
        ("epochs", ["num_epochs", "lr"], " Did you mean 'num_epochs'?"),
        ("lr", ["learning_starts", "gamma"], ""),
        (7, ["gamma", "lr"], ""),
        ("x", [], ""),
    ],
)
def test_the_nearest_name(name: int | str, known: list[str], expected: str) -> None:
    assert did_you_mean(name, known) == expected


def test_several_that_are_near() -> None:
    known = ["Ant-v4", "Ant-v5", "Hopper-v5"]
    assert did_you_mean("ant-v3", known, at_most=3, cutoff=0.7) == " Did you mean 'Ant-v5' or 'Ant-v4'?"
    assert did_you_mean("ant-v3", known, at_most=3, cutoff=0.9) == ""
