"""Conditions in a search space: what acts in a point, which points there are, and what is refused."""

import re
from typing import Any

import pytest
from pydantic import TypeAdapter
from spec_errors import MINIMAL

from policies.errors import SpecError
from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_all, draw_point, draw_points, num_points
from tune_jobs.spec.file import load_spec

ADAPTER: TypeAdapter[Any] = TypeAdapter(Domain)
DQN = {**MINIMAL, "algorithm": "dqn"}
REPLAY = {"choice": ["uniform", "prioritized"]}
ALPHA = {"uniform": [0.01, 1.0], "when": {"replay": "prioritized"}}


def space_of(**raw: Any) -> dict[str, Any]:
    return {name: ADAPTER.validate_python(domain) for name, domain in raw.items()}


def refused(space: dict[str, Any], **fields: Any) -> str:
    with pytest.raises(SpecError) as caught:
        load_spec({**DQN, "space": space, **fields})
    return caught.value.message


# -- what acts


def test_a_point_lacks_what_does_not_act_in_it() -> None:
    space = space_of(alpha={"uniform": [0, 1], "when": {"replay": "prioritized"}}, replay=REPLAY)
    points = draw_points(space, 40, sweep_seed=0)
    assert {("alpha" in point, point["replay"]) for point in points} == {(True, "prioritized"), (False, "uniform")}
    assert all(list(point) == ["alpha", "replay"] for point in points if "alpha" in point)


def test_all_conditions_have_to_hold_and_a_list_takes_any_of_its_values() -> None:
    space = space_of(
        a={"choice": [1, 2, 3]}, b={"choice": [True, False]}, c={"uniform": [0, 1], "when": {"a": [1, 3], "b": True}}
    )
    conditions = Conditions(space)
    acting = {(a, b): "c" in conditions.acting({"a": a, "b": b, "c": 0.5}) for a in (1, 2, 3) for b in (True, False)}
    assert [key for key, acts in acting.items() if acts] == [(1, True), (3, True)]


def test_what_depends_on_something_that_does_not_act_does_not_act() -> None:
    space = space_of(
        c={"choice": [5, 6], "when": {"b": 2}}, b={"choice": [1, 2], "when": {"a": "x"}}, a={"choice": ["x", "y"]}
    )
    conditions = Conditions(space)
    assert conditions.stripped({"c": 5, "b": 2, "a": "x"}) == {"c": 5, "b": 2, "a": "x"}
    assert conditions.stripped({"c": 5, "b": 1, "a": "x"}) == {"b": 1, "a": "x"}
    assert conditions.stripped({"c": 5, "b": 2, "a": "y"}) == {"a": "y"}


def test_a_list_of_a_domain_of_lists_is_one_value() -> None:
    space = space_of(
        sizes={"grid": [[64], [64, 64]]},
        one={"choice": [1], "when": {"sizes": [64, 64]}},
        two={"choice": [1], "when": {"sizes": [[64], [64, 64]]}},
    )
    conditions = Conditions(space)
    assert conditions.acting({"sizes": [64], "one": 1, "two": 1}) == {"sizes", "two"}
    assert conditions.acting({"sizes": [64, 64], "one": 1, "two": 1}) == {"sizes", "one", "two"}


def test_true_is_not_one_in_a_condition() -> None:
    space = space_of(a={"choice": [1, True]}, b={"choice": [0], "when": {"a": True}})
    assert [Conditions(space).acting({"a": a, "b": 0}) for a in (1, True)] == [{"a"}, {"a", "b"}]


# -- draws


def test_a_condition_changes_no_other_value() -> None:
    free = {"replay": REPLAY, "alpha": {"uniform": [0.01, 1.0]}, "lr": {"loguniform": [1e-5, 1e-1]}}
    bound = {**free, "alpha": ALPHA}
    for one, other in zip(draw_points(space_of(**free), 30, 3), draw_points(space_of(**bound), 30, 3), strict=True):
        assert {**one, **other} == one
        assert ("alpha" in other) == (one["replay"] == "prioritized")


def test_more_samples_change_no_earlier_point() -> None:
    space = space_of(replay=REPLAY, alpha=ALPHA, lr={"loguniform": [1e-5, 1e-1]})
    assert draw_points(space, 50, 7)[:10] == draw_points(space, 10, 7)
    assert draw_point(space, 4, 7) == draw_points(space, 5, 7)[4]
    assert draw_all(space, 4, 7).keys() == space.keys()


def test_a_grid_multiplies_only_the_combinations_in_which_it_acts() -> None:
    space = space_of(
        beta={"grid": [0.4, 1.0], "when": {"alpha": 0.6}},
        alpha={"grid": [0.0, 0.6], "when": {"replay": "prioritized"}},
        replay={"grid": ["uniform", "prioritized"]},
        lr={"grid": [1, 2]},
    )
    points = draw_points(space, 1, 0)
    assert points == [
        {"replay": "uniform", "lr": 1},
        {"replay": "uniform", "lr": 2},
        {"alpha": 0.0, "replay": "prioritized", "lr": 1},
        {"alpha": 0.0, "replay": "prioritized", "lr": 2},
        {"beta": 0.4, "alpha": 0.6, "replay": "prioritized", "lr": 1},
        {"beta": 0.4, "alpha": 0.6, "replay": "prioritized", "lr": 2},
        {"beta": 1.0, "alpha": 0.6, "replay": "prioritized", "lr": 1},
        {"beta": 1.0, "alpha": 0.6, "replay": "prioritized", "lr": 2},
    ]
    assert num_points(space, 3) == 24 == len(draw_points(space, 3, 0))


def test_combinations_that_nobody_could_train_are_not_listed() -> None:
    many = {f"g{index}": {"grid": list(range(100))} for index in range(8)}
    bound = {f"c{index}": {"grid": list(range(100)), "when": {f"g{index}": 0}} for index in range(8)}
    assert num_points(space_of(**many), 1) == 100**8
    assert num_points(space_of(**many, **bound), 3) == 3 * 199**8
    # All of them in one group: as many as are counted.
    chained = {f"c{index}": {"grid": [1, 2], "when": {"g0": 0, f"g{index + 1}": 0}} for index in range(7)}
    assert num_points(space_of(**many, **chained), 1) >= 100_000


# -- what is refused


@pytest.mark.parametrize(
    ("space", "fixed", "path", "part"),
    [
        (
            {"prioritized_alpha": ALPHA},
            {"replay": "prioritized"},
            "space.prioritized_alpha.when.replay",
            "is fixed at 'prioritized' under hyperparams, not searched",
        ),
        ({"prioritized_alpha": ALPHA}, {}, "space.prioritized_alpha.when.replay", "is not searched, and always"),
        (
            {"lr": {"uniform": [0, 1], "when": {"stop.num_env_steps": 1_000}}},
            {},
            "space.lr.when.stop.num_env_steps",
            "is not searched, and the same for all trials: search stop.num_env_steps too, or take the condition out.",
        ),
        (
            {"replay": REPLAY, "prioritized_alpha": {"uniform": [0, 1], "when": {"replya": "prioritized"}}},
            {},
            "space.prioritized_alpha.when.replya",
            "dqn has no hyperparameter 'replya'. Did you mean 'replay'?",
        ),
        (
            {"replay": REPLAY, "prioritized_alpha": {"uniform": [0, 1], "when": {"replay": "prioritised"}}},
            {},
            "space.prioritized_alpha.when.replay",
            "'prioritised' is no value that replay can have: it is one of 'uniform', 'prioritized'. Did you mean 'pri",
        ),
        (
            {"replay": REPLAY, "prioritized_alpha": {"uniform": [0, 1], "when": {"replay": ["prioritized", 1]}}},
            {},
            "space.prioritized_alpha.when.replay[1]",
            "1 is no value that replay can have",
        ),
        (
            {"n_step": {"randint": [1, 4]}, "gamma": {"uniform": [0.9, 1], "when": {"n_step": 4}}},
            {},
            "space.gamma.when.n_step",
            "4 is no value that n_step can have: its domain is randint [1, 4]",
        ),
        (
            {"lr": {"loguniform": [1e-4, 1e-2]}, "gamma": {"uniform": [0.9, 1], "when": {"lr": 1e-3}}},
            {},
            "space.gamma.when.lr",
            "lr (loguniform) hardly ever draws exactly 0.001",
        ),
        (
            {
                "hidden_sizes": {"layers": {"number": [1, 2], "sizes": [8, 16]}},
                "lr": {"uniform": [0, 1], "when": {"hidden_sizes": 2}},
            },
            {},
            "space.lr.when.hidden_sizes",
            "draws each layer's size",
        ),
        ({"replay": {**REPLAY, "when": {"replay": "uniform"}}}, {}, "space.replay.when.replay", "of replay on itself"),
        ({"replay": {**REPLAY, "when": {}}}, {}, "space.replay.choice.when", "at least 1"),
        (
            {"replay": REPLAY, "prioritized_alpha": {"uniform": [0, 1], "when": {"replay": []}}},
            {},
            "space.prioritized_alpha.when.replay",
            "lists no value",
        ),
        (
            {"replay": REPLAY, "prioritized_alpha": {"grid": [0.1, 0.2], "when": {"replay": "prioritized"}}},
            {},
            "space.prioritized_alpha.when.replay",
            "is drawn (choice), but prioritized_alpha is a grid",
        ),
        (
            {
                "replay": {**REPLAY, "when": {"dueling": True}},
                "dueling": {"choice": [True, False], "when": {"double_q": True}},
                "double_q": {"choice": [True, False], "when": {"replay": "uniform"}},
            },
            {},
            "space.replay.when",
            "is a loop: replay needs dueling needs double_q needs replay",
        ),
        (
            {
                "replay": REPLAY,
                "dueling": {"choice": [True, False], "when": {"replay": "uniform"}},
                "double_q": {"choice": [True, False], "when": {"dueling": True, "replay": "prioritized"}},
            },
            {},
            "space.double_q.when",
            "can never hold: double_q acts only with replay prioritized, and dueling only with replay uniform",
        ),
    ],
)
def test_conditions_that_are_wrong_are_refused_with_path_and_value(
    space: dict[str, Any], fixed: dict[str, Any], path: str, part: str
) -> None:
    told = refused(space, hyperparams=fixed)
    where = path.replace(".choice.when", ".when")
    assert re.search(rf"{re.escape(where)}:? {re.escape(part)}|{re.escape(where)}: .*{re.escape(part)}", told), told


def test_a_contradiction_is_told_once() -> None:
    space = {
        "replay": REPLAY,
        "dueling": {"choice": [True, False], "when": {"replay": "uniform"}},
        "double_q": {"choice": [True, False], "when": {"dueling": True, "replay": "prioritized"}},
        "n_step": {"choice": [1, 2], "when": {"double_q": True}},
    }
    assert refused(space).count("can never hold") == 1


def test_wrong_conditions_are_told_with_other_mistakes_and_not_of_domains_that_are_wrong() -> None:
    space = {"replay": {"chioce": [1]}, "prioritized_alpha": ALPHA, "lr": {"uniform": [0, 1], "when": {"tau": 1}}}
    told = refused(space, num_samples=0)
    assert "space.lr.when.tau: is not searched" in told
    assert "space.prioritized_alpha.when" not in told
    assert "num_samples" in told


@pytest.mark.parametrize("key", ["when", "When", "wehn"])
def test_a_condition_beside_the_hyperparameters_is_told_its_place_alone(key: str) -> None:
    told = refused({"replay": REPLAY, "prioritized_alpha": {"uniform": [0.1, 1.0]}, key: {"replay": "prioritized"}})
    assert f"sweep: space.{key}: dqn has no hyperparameter {key!r}. `when` belongs inside the braces" in told
    assert "there is no domain" not in told
    assert "It has activation" not in told
    several = {key: {"replay": "prioritized", "dueling": True}, "replay": REPLAY}
    assert "needs exactly one key" not in refused(several)


@pytest.mark.parametrize(
    ("key", "suggestion"), [("When", " Did you mean 'when'?"), ("wehn", " Did you mean 'when'?"), ("q", "")]
)
def test_a_second_key_of_a_domain_is_answered_with_when(key: str, suggestion: str) -> None:
    told = refused({"replay": REPLAY, "prioritized_alpha": {"uniform": [0.1, 1.0], key: {"replay": "prioritized"}}})
    where = f"space.prioritized_alpha: has {key} beside uniform"
    assert told.endswith(f"{where}, where only when may stand, its condition.{suggestion}")


def test_under_a_name_that_there_is_not_a_misspelt_domain_is_told_too() -> None:
    told = refused({"gama": {"unifrom": [0.9, 1]}, "stop": {"num_env_steps": {"choice": [1, 2]}}})
    assert "space.gama: there is no domain 'unifrom'" in told
    assert "Did you mean 'gamma'?" in told
    assert "there is no domain 'num_env_steps'" not in told
    assert "write space: {stop.num_env_steps: ...}" in told


def test_grids_may_depend_on_draws_where_they_are_lists_to_choose_from() -> None:
    space = {"replay": REPLAY, "prioritized_alpha": {"grid": [0.1, 0.2], "when": {"replay": "prioritized"}}}
    assert load_spec({**DQN, "space": space, "search": "tpe", "num_samples": 20}).space["prioritized_alpha"].when


@pytest.mark.parametrize("scheduler", ["none", "pbt"])
def test_a_chain_or_a_loop_of_names_that_there_are_not_is_told_as_such(scheduler: str) -> None:
    number = 3_000
    chain = {
        f"n{i}": {"choice": [1, 2], **({"when": {f"n{i + 1}": 1}} if i < number else {})} for i in range(number + 1)
    }
    assert "dqn has no hyperparameter 'n7'" in refused(chain, scheduler=scheduler)
    loop = {"x": {"grid": [1, 2], "when": {"y": 1}}, "y": {"grid": [1, 2], "when": {"x": 1}}}
    assert "dqn has no hyperparameter 'x'" in refused(loop, scheduler=scheduler)


# -- what else a sweep file says


def test_a_value_may_be_fixed_for_where_it_is_not_searched() -> None:
    space = {"replay": REPLAY, "prioritized_alpha": ALPHA}
    spec = load_spec({**DQN, "space": space, "hyperparams": {"prioritized_alpha": 0.3}})
    assert spec.value_without("prioritized_alpha") == 0.3
    free = {"replay": REPLAY, "prioritized_alpha": {"uniform": [0, 1]}}
    assert "is fixed at 0.3 but also searched" in refused(free, hyperparams={"prioritized_alpha": 0.3})


def test_a_domain_without_a_condition_is_written_as_it_always_was() -> None:
    spec = load_spec({**DQN, "space": {"replay": REPLAY, "prioritized_alpha": ALPHA}})
    written = spec.model_dump(mode="json")["space"]
    assert written["replay"] == {"choice": ["uniform", "prioritized"]}
    assert list(written["prioritized_alpha"]) == ["uniform", "when"]
    assert load_spec({**DQN, "space": written}).space == spec.space


def test_set_gives_a_domain_a_condition() -> None:
    space = {"replay": REPLAY, "prioritized_alpha": {"uniform": [0.01, 1.0]}}
    spec = load_spec({**DQN, "space": space}, ["space.prioritized_alpha.when.replay=prioritized"])
    assert spec.space["prioritized_alpha"].when == {"replay": "prioritized"}
