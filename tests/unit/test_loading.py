"""A policy is loaded from where its sweep is kept."""

import subprocess
import sys
from pathlib import Path

import pytest
from policy_factory import make_portable
from store_parts import make_best, make_sweep
from stores import ObjectHarness

import tune_jobs
from policies.errors import NotFoundError
from policies.portable.file import save_policy


def test_a_sweeps_best_is_loaded_by_its_url(tmp_path: Path) -> None:
    sweep = ObjectHarness(tmp_path).storage().sweep("mine")
    sweep.create()
    with pytest.raises(NotFoundError, match="mine"):
        tune_jobs.load_policy(sweep.place)
    sweep.write_record(make_sweep())
    with pytest.raises(NotFoundError, match="no best policy yet"):
        tune_jobs.load_policy(sweep.place)
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    assert tune_jobs.load_policy(sweep.place).env_id == "CartPole-v1"


def test_a_file_is_loaded_without_ray_torch_or_what_asks_an_object_store(tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    code = (
        f"import sys, tune_jobs; print(tune_jobs.load_policy({str(tmp_path)!r}).env_id); "
        "print({'ray', 'torch', 'obstore', 'tune_jobs.sweeps.verbs'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["CartPole-v1", "set()"]
