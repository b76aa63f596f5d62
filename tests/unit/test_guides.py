"""What the guides say of numbers, names and cases that the code decides."""

import ast
import inspect
from pathlib import Path

from tests.narrowing import present
from tune_jobs.cli.commands import cli
from tune_jobs.plan.sweep_plan import MAX_TRIALS
from tune_jobs.search.parts import Parts
from tune_jobs.service import telling
from tune_jobs.service.config import Limits
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.reproduce import _depends_on_pack as depends_on_pack

GUIDES = Path(__file__).parents[2] / "docs" / "guides"


def section(guide: str, heading: str) -> str:
    """A part of a guide, without the breaks of its lines."""
    _, found, text = (GUIDES / guide).read_text().partition(f"\n## {heading}\n")
    assert found
    return " ".join(text.partition("\n## ")[0].split())


def test_what_a_service_takes_is_in_its_guide() -> None:
    told = section("service.md", "What may be submitted")
    limits = Limits()
    assert f"up to {limits.trials:,} trials" in told
    assert f"command line up to {MAX_TRIALS:,}" in told
    assert f"up to {limits.watchers:,} clients" in told


def test_the_variables_that_stand_for_the_options_of_a_client_are_in_the_services_guide() -> None:
    told = section("service.md", "From the command line and Python")
    variables = {str(option.envvar) for option in cli.params if option.envvar is not None}
    assert len(variables) == 3
    assert {name for name in variables if name not in told} == set()


def test_what_a_told_command_is_given_is_in_the_services_guide() -> None:
    told = section("service.md", "Being told")
    assert telling._COMMAND_TIMEOUT_S == 60.0
    assert "A command has a minute" in told
    tree = ast.parse(inspect.getsource(telling._run_command))
    keys = next(node for node in ast.walk(tree) if isinstance(node, ast.Dict)).keys
    names = {str(key.value) for key in keys if isinstance(key, ast.Constant)}
    assert len(names) == 2
    assert {name for name in names if f"`{name}`" not in told} == set()


CASES = {
    "layers may have been padded": ("its layers were padded", "layers are padded"),
    "its place among the trials": ("no multiple of 16, or a layer has one unit", "no multiple of 16, or a layer has"),
    "on a GPU": ("it ran on a GPU beside others", "[on a GPU]"),
}
"""By what a repetition's note says: what its guide says, and that of the search, where packs are told of."""


def test_each_case_in_which_a_trial_depends_on_its_pack_is_in_the_guides() -> None:
    tree = ast.parse(inspect.getsource(depends_on_pack))
    texts = [ast.unparse(present(node.value)) for node in ast.walk(tree) if isinstance(node, ast.Return)]
    notes = [text for text in texts if text != "''"]
    assert len(notes) == len(CASES)
    repeating, packs = section("compare.md", "Repeating a trial"), section("search.md", "Many trials in a process")
    for words, (of_repeating, of_packs) in CASES.items():
        assert sum(words in note for note in notes) == 1
        assert of_repeating in repeating
        assert of_packs in packs
    assert "but for three cases, in which the last bits" in packs
    _, _, reproducible = (GUIDES.parent / "guarantees.md").read_text().partition("**Reproducible.**")
    assert "guides/compare.md#repeating-a-trial" in reproducible.partition("\n- **")[0]


def test_what_a_study_makes_of_layers_and_of_trials_without_a_score_is_in_the_guide() -> None:
    told = section("exports.md", "Optuna")
    layers = {"hidden_sizes": {"layers": {"number": [1, 2], "sizes": [16, 32]}}}
    spec = SweepSpec.model_validate({"algorithm": "ppo", "env": "CartPole-v1", "space": layers})
    names = list(Parts(spec.space).space)
    assert names == ["hidden_sizes.number", "hidden_sizes.1", "hidden_sizes.2"]
    assert ", ".join(f"`{name}`" for name in names) in told
    assert "`steps_to_threshold`" in told
    assert {"(PRUNED)", "(FAIL)"} <= set(told.replace(";", " ").replace(",", " ").split())
