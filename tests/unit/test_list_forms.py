"""A list that is left out or nested wrongly is understood if it has one meaning; else a message says what to write."""

from typing import Any

import pytest
from spec_errors import MINIMAL, errors

from policies.errors import SpecError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.transitions import pending_record


def sizes_of(**fields: Any) -> list[list[int]]:
    plan = make_plan(load_spec({**MINIMAL, **fields}), Machine(2))
    return [trial.hyperparams["hidden_sizes"] for trial in plan.trials]


@pytest.mark.parametrize("kind", ["grid", "choice"])
def test_a_number_among_networks_is_one_of_one_layer(kind: str) -> None:
    assert sizes_of(hyperparams={"hidden_sizes": 64}) == [[64]]
    assert sizes_of(space={"hidden_sizes": {"grid": [64, 128]}}) == [[64], [128]]
    assert sizes_of(space={"hidden_sizes": {"grid": [64, [64, 64]]}}) == [[64], [64, 64]]
    assert sizes_of(space={"hidden_sizes": {kind: [[64, 128]]}}) == [[64, 128]]


@pytest.mark.parametrize(
    ("fixed", "told"),
    [
        ("64", "'64' is not allowed: it should be a list: write [64]"),
        ("64, 128", "'64, 128' is not allowed: it should be a list: write [64, 128]"),
        ("64x64", "'64x64' is not allowed: it should be a list: write [64, 64]"),
        ("[64,64]", "'[64,64]' is not allowed: it should be a list: write [64, 64]"),
        ([[64, 64]], "[[64, 64]] is not allowed: write [64, 64]"),
        ([[32], [64, 64]], "is a list of values: write {grid: [[32], [64, 64]]} as space.hidden_sizes to try each"),
        ({"grid": [64]}, "{'grid': [64]} is a domain, not one value: write it as space.hidden_sizes"),
        # Nothing is proposed that would be refused.
        ("64x0", "'64x0' is not allowed: it should be a list\n"),
        ("about 64", "'about 64' is not allowed: it should be a list\n"),
        ([64.5], "[0]: 64.5 is not allowed: it should be a whole number\n"),
    ],
)
def test_fixed_sizes_that_are_no_list_of_numbers(fixed: Any, told: str) -> None:
    message = errors(hyperparams={"hidden_sizes": fixed}) + "\n"
    assert message.startswith("sweep: hyperparams.hidden_sizes")
    assert told in message


@pytest.mark.parametrize(
    ("domain", "told"),
    [
        (64, ": 64 is one value: fix it under hyperparams, or write {grid: [64]}"),
        (
            [64, 128],
            (
                ": [64, 128] is a bare list: write {grid: [[64], [128]]} to try each as one layer, or "
                "{grid: [[64, 128]]} for one network of 2 layers"
            ),
        ),
        ([[64], 128], ": [[64], 128] is a bare list: write {grid: [[64], 128]} to try each of its values"),
        ({"grid": 64}, ".grid: 64 is not allowed: it should be a list: write [64]"),
        ({"choice": "64"}, ".choice: '64' is not allowed: it should be a list: write [64]"),
        (
            {"grid": "64,128"},
            (
                ".grid: '64,128' is not allowed: it should be a list: write [64, 128] to try each as one layer, or "
                "[[64, 128]] for one network of 2 layers"
            ),
        ),
        ({"grid": [32, "64x64"]}, ".grid[1]: '64x64' is not allowed: it should be a list: write [64, 64]"),
        ({"grid": [[[64, 64]]]}, ".grid[0]: [[64, 64]] is not allowed: write [64, 64]"),
    ],
)
def test_searched_sizes_that_are_no_list_of_networks(domain: Any, told: str) -> None:
    assert errors(space={"hidden_sizes": domain}).endswith(f"space.hidden_sizes{told}")


@pytest.mark.parametrize(
    ("domain", "told", "followed"),
    [
        ([64, 64], "bare list: write {grid: [[64, 64]]} for one network of 2 layers", {"grid": [[64, 64]]}),
        ({"grid": "64x64"}, "a list: write [[64, 64]] for one network of 2 layers", {"grid": [[64, 64]]}),
        ({"choice": "8, 16, 8"}, "a list: write [[8, 16, 8]] for one network of 3 layers", {"choice": [[8, 16, 8]]}),
        ([64, [64], [8, 8]], "write {grid: [64, [8, 8]]} to try each of its values", {"grid": [64, [8, 8]]}),
    ],
)
def test_no_value_is_proposed_twice_which_would_be_refused(domain: Any, told: str, followed: Any) -> None:
    assert errors(space={"hidden_sizes": domain}).endswith(told)
    assert sizes_of(space={"hidden_sizes": followed})


def test_nor_is_it_for_other_hyperparameters() -> None:
    told = "write {grid: [0.1, 0.01]} "
    assert told in errors(space={"lr": [0.1, 0.01, 0.1]})
    assert told in errors(hyperparams={"lr": [0.1, 0.01, 0.1]})
    assert load_spec({**MINIMAL, "space": {"lr": {"grid": [0.1, 0.01]}}})
    with pytest.raises(SpecError, match="is a bare list"):  # of what no file could hold
        SweepSpec.model_validate({**MINIMAL, "space": {"lr": [{1, 2}]}})
    assert errors(space={"lr": []}).endswith("[] is a bare list: write {grid: [...]} to try each of its values")


def test_the_same_from_set() -> None:
    message = errors(overrides=["hyperparams.hidden_sizes=64,64"])
    assert message.endswith("'64,64' is not allowed: it should be a list: write [64, 64] (from --set)")


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"hyperparams": {"conv_filters": [16, 8, 4]}}, "conv_filters: [16, 8, 4] is not allowed: write [[16, 8, 4]]"),
        ({"hyperparams": {"lr": [0.1, 0.01]}}, "write {grid: [0.1, 0.01]} as space.lr to try each of its values"),
        ({"hyperparams": {"lr": {"uniform": [0.1, 0.2]}}}, "is a domain, not one value: write it as space.lr"),
        ({"space": {"lr": {"grid": 0.1}}}, "space.lr.grid: 0.1 is not allowed: it should be a list: write [0.1]"),
        ({"space": {"vf_share_layers": {"grid": True}}}, "it should be a list: write [true]"),
    ],
)
def test_other_hyperparameters_are_answered_alike(fields: dict[str, Any], told: str) -> None:
    assert errors(**fields).endswith(told)


@pytest.mark.parametrize("value", ["9" * 5_000, "1 " * 50_000, list(range(3_000)), [0.5] * 3_000])
def test_what_is_long_is_not_repeated(value: Any) -> None:
    assert len(errors(space={"lr": value if isinstance(value, list) else {"grid": value}})) < 400
    assert len(errors(hyperparams={"lr": value})) < 400
    assert len(errors(hyperparams={"lr": {"grid": value}})) < 400


@pytest.mark.parametrize("values", [[64, [64]], [[64], [64, 64], 64], [64, 64.0]])
def test_one_network_in_two_forms_is_listed_twice(values: list[Any]) -> None:
    fields = {"space": {"hidden_sizes": {"grid": values}}}
    last = len(values) - 1
    with pytest.raises(SpecError) as caught:
        sizes_of(**fields)
    message = caught.value.message
    assert message.startswith(
        f"space.hidden_sizes.grid[{last}]: {values[-1]!r} is the same as {values[0]!r}, in grid[0]"
    )
    assert present(caught.value.hint)


def test_a_sweep_that_exists_with_one_network_in_two_forms_goes_on() -> None:
    spec = load_spec({**MINIMAL, "space": {"hidden_sizes": {"grid": [64, [64, 64]]}}})
    records = [pending_record(trial) for trial in make_plan(spec, Machine(2)).trials]
    twice = load_spec({**MINIMAL, "space": {"hidden_sizes": {"grid": [64, [64]]}}})
    assert len(make_plan(twice, Machine(2), records).trials) == 2
