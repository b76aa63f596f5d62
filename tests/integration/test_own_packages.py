"""A user's script beside folders called `policies` and `analysis`: the modules of both are found, in whatever order.

Each case is a script in a process of its own, since what counts is the state of the import system.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import tune_jobs

OURS = "import analysis.report, policies.acting.policy, policies.packed.dqn.replay; import tune_jobs.sweeps.verbs\n"


@pytest.fixture
def project(tmp_path: Path) -> Callable[..., tuple[str, str]]:
    """Writes a script's folder and runs the script in it; returns its standard output and error."""

    def run(script: str, files: dict[str, str], *, fails: bool = False) -> tuple[str, str]:
        for path, text in {**files, "script.py": script}.items():
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(text)
        done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode != 0) is fails, done.stderr
        return done.stdout.strip(), done.stderr

    return run


HELPERS = {
    "analysis/my_plots.py": "def plot_all(): return 'plotted'\n",
    "policies/mine/nets.py": "from analysis.my_plots import plot_all\nWIDTH = 7\n",
}
INITS = {
    "analysis/__init__.py": "from .my_plots import plot_all\nfrom . import my_plots as plots_of_mine\nLEVEL = 3\n",
    "policies/__init__.py": "",
    "policies/mine/__init__.py": "",
}
USE = (
    "import analysis.my_plots, policies.mine.nets\n"
    "from policies.mine import nets\n"
    "print(analysis.my_plots.plot_all(), policies.mine.nets.WIDTH, nets.plot_all())\n"
)


@pytest.mark.parametrize("with_inits", [False, True], ids=["folders", "packages"])
@pytest.mark.parametrize("first", ["tune_jobs", "theirs", "within"])
def test_modules_of_both_are_found(project: Callable[..., tuple[str, str]], with_inits: bool, first: str) -> None:
    files = {**HELPERS, **(INITS if with_inits else {})}
    script = {
        "tune_jobs": "import tune_jobs\n" + USE + OURS + USE,
        "theirs": USE + "import tune_jobs\n" + OURS + USE,
        # The user's own modules import tune_jobs while they are imported themselves.
        "within": "import policies.runs\n" + USE + OURS + USE,
    }[first]
    if first == "within":
        files["policies/runs.py"] = "import tune_jobs, policies.mine.nets\nfrom tune_jobs import load_spec\n"
    stdout, stderr = project(script, files)
    assert stdout.splitlines() == ["plotted 7 plotted"] * 2
    assert stderr == ""


@pytest.mark.parametrize("first", ["tune_jobs", "theirs"])
def test_names_in_the_users_own_packages_are_found(project: Callable[..., tuple[str, str]], first: str) -> None:
    names = "from analysis import LEVEL, plot_all\nimport analysis\nprint(LEVEL, plot_all(), analysis.LEVEL)\n"
    imports = ["import tune_jobs\n" + OURS, names]
    script = "".join(imports if first == "tune_jobs" else imports[::-1])
    stdout, _ = project(script + names + "from analysis import *\nprint(LEVEL)\n", {**HELPERS, **INITS})
    assert stdout.splitlines() == ["3 plotted 3"] * 2 + ["3"]


def test_plain_modules_of_these_names_are_found(
    project: Callable[..., tuple[str, str]],
) -> None:
    files = {"analysis.py": "import statistics\nLEVEL = 3\nclass Kept: pass\n", "policies.py": "WIDTH = 7\n"}
    script = (
        "import analysis\nfrom analysis import Kept\nimport tune_jobs\n" + OURS + "import analysis.statistics\n"
        "from policies import WIDTH\nimport pickle, analysis as again\n"
        "print(analysis.LEVEL, again.LEVEL, WIDTH, pickle.loads(pickle.dumps(Kept)) is Kept)\n"
    )
    assert project(script, files)[0] == "3 3 7 True"


def test_the_users_code_runs_only_when_it_is_asked_for(
    project: Callable[..., tuple[str, str]],
) -> None:
    files = {"policies/__init__.py": "print('ran')\nWIDTH = 7\n", "policies/nets.py": ""}
    script = "import tune_jobs\n" + OURS + "from policies import errors\nimport policies.nets\n"
    assert project(script + "print('now')\nimport policies\npolicies.WIDTH", files)[0].splitlines() == ["now", "ran"]


def test_what_neither_has_is_missing_as_ever(project: Callable[..., tuple[str, str]]) -> None:
    script = (
        "import tune_jobs, analysis\nprint(hasattr(analysis, 'nothing'))\n"
        "for line in ('import analysis.nothing', 'from policies import nothing', 'import policies.packed.nothing'):\n"
        "    try:\n        exec(line)\n    except ImportError as error:\n        print(type(error).__name__)\n"
    )
    expected = ["False", "ModuleNotFoundError", "ImportError", "ModuleNotFoundError"]
    assert project(script, {**HELPERS, **INITS})[0].splitlines() == expected


def test_an_error_in_the_users_package_reaches_them(
    project: Callable[..., tuple[str, str]],
) -> None:
    attempt = "try:\n    from analysis import x\nexcept ZeroDivisionError:\n    print(0)\n"
    script = f"import tune_jobs\n{attempt}{attempt}"
    assert project(script, {"analysis/__init__.py": "x = 1 / 0\n"})[0].split() == ["0", "0"]


def test_a_hidden_module_is_warned_of_once(project: Callable[..., tuple[str, str]]) -> None:
    files = {
        "policies/__init__.py": "",
        "policies/networks.py": "",
        "policies/nets.py": "",
        "analysis/plots.py": "",
    }
    script = (
        "import tune_jobs\nimport policies.hyperparams, analysis.plots\n"
        "print(policies.__file__, analysis.plots.__file__)\n"
    )
    stdout, stderr = project(script, files)
    root = str(tune_jobs.__path__[0]).removesuffix("tune_jobs")
    assert stdout == f"{root}policies/__init__.py {root}analysis/plots.py"
    warnings = [line for line in stderr.splitlines() if "UserWarning" in line]
    assert ["policies/networks.py:" in warnings[0], "analysis/plots.py:" in warnings[1], len(warnings)] == [
        True,
        True,
        2,
    ]
    assert "nets.py" not in stderr


def test_a_hidden_folder_of_code_is_warned_of_and_others_are_not(
    project: Callable[..., tuple[str, str]],
) -> None:
    files = {
        "policies/envs/cart.py": "",
        "policies/packed/notes.txt": "",
        "analysis/plots/figure.png": "",
        "envs/a.py": "",
    }
    _, stderr = project("import tune_jobs\nimport policies.envs.spaces\n", files)
    warnings = [line for line in stderr.splitlines() if "UserWarning" in line]
    assert len(warnings) == 1
    assert f"policies{os.sep}envs: `import policies.envs` imports the one of tune-jobs" in warnings[0]


def test_a_module_of_ours_that_is_theirs_already_is_one_clear_error(
    project: Callable[..., tuple[str, str]],
) -> None:
    files = {"policies/__init__.py": "", "policies/networks.py": ""}
    script = "import policies.networks\nimport tune_jobs\n"
    error = project(script, files, fails=True)[1].splitlines()[-1]
    assert error.startswith("ImportError: tune_jobs cannot be imported: it has a module policies.networks, and ")
    assert "policies/networks.py, which is imported already" in error
    assert "Rename" in error


def test_a_spawned_process_of_environments_finds_ours(
    project: Callable[..., tuple[str, str]],
) -> None:
    script = (
        "if __name__ == '__main__':\n"
        "    import tune_jobs\n"
        "    from policies.packed.envs.process import ProcessHost\n"
        "    host = ProcessHost('CartPole-v1', None)\n"
        "    host.send('add', 'a', [1, 2])\n"
        "    print(len(host.receive()))\n"
        "    host.close()\n"
    )
    stdout, stderr = project(script, {"policies/__init__.py": "", "analysis/__init__.py": ""})
    assert stdout == "2", stderr


ENV = "import gymnasium\n\n\nclass Walk(gymnasium.Env):\n    pass\n"


def test_environments_in_the_users_packages_are_found_by_id_and_for_other_processes(
    project: Callable[..., tuple[str, str]],
) -> None:
    # As the command has it: without the current folder on the path.
    script = (
        "import os, sys\nsys.path.pop(0)\nimport tune_jobs\n"
        "from policies.envs.ids import find_env\nfrom policies.envs.modules import module_folders\n"
        "tune_jobs.allow_modules(['policies', 'analysis.envs.walks'])\n"
        "print([find_env(env_id)[0] for env_id in ('policies:Walk', 'analysis.envs.walks:Walk')])\n"
        "print(os.getcwd() in module_folders())\n"
    )
    stdout, _ = project(script, {"policies/__init__.py": ENV, "analysis/envs/walks.py": ENV})
    assert stdout.splitlines() == ["['policies:Walk', 'analysis.envs.walks:Walk']", "True"]


def test_in_a_folder_that_was_deleted_the_rest_of_the_path_is_looked_in(tmp_path: Path) -> None:
    (gone := tmp_path / "gone").mkdir()
    (tmp_path / "analysis.py").write_text("LEVEL = 3\n")
    code = (
        f"import os, sys\nos.chdir({str(gone)!r})\nos.rmdir({str(gone)!r})\nsys.path[:0] = ['', {str(tmp_path)!r}]\n"
        "import tune_jobs\nfrom analysis import LEVEL\nprint(LEVEL)\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("3\n", "")
