"""A point that somebody chooses: its number, its values, what is refused, and who learns from it."""

import json
import pickle
import pkgutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import pytest
from sweep_folders import kept_before_each_write, make_sweep_folder, train

from analysis.numbering import drawn_index, with_chosen
from analysis.records import ChosenPointRecord, ReplicationRecord, SweepRecord
from policies.errors import CheckpointError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search.chosen_point import checked_point, outside, trial_of_point
from tune_jobs.search.points import planned_points
from tune_jobs.service import driver
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import resume as resuming
from tune_jobs.sweeps import verbs as sweeps

SPACE: dict[str, Any] = {
    "lr": {"loguniform": [1e-4, 1e-2]},
    "hidden_sizes": {"choice": [[64], [64, 64]]},
    "num_epochs": {"randint": [2, 8]},
}
POINT = {"lr": 3e-3, "hidden_sizes": [64], "num_epochs": 4}


def make_spec(**changes: Any) -> SweepSpec:
    return load_spec({"env": "CartPole-v1", "algorithm": "ppo", "space": SPACE, "num_samples": 3} | changes)


def chosen(*places: int, point: dict[str, Any] = POINT) -> tuple[ChosenPointRecord, ...]:
    return tuple(ChosenPointRecord(num_points=place, point=point) for place in places)


# -- numbers


def test_a_chosen_point_takes_the_next_index_and_shifts_no_draw() -> None:
    a, b, c = ({"lr": value} for value in (1.0, 2.0, 3.0))
    added = chosen(0, 2, 3, point={"lr": 9.0})
    assert with_chosen([a, b, None], added) == [{"lr": 9.0}, a, {"lr": 9.0}, {"lr": 9.0}, b, None]
    assert [drawn_index(index, added) for index in (1, 4, 5)] == [0, 1, 2]
    assert with_chosen([a, b, c], ()) == [a, b, c]


@pytest.mark.parametrize(
    ("places", "words"), [((2, 2), "after 2 points follows one chosen after 2"), ((4,), "after 4 points is of a sweep")]
)
def test_numbers_that_cannot_be_are_refused(places: tuple[int, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        with_chosen([{}, {}, {}], chosen(*places))


@pytest.mark.parametrize("changes", [{}, {"search": {"type": "tpe", "num_startup_trials": 3}, "num_samples": 6}])
def test_later_points_are_the_ones_that_they_would_be_without_it(changes: dict[str, Any]) -> None:
    spec = make_spec(**changes)
    longer = spec.model_copy(update={"num_samples": spec.num_samples + 2})
    without, place = planned_points(longer), spec.num_samples
    points = planned_points(longer, chosen(place))
    assert points[place] == POINT
    assert points[:place] + points[place + 1 :] == without


def test_it_has_all_seeds_and_the_earlier_trials_and_more_seeds_keep_their_places() -> None:
    spec = make_spec(seeds_per_point=2)
    more = [ReplicationRecord(num_points=3, points=(1,))]
    before = make_plan(spec, Machine(2), replications=more)
    after = make_plan(spec, Machine(2), replications=more, chosen_points=chosen(3))
    assert after.trials[:7] == before.trials
    assert [(trial.point_index, trial.seed_index, trial.point) for trial in after.trials[7:]] == [
        (3, 0, POINT), (3, 1, POINT)
    ]  # fmt: skip
    assert after.trials[7].hyperparams["num_epochs"] == 4
    assert after.num_points == 4
    assert len({trial.seed for trial in after.trials}) == 9
    # More seeds may go to it, too.
    again = make_plan(
        spec, Machine(2), replications=[*more, ReplicationRecord(num_points=4, points=(3,))], chosen_points=chosen(3)
    )
    assert (again.trials[9].point, again.trials[9].seed_index) == (POINT, 2)


def test_its_size_counts_beside_those_that_are_not_known_yet() -> None:
    spec = make_spec(search={"type": "tpe", "num_startup_trials": 2}, num_samples=4)
    before = make_plan(spec, Machine(2))
    after = make_plan(spec, Machine(2), chosen_points=chosen(3))
    assert [trial.has_point for trial in after.trials] == [True, True, False, True, False]
    assert after.max_env_steps == before.max_env_steps * 5 / 4


def test_a_record_of_an_older_version_has_none_and_one_with_them_is_read_again() -> None:
    old = {
        "name": "x", "state": "completed", "spec": {}, "evaluation_seeds": [1], "confirmation_seeds": [2],
        "num_trials": 1, "created_at": 0.0,
    }  # fmt: skip
    record = SweepRecord.model_validate(old)
    assert record.chosen_points == ()
    changed = record.model_copy(update={"chosen_points": chosen(3)})
    assert SweepRecord.model_validate_json(changed.model_dump_json()) == changed


# -- values


def test_values_are_written_as_the_space_has_them() -> None:
    found = checked_point(make_spec(), {"num_epochs": 4.0, "hidden_sizes": 64, "lr": 1})
    assert json.dumps(found) == '{"lr": 1.0, "hidden_sizes": [64], "num_epochs": 4}'
    assert list(found) == list(SPACE)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lr": "high"}, "lr: 'high' is not a number, and its domain is loguniform [0.0001, 0.01]"),
        ({"lr": True}, "lr: true is not a number"),
        ({"lr": [0.1, 0.2]}, "is not a number"),
        ({"lr": -1.0}, "lr: -1.0 is not allowed: it should be greater than 0"),
        ({"num_epochs": 2.5}, "num_epochs: 2.5 is not a whole number, and its domain is randint [2, 8]"),
        ({"hidden_sizes": "64x64"}, "write [64, 64]"),
        ({"lr": None}, "lr: null is not a number"),
        ({"lr": float("nan")}, "lr: nan is not a finite number"),
        ({"lrr": 1.0}, "'lrr' is not searched in this sweep: leave it out. Did you mean 'lr'?"),
        ({"gamma": 0.9}, "gamma is fixed at 0.99 in this sweep, and not searched"),
    ],
)
def test_what_is_wrong_is_said_with_what_the_sweep_searches(changes: dict[str, Any], words: str) -> None:
    spec = make_spec(hyperparams={"gamma": 0.99})
    with pytest.raises(SpecError) as caught:
        checked_point(spec, POINT | changes)
    assert words in caught.value.message
    assert caught.value.hint


def test_all_problems_come_at_once() -> None:
    with pytest.raises(SpecError) as caught:
        checked_point(make_spec(), {"lr": "x", "other": 1})
    assert caught.value.message.startswith("point: 3 problems:\n")
    assert "it has no hidden_sizes and no num_epochs" in caught.value.message
    assert caught.value.hint == (
        "The sweep searches lr (loguniform [0.0001, 0.01]), hidden_sizes (choice [[64], [64, 64]]), "
        "num_epochs (randint [2, 8])."
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"space": {}, "num_samples": 1}, "it has no space"),
        (
            {"space": {"lr": SPACE["lr"]}, "num_samples": 4,
             "scheduler": {"type": "pbt", "perturb_every_env_steps": 1_000}},
            "population based training",
        ),
    ],
)  # fmt: skip
def test_sweeps_that_take_no_points_say_why(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=words) as caught:
        checked_point(make_spec(**changes), {"lr": 1e-3})
    assert caught.value.hint


def test_values_outside_of_their_domains_are_trained_and_noted() -> None:
    point = checked_point(make_spec(), {"lr": 0.05, "hidden_sizes": [32], "num_epochs": 8})
    assert outside(make_spec().space, point) == ["lr", "hidden_sizes", "num_epochs"]
    plan = make_plan(make_spec(), Machine(2), chosen_points=chosen(3, point=point))
    (note,) = (note for note in plan.notes if "chosen" in note)
    assert note == (
        "Point 3 was chosen with lr 0.05, hidden_sizes 32, num_epochs 8, outside of space (lr (loguniform [0.0001, "
        "0.01]), hidden_sizes (choice [[64], [64, 64]]), num_epochs (randint [2, 8])): it is trained."
    )
    assert not any("chosen" in note for note in make_plan(make_spec(), Machine(2), chosen_points=chosen(3)).notes)


@pytest.mark.parametrize(
    ("domain", "inside", "beyond"),
    [
        ({"quniform": [0.1, 0.9, 0.1]}, [0.1, 0.30000000000000004, 0.9], [0.05, 0.25, 1.0]),
        ({"qrandint": [32, 128, 32]}, [32, 96, 128], [33, 160]),
        ({"randint": [1, 4]}, [1, 3], [0, 4]),
        ({"uniform": [0.5, 1.0]}, [0.5, 1.0, 1], [0.4999]),
        ({"grid": [None, 0.5]}, [None, 0.5], [1.0, 0]),
    ],
)
def test_what_a_domain_can_give(domain: dict[str, Any], inside: list[Any], beyond: list[Any]) -> None:
    from pydantic import TypeAdapter

    from tune_jobs.spec.domains import Domain

    space = {"x": TypeAdapter(Domain).validate_python(domain)}
    assert [outside(space, {"x": value}) for value in inside] == [[]] * len(inside)
    assert [outside(space, {"x": value}) for value in beyond] == [["x"]] * len(beyond)


# -- who learns from it


def test_tpe_learns_from_a_point_inside_and_proposes_the_same_with_one_outside() -> None:
    pytest.importorskip("optuna")
    from test_search_methods import SPACE as OWN
    from test_search_methods import make_spec as tpe_spec
    from test_search_methods import record, valley

    from tune_jobs.search.history import known_points
    from tune_jobs.search.proposal import propose_point
    from tune_jobs.spec.draws import draw_point

    spec = tpe_spec(startup=8)
    records = [record(i, p := draw_point(spec.space, i, spec.seed), valley(p)) for i in range(8)]
    before = propose_point(spec, records, 8, lambda point: None)
    inside = record(8, {"lr": 1e-3, "activation": "silu"}, 50.0)
    beyond = record(8, {"lr": 0.5, "activation": "silu"}, 50.0)
    assert OWN["lr"] == {"loguniform": [1e-5, 1e-1]}
    assert len(known_points(spec, [*records, inside])) == 9
    # Its index among the drawn points is the same, and so is what is proposed.
    assert propose_point(spec, [*records, beyond], 8, lambda point: None) == before
    assert propose_point(spec, [*records, inside], 8, lambda point: None) != before


def test_an_optuna_study_is_as_wide_as_what_was_tried(tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna")
    space = {
        "lr": {"loguniform": [1e-4, 1e-2]}, "gamma": {"quniform": [0.9, 0.99, 0.01]},
        "num_epochs": {"randint": [2, 8]}, "hidden_sizes": {"grid": [[64]]},
    }  # fmt: skip
    store = make_sweep_folder(tmp_path / "mine", space=space, seeds_per_point=1, num_samples=2)
    point = {"lr": 0.5, "gamma": 0.123, "num_epochs": 20, "hidden_sizes": [8, 8]}
    add_trained(store, point)
    paths = sweeps.export("mine", "optuna", output=tmp_path / "study", storage=tmp_path)
    kept = optuna.load_study(study_name="mine", storage=f"sqlite:///{paths['study']}")
    assert kept.trials[2].params == point | {"hidden_sizes": "8x8"}


def add_trained(store: SweepStore, point: dict[str, Any]) -> None:
    """Inject a point and train it with fakes, as a driver of the sweep would."""
    record = store.read_record()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resuming, "run_sweep", lambda *_, **__: SimpleNamespace(interrupted=False))
        sweeps.inject(store.folder, point, progress="none")
    for trial in store.read_trials():
        if trial.status == "pending":
            train(store, trial.trial_id, 3)
    store.write_record(store.read_record().model_copy(update={"state": record.state}))


# -- adding it


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A finished sweep of 4 trials; whatever is to be run of it afterwards is only written."""
    made = make_sweep_folder(tmp_path / "mine")
    monkeypatch.setattr(
        resuming, "run_sweep",
        lambda store, *_, **__: SimpleNamespace(
            interrupted=False, trials=store.read_trials(), notes=(), sweep=store.read_record()
        ),
    )  # fmt: skip
    return made


def test_trials_are_added_and_what_comes_later_comes_behind(store: SweepStore) -> None:
    before = store.read_trials()
    added = sweeps.inject(store.folder, {"lr": 5e-3}, progress="none").trials
    assert added[:4] == before
    assert [(trial.trial_id, trial.point_index, trial.seed_index, trial.point) for trial in added[4:]] == [
        ("t0004", 2, 0, {"lr": 5e-3}), ("t0005", 2, 1, {"lr": 5e-3})
    ]  # fmt: skip
    record = store.read_record()
    assert record.chosen_points == chosen(2, point={"lr": 5e-3})
    assert (record.num_trials, record.spec["num_samples"]) == (6, 2)
    twin = make_sweep_folder(store.folder.parent / "twin")
    without = sweeps.extend(twin.folder, 2, progress="none").trials
    after = sweeps.extend(store.folder, 2, progress="none").trials
    assert after[:6] == added
    assert [trial.point for trial in after[6:]] == [trial.point for trial in without[4:]]
    assert store.read_record().chosen_points == record.chosen_points
    assert len(sweeps.inject(store.folder, {"lr": 6e-3}, progress="none").trials) == 12


def test_a_point_that_is_there_is_refused_by_its_trial(store: SweepStore) -> None:
    lr = store.read_trials()[2].point["lr"]
    with pytest.raises(SpecError, match="trial t0002") as caught:
        sweeps.inject(store.folder, {"lr": lr}, progress="none")
    assert f"tune-jobs replicate {store.folder}" in caught.value.hint
    assert store.read_record().chosen_points == ()


def test_in_a_thread_what_another_process_can_be_sent_is_decided_before_it_is_started(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []
    monkeypatch.setattr("tune_jobs.sweeps.apart.call_apart", lambda *request: sent.append(pickle.dumps(request)))
    wrong = {"lr": lambda: 5e-3}
    with ThreadPoolExecutor(1) as thread:
        told = [
            asked.exception()
            for asked in (
                thread.submit(sweeps.inject, store.folder, wrong),
                thread.submit(
                    sweeps.inject, store.folder, MappingProxyType({"lr": 5e-3, "more": MappingProxyType({})})
                ),
            )
        ]
    with pytest.raises(SpecError) as here:
        sweeps.inject(store.folder, wrong)
    assert here.value.message.startswith("point: lr: <function ")
    assert isinstance(told[0], SpecError)
    assert (told[0].message, told[0].hint, told[1]) == (here.value.message, here.value.hint, None)
    ((function, (_, point), _),) = map(pickle.loads, sent)
    assert pkgutil.resolve_name(function).__name__ == "inject_plain"
    assert point == {"lr": 5e-3, "more": {}}


def test_a_value_in_another_form_is_the_same_point() -> None:
    spec = make_spec()
    trial = make_plan(spec, Machine(2), chosen_points=chosen(3)).trials[3]
    records = cast("Any", [trial.model_copy(update={"point": POINT | {"hidden_sizes": 64}})])
    found = trial_of_point(spec, POINT, records)
    assert found is not None
    assert found.trial_id == "t0003"
    assert trial_of_point(spec, POINT | {"lr": 4e-3}, records) is None


def test_values_that_contradict_each_other_are_refused(tmp_path: Path, store: SweepStore) -> None:
    space = {"minibatch_size": {"grid": [32, 64]}}
    other = make_sweep_folder(tmp_path / "other", space=space, num_samples=1, hyperparams={"train_batch_size": 128})
    with pytest.raises(SpecError, match=r"The values of the new point \(minibatch_size 256\) don't go together"):
        sweeps.inject(other.folder, {"minibatch_size": 256}, progress="none")
    assert len(other.read_trials()) == 4


def test_a_record_whose_numbers_cannot_be_is_damaged(store: SweepStore) -> None:
    store.write_record(store.read_record().model_copy(update={"chosen_points": chosen(7, point={"lr": 1e-3})}))
    with pytest.raises(CheckpointError, match="is damaged: a point chosen after 7 points is of a sweep with 2"):
        sweeps.resume(store.folder, progress="none")


def test_one_that_is_killed_between_any_two_files_goes_on_and_a_repeated_job_adds_nothing_twice(
    store: SweepStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def do(folder: Path) -> list[Any]:
        request = {
            "sweep": str(folder), "verb": "inject", "arguments": {"point": {"lr": 5e-3}}, "address": None,
            "wait_for_nodes": 0.0, "num_cpus": 2.0,
        }  # fmt: skip
        return list(driver._done(request).trials)

    with kept_before_each_write(store, tmp_path) as left:
        whole = do(store.folder)
    assert [trial.trial_id for trial in whole] == [f"t{index:04d}" for index in range(6)]
    assert len(left) >= 3
    for folder in [*left, store.folder]:
        again = do(folder)
        assert [(trial.trial_id, trial.point, trial.seed) for trial in again] == [
            (trial.trial_id, trial.point, trial.seed) for trial in whole
        ]
        assert len(SweepStore(folder).read_record().chosen_points) == 1
