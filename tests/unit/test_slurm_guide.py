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
    # Four nodes, from the third time on that somebody asks; and a head from the second time on.
    "ray": 'echo "ray $*" >> calls\n'
    'case "$1" in\n'
    '  health-check) test "$(grep -c health-check calls)" -ge 2;;\n'
    '  status) for node in $(seq $(($(grep -c status calls) + 1))); do echo " 1 node_$node"; done;;\n'
    "esac\n",
    "srun": 'echo "srun $RAY_AUTH_MODE ${#RAY_AUTH_TOKEN} $*" >> calls\n',
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

    def run(self, script: str, **job: str) -> list[str]:
        """Run a script, which has to end as `tune-jobs` does, in its process; what was called."""
        (self.cwd / "calls").write_text("")
        (self.cwd / "sweep.sh").write_text(script)
        env = {"PATH": f"{self.cwd / 'bin'}:{os.environ['PATH']}"} | JOB | job
        with subprocess.Popen(["/bin/bash", "sweep.sh"], cwd=self.cwd, env=env, stderr=subprocess.PIPE) as process:
            _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (130, b"")
        *calls, last = (self.cwd / "calls").read_text().splitlines()
        # What SIGTERM is sent to.
        assert last.startswith(f"tune-jobs {process.pid} ")
        return [*calls, last.replace(f"{process.pid} ", "")]


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
    assert asked == [*[f"ray health-check --address {ADDRESS}"] * 2, *[f"ray status --address {ADDRESS}"] * 3]
    assert batch.run(SEVERAL)[-1] == f"tune-jobs token 64 resume acrobot --address {ADDRESS}"


def test_a_job_without_gpus_has_none_in_ray(batch: Batch) -> None:
    calls = batch.run(SEVERAL.replace("${SLURM_GPUS_ON_NODE:-0}", "${NO_SUCH_VARIABLE:-0}"))
    assert sum("--num-gpus=0 " in call for call in calls) == 2


def test_rays_options_are_there() -> None:
    lines = " ".join(line for line in SEVERAL.splitlines() if "ray start" in line or "$node" in line)
    named = set(re.findall(r"(?<= )--[\w-]+", lines)) - {"--nodes", "--ntasks", "--nodelist", "--exclude"}
    assert len(named) == 8
    ray = [sys.executable, "-m", "ray.scripts.scripts", "start", "--help"]
    told = subprocess.run(ray, capture_output=True, text=True, check=True).stdout
    assert named - set(re.findall(r"--[\w-]+", told)) == set()
