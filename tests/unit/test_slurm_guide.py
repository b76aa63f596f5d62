"""The batch scripts of the guide to Slurm, with programs that note their call in the place of all that they call."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "slurm.md"
ONE, SEVERAL = (block for block in GUIDE.read_text().split("```\n") if block.startswith("#!/bin/bash"))
JOB = {"SLURM_JOB_ID": "17", "SLURM_NNODES": "4", "SLURM_CPUS_PER_TASK": "16", "SLURM_GPUS_ON_NODE": "2"}
ADDRESS = "10.0.0.7:20017"
PROGRAMS = {
    # A head from the second time on that somebody asks, once it was started, and one node more each time, up to four.
    "ray": 'echo "ray $*" >> calls\n'
    'case "$1" in\n'
    '  health-check) grep -q -- --head calls && test "$(grep -c health-check calls)" -ge 2;;\n'
    "  status) asked=$(grep -c status calls); grep -q -- --exclude calls || asked=0\n"
    '    for node in $(seq $((asked > 3 ? 4 : asked + 1))); do echo " 1 node_$node"; done;;\n'
    "esac\n",
    # It runs as long as the job, unless FAILS says for which nodes it ends at once.
    "srun": 'echo "srun $RAY_AUTH_MODE ${#RAY_AUTH_TOKEN} $*" >> calls\n'
    'test "$1" = "$FAILS" || exec tail --pid=$PPID -s 0.1 -f /dev/null\n',
    "tune-jobs": 'echo "tune-jobs $$ $RAY_AUTH_MODE ${#RAY_AUTH_TOKEN} $*" >> calls\nmkdir -p sweeps/acrobot\n'
    "exit 130\n",
    "hostname": 'if [ "$1" = -I ]; then echo "10.0.0.7 172.17.0.1 "; else echo n1; fi\n',
    "openssl": 'test "$*" = "rand -hex 32" && printf "%064d\\n" 7\n',
    "sleep": "",
}


class Batch:
    """A folder in which scripts are run as Slurm does."""

    def __init__(self, cwd: Path) -> None:
        self.cwd = cwd
        (cwd / "bin").mkdir()
        for name, body in PROGRAMS.items():
            (cwd / "bin" / name).write_text(f"#!/bin/bash\n{body}")
            (cwd / "bin" / name).chmod(0o755)

    def run(self, script: str, job: dict[str, str] = JOB) -> list[str]:
        """Run a script, which has to end as `tune-jobs` does, in its process; what was called."""
        pid, code, err, (*calls, last) = self.outcome(script, job)
        assert (code, err) == (130, "")
        # What SIGTERM is sent to.
        assert last.startswith(f"tune-jobs {pid} ")
        return [*calls, last.replace(f"{pid} ", "")]

    def outcome(self, script: str, job: dict[str, str]) -> tuple[int, int, str, list[str]]:
        """The process that ran a script, its exit code, what it said of errors and what was called."""
        (self.cwd / "calls").write_text("")
        (self.cwd / "sweep.sh").write_text(script)
        env = {"PATH": f"{self.cwd / 'bin'}:{os.environ['PATH']}"} | job
        with subprocess.Popen(
            ["/bin/bash", "sweep.sh"], cwd=self.cwd, env=env, stderr=subprocess.PIPE, text=True
        ) as process:
            try:
                _, err = process.communicate(timeout=60)
            finally:
                process.kill()
        return process.pid, process.returncode, err, (self.cwd / "calls").read_text().splitlines()


@pytest.fixture
def batch(tmp_path: Path) -> Batch:
    return Batch(tmp_path)


def test_the_script_for_one_node_launches_and_then_resumes(batch: Batch) -> None:
    assert batch.run(ONE) == ["tune-jobs  0 launch acrobot.yaml --name acrobot"]
    assert batch.run(ONE) == ["tune-jobs  0 resume acrobot"]


def test_the_script_for_several_nodes_makes_a_ray_of_all_of_them_first(batch: Batch) -> None:
    calls = batch.run(SEVERAL)
    assert calls[-1] == f"tune-jobs token 64 launch acrobot.yaml --name acrobot --address {ADDRESS}"
    head, others = (call for call in sorted(calls) if call.startswith("srun "))
    # `--nodes=1` is before `--nodes=3`.
    node = "ray start --num-cpus=16 --num-gpus=2 --disable-usage-stats --block"
    options = "--head --port=20017 --include-dashboard=false"
    assert head == f"srun token 64 --nodes=1 --ntasks=1 --nodelist=n1 {node} {options}"
    assert others == f"srun token 64 --nodes=3 --ntasks=3 --exclude=n1 {node} --address={ADDRESS}"
    # Others join a head that answers, and the sweep begins with all of them.
    assert calls.index(others) > calls.index(head)
    asked = [call for call in calls if call.startswith("ray ")]
    assert asked == sorted(asked)
    assert set(asked) == {f"ray health-check --address {ADDRESS}", f"ray status --address {ADDRESS}"}
    assert (asked.count(asked[0]) >= 2, asked.count(asked[-1]) >= 3) == (True, True)
    assert batch.run(SEVERAL)[-1] == f"tune-jobs token 64 resume acrobot --address {ADDRESS}"


def test_a_job_without_gpus_has_none_in_ray(batch: Batch) -> None:
    calls = batch.run(SEVERAL, {name: value for name, value in JOB.items() if name != "SLURM_GPUS_ON_NODE"})
    assert sum("--num-gpus=0 " in call for call in calls) == 2


@pytest.mark.parametrize("nodes", ["--nodes=1", "--nodes=3"])
def test_nodes_that_cannot_start_ray_end_the_job_and_are_not_waited_for(batch: Batch, nodes: str) -> None:
    # As many as are asked for never come.
    (batch.cwd / "bin" / "ray").write_text('#!/bin/bash\ntest "$1 $FAILS" = "health-check --nodes=3"\n')
    _, code, err, calls = batch.outcome(SEVERAL, JOB | {"FAILS": nodes})
    assert (code, "No such process" in err) == (1, True)
    # Both are called in the background, so that either may be noted first; without a head there are no others.
    noted = {call.split()[3] for call in calls if "--nodes=" in call}
    assert nodes in noted
    assert noted <= {"--nodes=1", nodes}


def test_rays_options_are_there() -> None:
    lines = " ".join(line for line in SEVERAL.splitlines() if "ray start" in line or "$node" in line)
    named = set(re.findall(r"(?<= )--[\w-]+", lines)) - {"--nodes", "--ntasks", "--nodelist", "--exclude"}
    assert len(named) == 8
    ray = [sys.executable, "-m", "ray.scripts.scripts", "start", "--help"]
    told = subprocess.run(ray, capture_output=True, text=True, check=True).stdout
    assert named - set(re.findall(r"--[\w-]+", told)) == set()
