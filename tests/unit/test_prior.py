"""Earlier sweeps with which a search begins."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from spec_errors import MINIMAL
from test_search_methods import record

from analysis.records import PriorPointRecord, PriorRecord, TrialRecord
from policies.errors import NotFoundError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.prior import prior_notes, with_prior
from tune_jobs.search.proposal import propose_point
from tune_jobs.spec.file import load_spec, stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.prior import read_priors

SPACE: dict[str, Any] = {"lr": {"loguniform": [1e-5, 1e-1]}}
MACHINE = Machine(num_cpus=2)


def make_spec(**changes: Any) -> SweepSpec:
    return load_spec({**MINIMAL, "space": SPACE, "num_samples": 12, **changes})


def valley(lr: float) -> float:
    return 1e6 - 1e3 * abs(math.log10(lr) + 3)


@pytest.fixture
def earlier(tmp_path: Path) -> SweepStore:
    """A finished sweep `first` of twelve points, the best near 1e-3; one failed and one has not ended."""
    return write_earlier(tmp_path)


def write_earlier(storage: Path, **changes: Any) -> SweepStore:
    spec = make_spec(**changes)
    store = SweepStore(storage / "first")
    store.create()
    write_new(store, spec, make_plan(spec, MACHINE), None)
    for trial in store.read_trials():
        lr = trial.point.get("lr", 1e-3)
        ended = record(trial.index, trial.point, valley(lr))
        if trial.index == 3:
            ended = record(trial.index, trial.point, status="failed")
        if trial.index == 4:
            ended = record(trial.index, trial.point, status="running")
        store.trial(trial.trial_id).write_record(ended)
    return store


def begun(tmp_path: Path, **changes: Any) -> tuple[SweepSpec, tuple[PriorRecord, ...]]:
    spec = make_spec(prior="first", **{"search": "gp", **changes})
    return spec, read_priors(spec, tmp_path)


def test_what_ended_is_told_by_its_rank_and_what_runs_is_not(earlier: SweepStore, tmp_path: Path) -> None:
    _, (prior,) = begun(tmp_path, env="Acrobot-v1")
    assert (prior.sweep, prior.env_id, len(prior.points)) == ("first", MINIMAL["env"], 11)
    (failed,) = [item for item in prior.points if item.share is None]
    assert failed.point == earlier.read_trials()[3].point
    others = sorted((item for item in prior.points if item.share is not None), key=lambda item: item.share or 0)
    scores = [valley(item.point["lr"]) for item in others]
    assert scores == sorted(scores)
    # On the scale of the new sweep's own scores: its returns are of another task.
    own = [KnownPoint({"lr": 1e-2}, (float(score), score - 1.0)) for score in range(-500, -80, 35)]
    told = with_prior([*own, KnownPoint({"lr": 1e-4}, is_running=True)], [prior])
    assert told[11:-1] == own
    assert [item.point for item in told[:11]] == [item.point for item in prior.points]
    assert all(item.score is None or -501 <= item.score <= -80 for item in told[:11])
    # A few scores have no scale: they too count by their ranks.
    told = with_prior([own[3], own[1], KnownPoint({"lr": 1e-2}, (None,)), *own[4:5]], [prior])
    assert [item.score for item in told[11:]] == [0.625, 0.375, None, 0.875]
    assert [item.score for item in told[:11]] == [item.share for item in prior.points]
    assert with_prior(own, []) == own


def test_with_a_scheduler_a_point_counts_as_ended_early_where_the_own_point_of_its_rank_was() -> None:
    shares = [0.05, 0.45, 19.3 / 29, 0.9, None]
    points = tuple(PriorPointRecord(point={"lr": 1e-3}, share=share) for share in shares)
    prior = PriorRecord(sweep="first", env_id="Acrobot-v1", points=points)
    stopped = [KnownPoint({"lr": 1e-2}, (float(score),), level=score % 2) for score in range(20)]
    whole = [KnownPoint({"lr": 1e-2}, (-100.0 + score,)) for score in range(10)]
    told = with_prior([*whole, *stopped], [prior])[:5]
    # Of 30: the 2nd is of the first rung, the 14th of the second; the best third was not ended, whatever its scores.
    assert [item.level for item in told] == [0, 1, 1, None, None]
    assert [item.score for item in told] == [pytest.approx(score) for score in (2.9, 7.1, 19.0, -93.9)] + [None]


@pytest.mark.parametrize("method", ["gp", "tpe"])
def test_the_model_proposes_from_the_second_point_on_and_where_the_earlier_sweep_was_good(
    method: str, earlier: SweepStore, tmp_path: Path
) -> None:
    if method == "tpe":
        pytest.importorskip("optuna")
    spec, prior = begun(tmp_path, search=method, num_samples=5)
    plan = make_plan(spec, MACHINE, prior=prior)
    assert [trial.has_point for trial in plan.trials] == [True, False, False, False, False]
    assert any("begins with 11 points of sweep first" in note for note in plan.notes)
    records: list[TrialRecord] = [record(0, plan.trials[0].point, -200.0)]
    with_it = [propose_point(spec, records, 1 + k, lambda _: None, prior)["lr"] for k in range(4)]
    without = [propose_point(spec, records, 1 + k, lambda _: None)["lr"] for k in range(4)]
    far = [sum(abs(math.log10(lr) + 3) for lr in each) for each in (with_it, without)]
    assert with_it != without
    # TPE has two good points of twelve, whose densities are as wide as the space.
    assert method == "tpe" or far[0] < 0.6 * far[1]


def test_it_is_fixed_when_the_sweep_is_created(earlier: SweepStore, tmp_path: Path) -> None:
    file = tmp_path / "sweep.json"
    file.write_text(json.dumps({**MINIMAL, "space": SPACE, "num_samples": 12, "search": "gp", "prior": ["first"]}))
    created = verbs.create(file, name="second", storage=tmp_path)
    store = SweepStore(Path(created.place))
    kept = store.read_record()
    shutil.rmtree(earlier.folder)
    spec = stored_spec(kept)
    assert spec.prior == ("first",)
    assert len(kept.prior[0].points) == 11
    again = PriorRecord.model_validate(json.loads(kept.prior[0].model_dump_json()))
    records = [record(0, store.read_trials()[0].point, 1.0)]
    points = [propose_point(spec, records, 1, lambda _: None, [each]) for each in (kept.prior[0], again)]
    assert points[0] == points[1]
    assert make_plan(spec, MACHINE, store.read_trials(), chosen_points=()).num_points == 12
    with pytest.raises(NotFoundError, match="first"):
        read_priors(spec, tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"algorithm": "dqn"}, ["algorithm is ppo, and not dqn"]),
        ({"space": {**SPACE, "gamma": {"uniform": [0.9, 0.99]}}}, ["gamma is searched here, and neither"]),
        ({"space": {"gamma": {"uniform": [0.9, 0.99]}}}, ["gamma is searched here", "lr is searched there"]),
        ({"space": {"lr": {"uniform": [0.5, 0.6]}}}, ["none of its 11 ended points lies in this space"]),
    ],
)
def test_a_sweep_that_differs_is_refused_with_what_differs(
    changes: dict[str, Any], words: list[str], earlier: SweepStore, tmp_path: Path
) -> None:
    with pytest.raises(SpecError) as caught:
        begun(tmp_path, **changes)
    assert all(word in caught.value.message for word in ["prior: sweep first", *words]), caught.value.message


def test_points_that_this_space_does_not_have_are_counted(earlier: SweepStore, tmp_path: Path) -> None:
    _, (whole,) = begun(tmp_path)
    middle = sorted(item.point["lr"] for item in whole.points)[5]
    narrower = {"lr": {"loguniform": [middle * 0.999, 1e-1]}}
    spec, (prior,) = begun(tmp_path, space=narrower)
    assert (len(prior.points), prior.num_ended) == (6, 11)
    assert prior_notes(spec, [prior]) == ("The model begins with 6 of the 11 ended points of sweep first.",)
    former = prior.model_copy(update={"num_ended": None})
    assert prior_notes(spec, [former]) == ("The model begins with 6 points of sweep first.",)


def test_a_name_that_was_fixed_there_has_that_value(tmp_path: Path) -> None:
    write_earlier(tmp_path, hyperparams={"gamma": 0.95})
    _, (prior,) = begun(tmp_path, space={**SPACE, "gamma": {"uniform": [0.9, 0.99]}})
    assert {item.point["gamma"] for item in prior.points} == {0.95}


@pytest.mark.parametrize("domain", [{"choice": [20_000, 50_000]}, {"lograndint": [10_000, 60_000]}])
def test_trainings_that_were_all_of_one_length_there_have_that_length(tmp_path: Path, domain: dict[str, Any]) -> None:
    write_earlier(tmp_path, stop={"num_env_steps": 50_000})
    _, (prior,) = begun(tmp_path, space={**SPACE, "stop.num_env_steps": domain})
    assert len(prior.points) == 11
    assert {item.point["stop.num_env_steps"] for item in prior.points} == {50_000}


def test_trainings_of_a_length_that_is_not_searched_here_tell_nothing(tmp_path: Path) -> None:
    """As any value that was fixed there and lies outside of what is searched."""
    write_earlier(tmp_path, stop={"num_env_steps": 50_000}, hyperparams={"gamma": 0.95})
    for name, domain in (("stop.num_env_steps", {"choice": [20_000, 40_000]}), ("gamma", {"uniform": [0.96, 0.99]})):
        with pytest.raises(SpecError, match="none of its 11 ended points lies in this space"):
            begun(tmp_path, space={**SPACE, name: domain})


def test_a_length_that_did_not_act_there_was_that_of_the_sweep(tmp_path: Path) -> None:
    kinds = {"activation": {"choice": ["tanh", "relu"]}}
    length = {"choice": [20_000, 50_000]}
    write_earlier(tmp_path, space={**SPACE, **kinds, "stop.num_env_steps": {**length, "when": {"activation": "tanh"}}})
    _, (prior,) = begun(tmp_path, space={**SPACE, **kinds, "stop.num_env_steps": length})
    assert len(prior.points) == 11
    idle = [item.point for item in prior.points if item.point["activation"] == "relu"]
    assert idle
    assert {point["stop.num_env_steps"] for point in idle} == {50_000}


LAYERS = {"layers": {"number": 1, "sizes": [64, 128]}}


@pytest.mark.parametrize(
    ("there", "name", "domain", "expected"),
    [
        ({"hyperparams": {"hidden_sizes": 64}}, "hidden_sizes", {"choice": [[64], [128]]}, [[64]]),
        ({"hyperparams": {"hidden_sizes": 64}}, "hidden_sizes", {"choice": [64, 128]}, [64]),
        ({"hyperparams": {"hidden_sizes": 64}}, "hidden_sizes", LAYERS, [[64]]),
        ({"space": {"hidden_sizes": {"choice": [64, 128]}}}, "hidden_sizes", {"choice": [[64], [128]]}, [[64], [128]]),
        ({"space": {"hidden_sizes": {"choice": [64, 128, 32]}}}, "hidden_sizes", LAYERS, [[64], [128]]),
        ({"hyperparams": {"gae_lambda": 1}}, "gae_lambda", {"choice": [1.0, 0.9]}, [1.0]),
        ({"space": {"train_batch_size": {"choice": [1024.0, 2048.0]}}}, "train_batch_size",
         {"choice": [1024, 2048]}, [1024, 2048]),
        ({"space": {"train_batch_size": {"choice": [1024.0, 2048.0]}}}, "train_batch_size",
         {"power_of_two": [512, 1024]}, [1024]),
        ({"space": {"num_epochs": {"quniform": [1, 2, 1]}}}, "num_epochs", {"choice": [1, 2]}, [1, 2]),
    ],
)  # fmt: skip
def test_a_value_that_is_written_in_another_form_there_is_the_same(
    there: dict[str, Any], name: str, domain: dict[str, Any], expected: list[Any], tmp_path: Path
) -> None:
    write_earlier(tmp_path, **{**there, "space": {**SPACE, **there.get("space", {})}})
    _, (prior,) = begun(tmp_path, space={**SPACE, name: domain})
    found = {json.dumps(item.point[name]) for item in prior.points}
    assert found == set(map(json.dumps, expected))


def test_a_value_that_the_hyperparameter_or_its_range_cannot_have_is_outside(tmp_path: Path) -> None:
    write_earlier(tmp_path, space={**SPACE, "grad_clip": {"choice": [None, 0.5, 1]}})
    _, (prior,) = begun(tmp_path, space={**SPACE, "grad_clip": {"uniform": [0.1, 1.0]}})
    assert {repr(item.point["grad_clip"]) for item in prior.points} == {"0.5", "1.0"}


def test_a_point_has_what_acts_in_the_new_space_and_one_that_lacks_some_of_it_is_left_out(tmp_path: Path) -> None:
    replay = {"choice": ["uniform", "prioritized"]}
    alpha = {"uniform": [0.1, 0.9]}
    bound = {**alpha, "when": {"replay": "prioritized"}}
    dqn = {"algorithm": "dqn", "search": "gp"}
    write_earlier(tmp_path, algorithm="dqn", space={"replay": replay, "prioritized_alpha": alpha})
    _, (prior,) = begun(tmp_path, **dqn, space={"replay": replay, "prioritized_alpha": bound})
    assert len(prior.points) == 11
    assert {(item.point["replay"], "prioritized_alpha" in item.point) for item in prior.points} == {
        ("uniform", False), ("prioritized", True),
    }  # fmt: skip
    shutil.rmtree(tmp_path / "first")
    write_earlier(tmp_path, algorithm="dqn", space={"replay": replay, "prioritized_alpha": bound})
    _, (prior,) = begun(tmp_path, **dqn, space={"replay": replay, "prioritized_alpha": alpha})
    assert 0 < len(prior.points) < 11
    assert {item.point["replay"] for item in prior.points} == {"prioritized"}


def test_a_population_and_a_sweep_in_which_nothing_has_ended_tell_nothing(tmp_path: Path) -> None:
    write_earlier(tmp_path, scheduler="pbt")
    with pytest.raises(SpecError, match="population"):
        begun(tmp_path)
    shutil.rmtree(tmp_path / "first")
    store = write_earlier(tmp_path)
    for trial in store.read_trials():
        store.trial(trial.trial_id).write_record(record(trial.index, trial.point, status="pending"))
    with pytest.raises(SpecError, match="no point has ended"):
        begun(tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"prior": "first"}, "prior: is for a search that learns, and search.type is random"),
        ({"prior": ["a", "b", "a"], "search": "gp"}, "prior: names 'a' twice"),
        ({"prior": 3, "search": "gp"}, "prior"),
        ({"prior": "", "search": "gp"}, "prior"),
        ({"prior": {"a": 1}, "search": "gp"}, "prior"),
    ],
)
def test_a_wrong_field_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=words):
        make_spec(**changes)


def test_what_is_not_there_and_a_place_where_only_names_are_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="prior: No sweep 'first'"):
        begun(tmp_path)
    spec = make_spec(prior=str(tmp_path / "first"), search="gp")
    with pytest.raises(SpecError, match="no name of a sweep"):
        read_priors(spec, tmp_path, by_name=True)


@pytest.mark.usefixtures("earlier")
@pytest.mark.parametrize("other", ["{storage}/first", "{storage}/second", "{storage}/../{folder}/first"])
def test_a_sweep_under_two_names_is_refused(other: str, tmp_path: Path) -> None:
    (tmp_path / "second").symlink_to(tmp_path / "first")
    spec = make_spec(prior=["first", other.format(storage=tmp_path, folder=tmp_path.name)], search="gp")
    with pytest.raises(SpecError, match=r"prior: 'first' and '.* are the same sweep"):
        read_priors(spec, tmp_path)
