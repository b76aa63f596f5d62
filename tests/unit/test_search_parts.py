"""What models see of a space with conditions and layers, and the kinds of domains that have a scale of their own."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from spec_errors import MINIMAL

from policies.errors import SpecError
from tune_jobs.search import proposal
from tune_jobs.search.asking import Check, Question
from tune_jobs.search.chosen_point import checked_point, outside, trial_of_point
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.mutation import mutate
from tune_jobs.search.parts import Parts
from tune_jobs.search.points import largest_hyperparams
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_point, draw_points
from tune_jobs.spec.file import load_spec

ADAPTER: TypeAdapter[Any] = TypeAdapter(Domain)
LAYERS = {"layers": {"number": [1, 3], "sizes": [16, 32, 64]}}
RAW: dict[str, Any] = {
    "replay": {"choice": ["uniform", "prioritized"]},
    "prioritized_alpha": {"loguniform": [0.01, 1.0], "when": {"replay": "prioritized"}},
    "hidden_sizes": LAYERS,
}


def space_of(**raw: Any) -> dict[str, Any]:
    return {name: ADAPTER.validate_python(domain) for name, domain in raw.items()}


def dqn(**fields: Any) -> Any:
    return load_spec({**MINIMAL, "algorithm": "dqn", "space": RAW, **fields})


SPACE = space_of(**RAW)


# -- kinds


def test_powers_of_two_are_equally_likely_and_all_of_them() -> None:
    domain = ADAPTER.validate_python({"power_of_two": [16, 128]})
    drawn = [domain.sample(np.random.default_rng(seed)) for seed in range(400)]
    assert set(drawn) == {16, 32, 64, 128}
    assert all(type(value) is int for value in drawn)
    assert all(70 < drawn.count(value) < 130 for value in set(drawn))
    assert [domain.gives(value) for value in (16, 48, 128, 256, 16.0, "16")] == [True, False, True, False, True, False]
    assert domain.codes == (4, 7)
    assert [domain.of_code(domain.code_of(value)) for value in (16, 32, 64, 128)] == [16, 32, 64, 128]


def test_the_distance_to_one_is_drawn_on_a_log_scale() -> None:
    domain = ADAPTER.validate_python({"one_minus_loguniform": [0.9, 0.9999]})
    drawn = [domain.sample(np.random.default_rng(seed)) for seed in range(900)]
    decades = [math.floor(math.log10(1 - value)) for value in drawn]
    assert all(240 < decades.count(decade) < 360 for decade in (-2, -3, -4))
    assert all(0.9 <= value <= 0.9999 and domain.gives(value) for value in drawn)
    assert [domain.of_code(domain.code_of(value)) for value in (0.9, 0.99, 0.9999)] == [0.9, 0.99, 0.9999]


def test_layers_have_each_a_size_of_their_own() -> None:
    domain = ADAPTER.validate_python(LAYERS)
    drawn = [domain.sample(np.random.default_rng(seed)) for seed in range(900)]
    assert {len(sizes) for sizes in drawn} == {1, 2, 3}
    assert len({tuple(sizes) for sizes in drawn}) == 3 + 9 + 27
    powers = ADAPTER.validate_python({"layers": {"number": 2, "sizes": {"power_of_two": [8, 16]}}})
    both = {tuple(powers.sample(np.random.default_rng(seed))) for seed in range(60)}
    assert both == {(8, 8), (8, 16), (16, 8), (16, 16)}
    assert [domain.gives(value) for value in ([16], [16, 48], [16] * 4, 16)] == [True, False, False, False]


def test_the_number_of_layers_changes_nothing_that_is_drawn_after_it() -> None:
    one, more = ({"layers": {"number": number, "sizes": [8, 16]}} for number in ([1, 3], [3, 3]))
    after = [
        [point["lr"] for point in draw_points(space_of(hidden_sizes=layers, lr={"uniform": [0, 1]}), 20, 0)]
        for layers in (one, more)
    ]
    assert after[0] == after[1]


@pytest.mark.parametrize(
    ("domain", "part"),
    [
        ({"power_of_two": [16, 100]}, "has 100 as an end, which is no power of two: 64 and 128 are"),
        ({"power_of_two": [0, 16]}, "a log scale needs a start greater than 0"),
        ({"power_of_two": [64, 16]}, "goes from 64 to 16"),
        ({"one_minus_loguniform": [0.9, 1]}, "ends at 1.0: it must be less than 1"),
        ({"layers": {"number": [0, 2], "sizes": [16]}}, "has number [0, 2]"),
        ({"layers": {"number": [3, 2], "sizes": [16]}}, "has number [3, 2]"),
        ({"layers": {"number": [1, 2], "sizes": []}}, "is empty"),
        ({"layers": {"number": [1, 2], "sizes": {"uniform": [8, 16]}}}, "is no domain of sizes"),
        ({"layers": {"number": [1, 2], "sizes": 16}}, "16 is not allowed: give a list such as [32, 64]"),
        ({"layers": {"number": [1, 2], "size": [16]}}, "there is no field 'size' here. Did you mean 'sizes'?"),
        ({"layers": {"number": [1, 2], "sizes": [16, -1]}}, "-1"),
        ({"layers": [16, 32]}, "give a mapping of its fields (number, sizes)"),
    ],
)
def test_wrong_domains_are_refused(domain: dict[str, Any], part: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_spec({**MINIMAL, "algorithm": "dqn", "space": {"hidden_sizes": domain}})
    assert part in caught.value.message
    assert "space.hidden_sizes." in caught.value.message


def test_layers_are_for_what_takes_a_list() -> None:
    with pytest.raises(SpecError, match=r"space\.lr\.layers"):
        load_spec({**MINIMAL, "algorithm": "dqn", "space": {"lr": LAYERS}})


# -- what models see


def test_models_see_every_name_in_every_point_and_layers_one_by_one() -> None:
    parts = Parts(SPACE)
    assert list(parts.space) == [
        "replay", "prioritized_alpha", "hidden_sizes.number", "hidden_sizes.1", "hidden_sizes.2", "hidden_sizes.3",
    ]  # fmt: skip
    point = {"replay": "uniform", "hidden_sizes": [64, 32]}
    assert parts.values_of(point) == {
        "replay": "uniform", "prioritized_alpha": pytest.approx(0.1), "hidden_sizes.number": 2, "hidden_sizes.1": 64,
        "hidden_sizes.2": 32, "hidden_sizes.3": 16,
    }  # fmt: skip
    assert parts.known_values_of(point).keys() == {"replay", "hidden_sizes.number", "hidden_sizes.1", "hidden_sizes.2"}
    for index in range(30):
        drawn = draw_point(SPACE, index, 0)
        assert parts.point_of(parts.values_of(drawn)) == drawn


def test_a_space_of_plain_values_is_seen_as_it_is() -> None:
    assert Parts(space_of(lr={"uniform": [0, 1]})).are_the_same
    assert not Parts(SPACE).are_the_same


def test_a_method_is_asked_of_whole_points_and_its_answer_is_stripped(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Question] = []
    checked: list[dict[str, Any]] = []

    def propose(question: Question, check: Check) -> dict[str, Any]:
        asked.append(question)
        values = dict(question.known[0].point) | {"prioritized_alpha": 0.5}
        check(values)
        return values

    class Fake(proposal._ByModule):
        def load(self) -> Any:
            return propose

    monkeypatch.setitem(proposal._METHODS, "fake", Fake("fake"))
    known = [KnownPoint({"replay": "uniform", "hidden_sizes": [64]}, scores=(score,)) for score in (1.0, 2.0)]
    point = proposal.next_point("fake", SPACE, known, 1, seed=0, num_startup_trials=1, check=checked.append)
    assert point == {"replay": "uniform", "hidden_sizes": [64]} == checked[0]
    assert asked[0].known[0].point.keys() == asked[0].space.keys() == Parts(SPACE).space.keys()


def test_tpe_learns_where_a_condition_holds() -> None:
    pytest.importorskip("optuna")

    def score(point: dict[str, Any]) -> float:
        return 2.0 - abs(math.log10(point["prioritized_alpha"]) + 1.0) if "prioritized_alpha" in point else 0.0

    known: list[KnownPoint] = []
    for index in range(40):
        point = proposal.next_point("tpe", SPACE, known, index, seed=0)
        assert ("prioritized_alpha" in point) == (point["replay"] == "prioritized")
        known.append(KnownPoint(point, scores=(score(point),)))
    found = [item.point for item in known[25:]]
    assert sum(point["replay"] == "prioritized" for point in found) >= 12
    late = [score(dict(point)) for point in found]
    early = [score(dict(item.point)) for item in known[:10]]
    assert sum(late) / len(late) > sum(early) / len(early) + 0.5


# -- points of one's own, populations, plans


def test_a_point_of_ones_own_lacks_what_does_not_act() -> None:
    spec = dqn()
    given = {"replay": "uniform", "hidden_sizes": 64}
    assert checked_point(spec, given) == {"replay": "uniform", "hidden_sizes": [64]}
    with pytest.raises(SpecError, match="prioritized_alpha doesn't act in this point, as it needs replay prioritized"):
        checked_point(spec, given | {"prioritized_alpha": 0.5})
    with pytest.raises(SpecError, match=r"it has no prioritized_alpha: give a value for each searched .* that acts"):
        checked_point(spec, given | {"replay": "prioritized"})
    assert outside(spec.space, {"replay": "uniform", "hidden_sizes": [64] * 4}) == ["hidden_sizes"]
    assert trial_of_point(spec, {"replay": "uniform", "hidden_sizes": [64]}, []) is None


def test_a_mutation_that_lets_something_act_draws_it_and_one_that_does_not_drops_it() -> None:
    space = space_of(
        replay={"choice": ["uniform", "prioritized"]},
        prioritized_alpha={"uniform": [0.5, 1.0], "when": {"replay": "prioritized"}},
    )
    rng = np.random.default_rng(0)
    drawn = [mutate({"replay": "uniform"}, space, rng, 0.0) for _ in range(60)]
    assert all(("prioritized_alpha" in point) == (point["replay"] == "prioritized") for point in drawn)
    assert len({point.get("prioritized_alpha") for point in drawn}) > 10
    near = [mutate({"replay": "prioritized", "prioritized_alpha": 0.7}, space, rng, 0.0) for _ in range(60)]
    assert {point.get("prioritized_alpha") for point in near} == {None, 0.7 * 0.8, 0.7 * 1.2}


@pytest.mark.parametrize(
    ("domain", "value", "expected"),
    [
        ({"power_of_two": [16, 128]}, 64, {32, 128}),
        ({"power_of_two": [16, 128]}, 128, {64, 128}),
        ({"one_minus_loguniform": [0.9, 0.999]}, 0.99, {0.992, 0.988}),
    ],
)
def test_neighbours_lie_on_the_scale_of_their_kind(domain: Any, value: float, expected: set[float]) -> None:
    rng = np.random.default_rng(0)
    assert {mutate({"x": value}, space_of(x=domain), rng, 0.0)["x"] for _ in range(40)} == expected


def test_the_largest_trial_has_the_most_layers_or_what_is_fixed_where_nothing_is_searched() -> None:
    when = {"replay": "prioritized"}
    spec = dqn(space={**RAW, "replay_capacity": {"power_of_two": [1024, 4096], "when": when}})
    known = dqn().model_copy()
    from tune_jobs.plan.points import point_hyperparams

    base = point_hyperparams(known, {"replay": "uniform", "hidden_sizes": [16]}, 0)
    found = largest_hyperparams(spec, [base])
    assert {tuple(values.hidden_sizes) for values in found} == {(64, 64, 64)}  # type: ignore[union-attr]
    assert {values.replay_capacity for values in found} == {1024, 4096, spec.value_without("replay_capacity")}  # type: ignore[union-attr]
