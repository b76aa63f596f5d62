"""Sweep files with what TOML, Python or Ray Tune have, or without YAML's space: what each is answered with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from ray import tune

from policies.errors import SpecError
from tune_jobs.spec.file import load_spec

MINIMAL = {"env": "CartPole-v1", "algorithm": "ppo"}


def refused(tmp_path: Path, text: str) -> SpecError:
    file = tmp_path / "sweep.yaml"
    file.write_text(text)
    with pytest.raises(SpecError) as caught:
        load_spec(file)
    return caught.value


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        (
            'env = "CartPole-v1"\nalgorithm = "ppo"\n',
            "holds one text",
            "the line 'env = \"CartPole-v1\"' is",
        ),
        ('# mine\n\n[env]\nid = "CartPole-v1"\n', "line 4", "the line '[env]' is of another language"),
        ("env:CartPole-v1\nalgorithm:ppo\n", "holds one text", "Write a space after the colon, env: CartPole-v1."),
        ("env:CartPole-v1\nalgorithm: ppo\n", "line 2", "In line 1, write a space after the colon, env: CartPole-v1."),
        (
            "# mine\nalgorithm: ppo\nenv:x-v1\n",
            "could not find",
            "In line 3, write a space after the colon, env: x-v1.",
        ),
        ("- env: CartPole-v1\n- algorithm: ppo\n", "holds a list", "Write the fields without dashes before them"),
        ("CartPole-v1\n", "holds one text", "`tune-jobs schema` prints every field"),
        ("env: [x\nalgorithm: ppo\n", "while parsing", "Correct the YAML there."),
        ("5\n", "holds one value", "`tune-jobs schema` prints every field"),
    ],
)
def test_a_file_of_another_language_is_answered_with_what_to_write(
    tmp_path: Path, text: str, message: str, hint: str
) -> None:
    error = refused(tmp_path, text)
    assert message in error.message
    assert hint in error.hint


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("space: {lr: (1e-4, 1e-2)}", "line 4: YAML has no (1e-4, 1e-2): write [1e-4, 1e-2]"),
        ("hyperparams:\n  hidden_sizes: ( 64,64, )", "line 5: YAML has no ( 64,64, ): write [64,64]"),
        ("space: {gamma: {uniform: (.9, 0.99)}}", "line 4: YAML has no (.9, 0.99): write [.9, 0.99]"),
        ("space: {hidden_sizes: {grid: [(64,), (32, 32)]}}", "line 4: YAML has no (64,): write [64]"),
    ],
)
def test_numbers_in_parentheses_are_told_before_what_they_lead_to(tmp_path: Path, line: str, told: str) -> None:
    error = refused(tmp_path, f"# sizes (1, 2)\nenv: CartPole-v1\nalgorithm: ppo # (3)\n{line}\n")
    assert error.message.split("\n  ")[1] == told


def test_parentheses_that_are_meant_are_no_problem(tmp_path: Path) -> None:
    file = tmp_path / "sweep.yaml"
    file.write_text("env: CartPole-v1\nalgorithm: ppo\nabout: Two sizes (64, 64)\n")
    assert load_spec(file).about.title == "Two sizes (64, 64)"
    assert "YAML has no" not in refused(tmp_path, "env: CartPole-v1\nalgorithm: ppx\nabout: Two (a, b)\n").message


@pytest.mark.parametrize("source", ["Schulman et al. (2017)", "Two sizes (64, 64)", "Sizes (64,)"])
def test_numbers_of_a_title_are_none_of_another_field_s_problem(tmp_path: Path, source: str) -> None:
    text = f"env: CartPole-v1\nalgorithm: ppo\nnum_samples: -1\nabout: {{title: 'PPO', source: '{source}'}}\n"
    assert refused(tmp_path, text).message == ("sweep.yaml: num_samples: -1 is not allowed: it should be at least 1")


@pytest.mark.parametrize("section", ["space", "hyperparams"])
@pytest.mark.parametrize("value", [tune.loguniform(1e-4, 1e-2), tune.choice([1, 2]), lambda: 3])
def test_a_domain_of_ray_tune_is_answered_with_how_domains_are_written(section: str, value: Any) -> None:
    with pytest.raises(SpecError, match=rf"sweep: {section}\.lr: .* which JSON can't hold") as caught:
        load_spec({**MINIMAL, section: {"lr": value}})
    assert "write a domain as a mapping under space, as in {'lr': {'loguniform': [1e-5, 1e-3]}" in caught.value.hint
