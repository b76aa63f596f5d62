"""The end of a log says why its last process ended: its last lines, or the frames of the thread that hung."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.narrowing import present
from tune_jobs.store.logs import begin_log, died_by, hang_in, log_tail

ROOT = Path(__file__).parents[2]
HANG = """
import faulthandler, sys, threading, time
from pathlib import Path
import numpy as np
from policies.envs import modules as env_modules
from policies.envs.checked import CheckedEnvs
from policies.envs.make import make_env, make_vector_env
from policies.acting.evaluate import Evaluator
from policies.acting.policy import RandomPolicy
from policies.packed.envs.make import make_packed_envs
from tune_jobs.store.logs import begin_log

env_modules.allow_modules(["hanging"])
for number in range(12):
    threading.Thread(target=threading.Event().wait, daemon=True).start()
begin_log("pack p00")
kind = sys.argv[1]
if kind == "packed":
    envs = make_packed_envs("hanging:Env", None, 2, kind="scalar")
    envs.add("a", 0)
    envs.step(np.zeros(2, int))
elif kind == "vector":
    envs = CheckedEnvs(make_vector_env("hanging:Env", None, 2), "hanging:Env")
    envs.reset(seed=0)
    envs.step(np.zeros(2, int))
elif kind == "evaluation":
    Evaluator("hanging:Env", None, [1]).run(RandomPolicy.for_env("CartPole-v1"))
else:
    faulthandler.dump_traceback_later(0.2, exit=True, file=sys.stdout)
    time.sleep(600)
"""
ENV = """
import faulthandler, sys, threading
from typing import Any
import gymnasium as gym, numpy as np

class Env(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (4,)), gym.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None): return np.zeros(4, np.float32), {}
    def step(self, action):
        self.simulate()
    def simulate(self):
        faulthandler.dump_traceback_later(0.2, exit=True, file=sys.stdout)
        threading.Event().wait(600)
"""


@pytest.mark.parametrize("kind", ["packed", "vector", "evaluation", "elsewhere"])
def test_a_hang_is_told_by_the_env_s_frame(tmp_path: Path, kind: str) -> None:
    (tmp_path / "hanging.py").write_text(ENV)
    log = tmp_path / "p00.log"
    log.write_text("-- pack p00, process 1\nTimeout (0:00:01)!\nof another process\n")
    with log.open("a") as file:
        code = subprocess.run(
            [sys.executable, "-c", HANG, kind],
            stdout=file,
            env={"PYTHONPATH": f"{tmp_path}:."},
            timeout=600,
            check=False,
        ).returncode  # fmt: skip
    assert code == 1
    tail = log_tail(log, "pack p00")
    assert tail.splitlines()[0] == "Timeout (0:00:00.200000)!"
    # Of the trial's thread alone, though there are a dozen.
    assert "in _bootstrap" not in tail
    has_hung, frame = hang_in(tail)
    assert has_hung
    if kind == "elsewhere":
        assert present(frame).name == "<module>"
        return
    assert str(frame) == f"{tmp_path / 'hanging.py'}:13 in simulate"
    assert died_by(tail, 12.5) == (
        "an iteration took longer than iteration_timeout_s (12.5 s). It hung at "
        f"{tmp_path / 'hanging.py'}:13 in simulate"
    )


def test_of_a_log_without_a_hang_the_last_lines_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.txt"
    assert log_tail(log) == ""
    begin_log("trial t0003")
    begun = capsys.readouterr().out
    log.write_text('Timeout (0:00:01)!\n  File "a.py", line 3 in step\n' + begun + "".join(f"{i}\n" for i in range(20)))
    assert log_tail(log, "trial t0003").splitlines() == [str(i) for i in range(5, 20)]
    assert log_tail(log, "trial t0003", 30).splitlines()[0] == begun.strip()
    assert hang_in(log_tail(log, "trial t0003")) == (False, None)
    # Of a process that ended otherwise, after one that hung.
    assert died_by(log_tail(log, "trial t0003"), 9.0) == ""


def test_frames_that_are_cut_off_are_no_error(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_text("Timeout (0:00:01)!\n")
    assert died_by(log_tail(log), 3.0) == "an iteration took longer than iteration_timeout_s (3 s)"
    assert hang_in(log_tail(log)) == (True, None)
    assert hang_in("") == (False, None)
