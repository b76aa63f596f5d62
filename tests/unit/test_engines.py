"""The table of engines: its entries name what is there, a further one needs nothing else, checkpoints name theirs."""

import ast
import dataclasses
import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task
from pack_plans import plan
from spec_errors import MINIMAL

from policies.acting.evaluate import Evaluator
from policies.errors import CheckpointError, SpecError
from tests.narrowing import present
from tune_jobs import restore
from tune_jobs.plan.engine_choice import choose_engines, may_pack
from tune_jobs.spec import engines
from tune_jobs.spec.engines import ENGINES, Engine, engine_on_record
from tune_jobs.spec.file import load_spec
from tune_jobs.store.manifests import read_engine_name, verify_checkpoint
from tune_jobs.store.record_files import seal
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.drive import write_new
from tune_jobs.training.registry import engine_of_checkpoint, make_engine
from tune_jobs.training.trial_loop import TrialLoop

TESTS = Path(__file__).parents[1]
OLD = {
    "packed": TESTS / "unit/samples/packed_of_format_2/trials/t0000/checkpoints/000002",
    "rllib": TESTS / "ray/samples/rllib_of_format_2/ppo/trials/t0000/checkpoints/000002",
}


def named(path: str) -> list[ast.stmt]:
    """What of a module's own is called so, without running it."""
    module, _, name = path.partition(":")
    source = Path(present(present(importlib.util.find_spec(module)).origin)).read_text()
    return [node for node in ast.parse(source).body if getattr(node, "name", None) == name]


@pytest.mark.parametrize("engine", ENGINES, ids=lambda engine: engine.name)
def test_an_entry_names_what_is_there(engine: Engine) -> None:
    for path in filter(None, (engine.constructor, engine.restore)):
        assert len(named(path)) == 1, path
    methods = {
        node.name
        for node in cast("ast.ClassDef", named(engine.constructor)[0]).body
        if isinstance(node, ast.FunctionDef)
    }
    assert ("add" in methods, "build" in methods) == (engine.trains_many, not engine.trains_many)


def test_every_algorithm_has_an_engine_that_takes_what_no_other_can() -> None:
    for algorithm in ("ppo", "dqn", "random", "constant"):
        assert not engines.engines_for(algorithm)[-1].lacks


# -- a fourth one


def restored(checkpoint: Path) -> str:
    """What the fourth engine restores to: no RLlib is loaded for it here."""
    return f"restored from {checkpoint.name}"


@pytest.fixture
def fourth(monkeypatch: pytest.MonkeyPatch) -> Engine:
    """One more entry, and first of all."""
    entry = Engine(
        name="scripted", title="the script", trained="scripted", about="does as a script says",
        algorithms=frozenset({"ppo"}), constructor="fake_engine:FakeEngine", restore="test_engines:restored",
        lacks={"pauses": "which no script does", "convolutions": "and scripts have none"},
    )  # fmt: skip
    monkeypatch.setattr(engines, "ENGINES", (entry, *ENGINES))
    return entry


def test_a_further_engine_is_one_entry_and_its_module(tmp_path: Path, fourth: Engine) -> None:
    made = plan(num_samples=1, seeds_per_point=1)
    assert (made.engines, made.packs, made.notes) == ({"scripted": 1}, None, ())
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, load_spec({**MINIMAL}), made, None)
    record = store.trial("t0000").read_record()
    task = dataclasses.replace(make_task(store.folder, stop={"num_iterations": 2}), engine=record.engine)
    engine = make_engine(record.engine)
    assert isinstance(engine, FakeEngine)
    loop = TrialLoop(task, engine, cast("Evaluator", FakeEvaluator()), FakeClock())
    loop.open()
    while loop.advance(0.0).status == "running":
        pass
    # There is a folder called rllib in it, too: what the manifest says counts.
    checkpoint = store.trial("t0000").checkpoint_folder(2)
    assert (checkpoint / "rllib").is_dir()
    assert engine_of_checkpoint(checkpoint) == fourth
    assert restore("mine/t0000", storage=tmp_path) == "restored from 000002"


def test_what_a_further_engine_cannot_hold_goes_to_the_others_and_it_is_told_why(fourth: Engine) -> None:
    made = plan(scheduler="hyperband")
    assert made.engines == {"packed": 10}
    why = "scheduler.type is hyperband, which no script does"
    assert made.notes == (f"No trial is scripted, the packed engine trains them all: {why}.",)
    assert plan(algorithm="dqn").engines == {"packed": 10}
    # Wished for, it is refused, trial by trial.
    spec = load_spec({**MINIMAL, "space": {"conv_filters": {"grid": [None, [[4, 8, 4]]]}}})
    wish = spec.model_copy(update={"engine": "scripted"})
    with pytest.raises(SpecError, match=r"engine is scripted, but here cannot be: conv_filters .*, and scripts have"):
        choose_engines(wish, cast("Any", None), [("t0000", None)], {}, lambda index: "here")


# -- records and manifests


def test_a_trial_goes_on_with_the_engine_of_its_record() -> None:
    assert engine_on_record("packed", "dqn").name == "packed"
    # Records named none when there were baselines already, and reads as rllib.
    assert engine_on_record("rllib", "constant").name == "baseline"
    with pytest.raises(CheckpointError, match="'jax', which this tune-jobs does not have; it has packed, rllib, bas"):
        engine_on_record("jax", "ppo")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    task = dataclasses.replace(make_task(tmp_path, stop={"num_iterations": 1}), engine="packed")
    loop = TrialLoop(task, FakeEngine(), cast("Evaluator", FakeEvaluator()), FakeClock())
    loop.open()
    assert loop.advance(0.0).status == "completed"
    return SweepStore(tmp_path).trial("t0000").checkpoint_folder(1)


def edit(checkpoint: Path, *, sealed: bool, **changes: Any) -> None:
    path = checkpoint / "manifest.json"
    data = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(data | ({"sha256": seal(data)} if sealed else {})))


def test_the_seal_of_a_manifest_covers_the_engine(checkpoint: Path) -> None:
    verify_checkpoint(checkpoint)
    assert read_engine_name(checkpoint) == engine_of_checkpoint(checkpoint).name == "packed"
    edit(checkpoint, sealed=False, engine="rllib")
    for read in (verify_checkpoint, read_engine_name, engine_of_checkpoint):
        with pytest.raises(CheckpointError, match="SHA-256 differs"):
            read(checkpoint)


def test_an_engine_that_is_no_name_or_not_known_is_refused(checkpoint: Path) -> None:
    edit(checkpoint, sealed=True, engine="jax")
    verify_checkpoint(checkpoint)
    with pytest.raises(CheckpointError, match=r"manifest of checkpoint .*000001 names the engine 'jax'"):
        engine_of_checkpoint(checkpoint)
    values: tuple[Any, ...] = (7, ["packed"], {})
    for value in values:
        edit(checkpoint, sealed=True, engine=value)
        with pytest.raises(CheckpointError, match=r"engine is .*, not a name"):
            verify_checkpoint(checkpoint)


@pytest.mark.parametrize("name", OLD)
def test_a_manifest_of_before_is_told_by_what_its_folder_holds(tmp_path: Path, name: str) -> None:
    folder = shutil.copytree(OLD[name], tmp_path / "000002")
    verify_checkpoint(folder)
    assert "engine" not in json.loads((folder / "manifest.json").read_text())
    assert engine_of_checkpoint(folder).name == name
    (folder / name).rename(folder / "something")
    with pytest.raises(CheckpointError, match="does not hold the state of any engine"):
        engine_of_checkpoint(folder)


@pytest.mark.parametrize(
    ("changed", "may"),
    [
        ({}, True),
        ({"algorithm": "dqn"}, True),
        ({"engine": "packed"}, True),
        ({"engine": "rllib"}, False),
        ({"algorithm": "random", "space": {}}, False),
    ],
)
def test_a_file_tells_whether_trials_may_be_packed(changed: dict[str, Any], may: bool) -> None:
    assert may_pack(load_spec(MINIMAL | changed)) is may
