"""Records hold numbers that are NaN or infinite, and their files give them back."""

import json
import math
from types import NoneType, UnionType
from typing import Annotated, Any, Union, cast, get_args, get_origin

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from synthetic_sweep import make_sweep

from analysis.best_records import BestRecord, EvaluationRecord
from analysis.records import ChangeRecord, CheckpointRecord, IterationRecord, SweepRecord, TrialRecord
from tests.narrowing import present
from tune_jobs.store.manifests import read_manifest
from tune_jobs.store.sweep_store import SweepStore

SYNTHETIC = make_sweep(points=[{"lr": 0.1}])
CHANGE = ChangeRecord(
    iteration=1, num_env_steps=5, source_trial_id="t0001", source_iteration=1, before={}, after={}, time=1.0
)
TRIAL = SYNTHETIC.trials[0]
CHECKPOINT = TRIAL.checkpoints[0].model_copy(update={"iteration": 1})
SAMPLES: dict[Any, BaseModel | None] = {
    CheckpointRecord: CHECKPOINT,
    IterationRecord: SYNTHETIC.results["t0000"][0],
    ChangeRecord: CHANGE,
    TrialRecord: TRIAL.model_copy(update={"changes": (CHANGE,)}),
    EvaluationRecord: present(SYNTHETIC.best).confirmation,
    BestRecord: SYNTHETIC.best,
    SweepRecord: SYNTHETIC.sweep,
}
ANY_SETTINGS = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _values(annotation: Any) -> st.SearchStrategy[Any] | None:
    """Values of a field's type, if there are numbers of any size in it."""
    if annotation is float or annotation in SAMPLES:
        return st.floats() if annotation is float else _records(annotation)
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _values(arguments[0])
    if origin in (Union, UnionType):
        found = [values for argument in arguments if (values := _values(argument)) is not None]
        return st.one_of(*([st.none()] if NoneType in arguments else []), *found) if found else None
    if origin in (tuple, dict):
        inner = _values(arguments[0 if origin is tuple else 1])
        if inner is not None and origin is dict:
            return st.dictionaries(st.sampled_from("abc"), inner, max_size=3)
        return None if inner is None else st.lists(inner, min_size=1, max_size=3).map(tuple)
    return None


def _records(kind: type[BaseModel]) -> st.SearchStrategy[Any]:
    """Records of a kind whose numbers may be anything; all else is as in a real one."""
    drawn = {
        name: values for name, field in kind.model_fields.items() if (values := _values(field.annotation)) is not None
    }
    fixed = {name: getattr(SAMPLES[kind], name) for name in kind.model_fields if name not in drawn}
    return st.builds(kind, **{name: st.just(value) for name, value in fixed.items()}, **drawn)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    store = SweepStore(tmp_path_factory.mktemp("storage") / SYNTHETIC.sweep.name)
    store.create()
    store.trial("t0000").folder.mkdir()
    return store


def _write(store: SweepStore, record: BaseModel) -> tuple[Any, str]:
    """Write a record as the product does; returns what it reads back, and the file's text."""
    trial = store.trial("t0000")
    if isinstance(record, SweepRecord):
        store.write_record(record)
        return store.read_record(), store.record_path.read_text()
    if isinstance(record, TrialRecord):
        trial.write_record(record)
        return trial.read_record(), trial.record_path.read_text()
    if isinstance(record, BestRecord):
        store.write_best(record)
        return store.read_best(), (store.best_folder / "evaluation.json").read_text()
    if isinstance(record, CheckpointRecord):
        trial.write_checkpoint(record, lambda folder: None)
        folder = store.folder / record.path
        return read_manifest(folder), (folder / "manifest.json").read_text()
    trial.keep_iterations([])
    trial.append_iterations([cast("IterationRecord", record)])
    (found,) = trial.read_iterations()
    return found, trial.results_path.read_text()


def _refuse(token: str) -> None:
    raise ValueError(f"{token} is no JSON")


@pytest.mark.parametrize("kind", [IterationRecord, TrialRecord, BestRecord, SweepRecord, CheckpointRecord])
def test_a_record_with_any_numbers_comes_back_from_its_file(store: SweepStore, kind: type[BaseModel]) -> None:
    @ANY_SETTINGS
    @given(record=_records(kind))
    def check(record: BestRecord | CheckpointRecord | IterationRecord) -> None:
        found, text = _write(store, record)
        # By their texts: NaN does not equal itself.
        assert repr(found.model_dump()) == repr(record.model_dump())
        json.loads(text, parse_constant=_refuse)

    check()


def test_nan_and_the_infinities_are_told_apart_in_files(store: SweepStore) -> None:
    values = (math.nan, math.inf, -math.inf, 1.0)
    record = present(SAMPLES[IterationRecord]).model_copy(
        update={"episode_returns": values, "learner": {"loss": math.inf}}
    )
    found, text = _write(store, record)
    assert '["NaN","Infinity","-Infinity",1.0]' in text
    assert repr(found.episode_returns) == repr(values)
    assert found.learner == {"loss": math.inf}


def test_null_in_files_of_older_versions_is_nan(store: SweepStore) -> None:
    trial = store.trial("t0000")
    line = {"iteration": 1, "num_env_steps": 9, "num_episodes": 2, "time_s": 1.5, "episode_returns": [None, 3.0]}
    trial.results_path.write_text(json.dumps(line | {"episode_lengths": [4, 5], "learner": {"loss": None}}) + "\n")
    (found,) = trial.read_iterations()
    assert math.isnan(found.episode_returns[0])
    assert found.episode_returns[1] == 3.0
    assert found.learner == {"loss": None}
    best = json.loads(present(SAMPLES[BestRecord]).model_dump_json()) | {"selection_score": None, "format_version": 1}
    best["confirmation"]["returns"][0] = None
    store.write_best(cast("BestRecord", SAMPLES[BestRecord]))
    (store.best_folder / "evaluation.json").write_text(json.dumps(best))
    winner = store.read_best()
    assert math.isnan(winner.selection_score)
    assert math.isnan(winner.confirmation.mean_return)


@ANY_SETTINGS
@given(record=_records(EvaluationRecord))
def test_means_of_any_returns_raise_nothing(record: EvaluationRecord) -> None:
    assert isinstance(record.mean_return, float)
    assert isinstance(record.std_return, float)
    assert record.solved in (True, False, None)


def test_a_score_that_is_not_finite_is_none(store: SweepStore) -> None:
    for value in (math.nan, math.inf, -math.inf):
        record = present(SAMPLES[CheckpointRecord]).model_copy(update={"evaluation_return": value})
        assert CheckpointRecord.model_validate_json(record.model_dump_json()).evaluation_return is None


@pytest.mark.parametrize(
    ("written", "section"),
    [({"type": "area", "seed": 1}, {"type": "area", "seed": 1}), ("area", {"type": "area"}), (None, {}), ([1], {})],
)
def test_a_section_of_the_sweep_file_is_a_mapping_whatever_was_written(written: Any, section: dict[str, Any]) -> None:
    sweep = SYNTHETIC.sweep.model_copy(update={"spec": {"objective": written}})
    assert dict(sweep.section("objective")) == section
    assert dict(sweep.section("stop")) == {}
