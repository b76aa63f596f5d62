"""A trial or pack whose environment hangs as soon as it is made: its process ends as with one that hangs later."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.drive import write_new

pytestmark = pytest.mark.ray

ROOT = Path(__file__).parents[2]
OPENED = {
    "trial": """
from tune_jobs.ray_tune.trainable import TrialLog, TrialTrainable
trial = TrialTrainable.__new__(TrialTrainable)
trial._log, trial._evaluators, trial._engine, trial._run = TrialLog(), {}, None, None
trial._open(folder, "t0000")
""",
    "pack": """
from concurrent.futures import ThreadPoolExecutor
from tune_jobs.ray_tune.pack_trainable import PackTrainable, TaskReader
pack = PackTrainable.__new__(PackTrainable)
pack._ahead = ThreadPoolExecutor(1)
pack._reading = pack._ahead.submit(TaskReader, folder)
pack._config = {"sweep_place": folder, "engine": "packed", "env_kind": "scalar", "num_env_processes": 0}
pack._owner, pack._file = None, open(Path(folder) / "trials/t0000/log.txt", "ab")
pack._open()
""",
}


@pytest.mark.parametrize("what", OPENED)
def test_an_env_that_hangs_when_it_is_made_ends_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    tests = str(ROOT / "tests" / "unit")
    monkeypatch.syspath_prepend(tests)
    allow_modules(["hostile_envs"])
    flag = tmp_path / "hostile"
    args = {"how": "hang", "where": "constructor", "only_after": str(flag)}
    spec = load_spec(
        {"env": {"id": "hostile_envs:Hostile", "args": args}, "algorithm": "ppo", "iteration_timeout_s": 2}
    )
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, make_plan(spec, Machine(1)), None)
    flag.touch()
    code = f"from pathlib import Path\nfolder = {str(store.folder)!r}\n{OPENED[what]}"
    paths = os.pathsep.join([tests, str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": paths}, timeout=300, check=False
    )  # fmt: skip
    assert done.returncode == 1
    log = store.trial("t0000").log_path.read_text()
    assert "Timeout" in log
    assert "hostile_envs.py" in log
