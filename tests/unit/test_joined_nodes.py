"""A process on a node that joined while a sweep ran: what it says if the node can't take part; Ray is faked."""

import json
import pickle
import types
from pathlib import Path
from typing import Any

import pytest
from ray.exceptions import RayTaskError
from ray.tune import PlacementGroupFactory
from ray.tune.experiment import Trial
from sweep_folders import make_sweep_folder
from tune_trial import TuneTrial

from tune_jobs.process.ran_with import versions
from tune_jobs.ray_tune import joined_nodes
from tune_jobs.ray_tune.joined_nodes import refusal
from tune_jobs.ray_tune.lost_nodes import NodeLosses, NodeRefusedError
from tune_jobs.ray_tune.pack_trainable import PackTrainable
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.run_trials import RunJob, _Run
from tune_jobs.ray_tune.trainable import TrialTrainable
from tune_jobs.store.sweep_store import SweepStore

NODE_ID = "ab" * 28


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    monkeypatch.setattr("ray.get_runtime_context", lambda: types.SimpleNamespace(get_node_id=lambda: NODE_ID))
    monkeypatch.setattr("ray.util.get_node_ip_address", lambda: "10.0.0.7")
    monkeypatch.setattr("ray.get_gpu_ids", list)
    return make_sweep_folder(tmp_path / "mine")


def config(store: SweepStore, **changed: str) -> dict[str, Any]:
    told = json.dumps({**versions(), **changed})
    return {"sweep_place": store.place, "trial_id": "t0000", "pack_id": "p00", "versions": told}


def test_a_node_like_those_of_the_start_is_used(store: SweepStore) -> None:
    assert refusal(config(store)) is None


def test_where_no_node_can_join_nothing_is_looked_at(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joined_nodes, "open_sweep", None)
    monkeypatch.setattr(joined_nodes, "versions", None)
    assert refusal({"sweep_place": store.place, "trial_id": "t0000"}) is None


@pytest.mark.parametrize("address", [None, "10.0.0.1:6379"])
def test_the_driver_tells_its_versions_where_nodes_can_join(store: SweepStore, address: str | None) -> None:
    store.write_record(store.read_record().model_copy(update={"address": address}))
    owner = store.take()
    job = RunJob(store.place, ("t0000",), cpus_per_trial=1, gpus_per_trial=0, max_concurrent=1)
    run = _Run(job, store, lambda _: None, owner, RayWatch({}, grace_s=1.0))
    told = run._config
    run.keeper.close()
    assert ("versions" in told) is (address is not None)
    assert address is None or json.loads(told["versions"]) == versions()


def test_versions_are_compared_with_the_drivers(store: SweepStore) -> None:
    found = refusal(config(store, ray="2.59.0", numpy="1.0"))
    assert found is not None
    ours = versions()
    assert found.message == (
        "Node 10.0.0.7 (abababab) cannot take part in the sweep: it "
        f"has Ray {ours['ray']}, the sweep's driver has 2.59.0; has numpy {ours['numpy']}, the sweep's driver has 1.0."
    )
    assert found.hint.startswith("Install the same versions everywhere")
    # Ray carries it to the driver.
    assert pickle.loads(pickle.dumps(found)).node_id == NODE_ID


def test_storage_modules_and_gpus_that_are_not_there_are_named(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.write_record(store.read_record().model_copy(update={"allowed_modules": ("json.decoder", "not_there.envs")}))
    monkeypatch.setattr("ray.get_gpu_ids", lambda: [0])
    monkeypatch.setattr(joined_nodes, "uses_gpus", lambda: False)
    found = refusal(config(store))
    assert found is not None
    assert "it cannot import the module not_there.envs: No module named 'not_there'; offers 1 GPU, but" in found.message
    gone = refusal({**config(store), "sweep_place": f"{store.place}-elsewhere"})
    assert gone is not None
    assert f"it does not see the sweep folder {store.place}-elsewhere" in gone.message
    assert not Path(f"{store.place}-elsewhere").exists()


@pytest.mark.parametrize("kind", [TrialTrainable, PackTrainable])
def test_a_process_that_is_refused_begins_nothing(store: SweepStore, kind: Any) -> None:
    before = sorted(store.folder.rglob("*"))
    # Its own set-up is that of a process of Ray.
    process: Any = kind.__new__(kind)
    if kind is TrialTrainable:
        process._refusal = refusal(config(store, ray="2.59.0"))
        process.load_checkpoint("not read")
    else:
        process.setup(config(store, ray="2.59.0"))
    with pytest.raises(NodeRefusedError, match=r"has Ray .*the sweep's driver has 2\.59\.0"):
        process.step()
    if kind is PackTrainable:
        process.cleanup()
    assert sorted(store.folder.rglob("*")) == before


def test_a_trial_that_is_refused_has_not_failed_and_goes_elsewhere_but_not_for_ever() -> None:
    trial, losses = TuneTrial(), NodeLosses(lambda trial: 0, lambda error: None)
    asked = trial.placement_group_factory
    with losses.not_counted():
        for node_id in ("b" * 56, "a" * 56, "c" * 56, "d" * 56, "e" * 56):
            error = NodeRefusedError("Node 10.0.0.7 has Ray 1.", "Install it.", node_id)
            Trial.handle_error(trial, RayTaskError("step", "a traceback", error))
            assert trial.run_metadata.num_failures == 0
            assert losses.take(trial) == "Node 10.0.0.7 has Ray 1. Install it."
            if node_id.startswith("a"):
                away = {"ray.io/node-id": f"!in({'a' * 56},{'b' * 56})"}
                assert trial.placement_group_factory == PlacementGroupFactory(
                    asked.bundles, strategy="SPREAD", bundle_label_selector=[away, away]
                )
        Trial.handle_error(trial, RayTaskError("step", "a traceback", error))
    assert (trial.run_metadata.num_failures, losses.take(trial)) == (1, "")
