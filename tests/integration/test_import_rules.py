"""What may be imported where, seen in the modules of a fresh process; import-linter checks the same in the source."""

import json
import subprocess
import sys

import pytest

HEAVY = {"ray", "torch", "pandas", "matplotlib"}
PROGRAM = "import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)))"
# All packages load these, which settle whose the names of packages are.
NAMES = {"tune_jobs", "tune_jobs.process", "tune_jobs.process.own_packages"}


def modules_after(code: str) -> set[str]:
    done = subprocess.run([sys.executable, "-c", PROGRAM.format(code=code)], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in set(json.loads(done.stdout.splitlines()[-1])) - NAMES}


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        # Help, validation and dry runs are instant.
        ("import tune_jobs.cli.commands", HEAVY | {"numpy", "pydantic", "sqlalchemy", "fastapi", "starlette"}),
        (
            "from tune_jobs.client import Client; Client('http://127.0.0.1:1')",
            HEAVY | {"fastapi", "sqlalchemy", "uvicorn"},
        ),
        # What the guard's child begins with, beside its parent, which imports the rest.
        ("import policies.packed.envs.make", HEAVY | {"pydantic", "PIL"}),
        ("from tune_jobs.spec.file import load_spec; load_spec('cartpole-ppo')", HEAVY),
        ("import tune_jobs.sweeps.verbs", HEAVY),
        # A policy file acts, is evaluated and filmed without Ray and without torch.
        (
            "import policies.acting.policy, policies.acting.evaluate, policies.acting.video, policies.portable.file",
            {"ray", "torch"},
        ),
        ("import tune_jobs.sweeps.conclude", {"ray", "torch"}),
        # The seam between trials and engines.
        (
            "import tune_jobs.training.trial_loop, tune_jobs.training.protocol, tune_jobs.sweeps.monitor",
            {"ray", "torch"},
        ),
        ("import analysis.records, analysis.selection, analysis.report", {"ray", "torch", "tune_jobs"}),
        ("import policies.envs.make, policies.hyperparams, policies.errors, policies.files", {"analysis", "tune_jobs"}),
    ],
)
def test_importing_imports_no_more_than_it_may(code: str, absent: set[str]) -> None:
    assert modules_after(code) & absent == set()


def test_the_contracts_of_the_source_hold(pytestconfig: pytest.Config) -> None:
    pytest.importorskip("importlinter")
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"],
        capture_output=True, text=True, check=False, cwd=pytestconfig.rootpath,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
