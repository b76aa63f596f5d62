"""The command line: dry runs and bad input by the real validation, presets, schema, and what is imported when."""

import contextlib
import json
import os
import subprocess
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import pytest
from fake_sweeps import RunCommand
from sweep_folders import make_sweep_folder

from tune_jobs.cli.commands import cli
from tune_jobs.plan.machine import Machine

ROOT = Path(__file__).parents[2]
SMALL = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {uniform: [1e-4, 1e-2]}}\nnum_samples: 2\n"
HEAVY = ("ray", "torch", "pandas", "matplotlib", "scipy", "optuna", "imageio", "PIL")


# -- dry runs and bad input, by the real validation


def test_a_dry_run_refuses_to_wait_for_nodes_of_no_cluster(run: RunCommand) -> None:
    for more in ([], ["--dry-run"]):
        result = run("launch", "cartpole-ppo", "--wait-for-nodes", "60", *more)
        assert result.exit_code == 2
        assert "--wait-for-nodes 60 (wait_for_nodes) waits for nodes of a Ray cluster" in result.stderr


def test_a_dry_run_prints_the_plan_and_writes_nothing(run: RunCommand, tmp_path: Path) -> None:
    result = run("launch", "cartpole-ppo", "--dry-run", "--set", "resources.max_concurrent=1")
    assert result.exit_code == 0
    for part in (
        "CartPole-v0 (solved at 195)",
        "20: 20 points",
        "packed; environments: vectorised, ",
        " us per step",
        "1 in 1 pack of up to 1, each pack on 1 CPU",
        "at most 2,020,620, and 1,010,310 of more seeds",
        "MB",
        "t0019",
        "64",
        "linear",
        "Nothing was started",
    ):
        assert part in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_one_of_a_thing_is_not_called_many(run: RunCommand) -> None:
    one = [f"--set={name}=1" for name in ("stop.num_env_steps", "stop.num_iterations", "stop.num_episodes")]
    Path("one.yaml").write_text("env: CartPole-v1\nalgorithm: ppo\nresources: {max_concurrent: 1}\n")
    lines = run("launch", "one.yaml", "--dry-run", *one).stdout.splitlines()
    assert any(line.split()[1:] == ["1:", "1", "point,", "1", "seed", "each"] for line in lines)
    assert any("1 episode or 1 env step or 1 iteration or" in line for line in lines)


def test_the_env_steps_and_the_disk_of_a_plan_are_those_of_more_seeds_too(run: RunCommand) -> None:
    with_more = run("launch", "cartpole-ppo", "--dry-run").stdout.splitlines()
    without = run("launch", "cartpole-ppo", "--dry-run", "--set", "confirm=none").stdout.splitlines()
    unfinished = run("launch", "cartpole-ppo", "--dry-run", "--no-finish").stdout.splitlines()
    assert [line.split()[1:] for line in unfinished if line.startswith("then ")] == [["nothing", "(--no-finish)"]]
    steps = [next(line for line in lines if line.startswith("env steps")) for lines in (unfinished, without)]
    assert steps[0].split() == steps[1].split()

    def told(lines: list[str], name: str) -> str:
        return next(line.removeprefix(name).strip() for line in lines if line.startswith(name))

    assert told(without, "env steps") == "at most 2,020,620 in all"
    disk, less = (float(told(lines, "disk").split()[-2]) for lines in (with_more, without))
    assert told(with_more, "disk").split()[-1] == told(without, "disk").split()[-1]
    assert disk == pytest.approx(1.5 * less, rel=0.01)


def test_a_dry_run_of_many_trials_shows_the_first_ones(run: RunCommand) -> None:
    output = run("launch", "cartpole-ppo", "--dry-run", "--set", "num_samples=100").stdout
    assert "t0023" in output
    assert "t0024" not in output
    assert "and 376 more" in output


def test_a_dry_run_as_json_holds_spec_and_plan(run: RunCommand) -> None:
    document = json.loads(run("launch", "cartpole-ppo", "--dry-run", "--json", "--name", "mine").stdout)
    assert document["spec"]["name"] == "mine"
    assert document["plan"]["num_trials"] == len(document["plan"]["trials"]) == 20
    assert document["plan"]["env"]["threshold"] == 195.0
    assert document["plan"]["engines"] == {"packed": 20}
    assert {trial["engine"] for trial in document["plan"]["trials"]} == {"packed"}
    packs = document["plan"]["packs"]
    assert packs["num_packs"] * packs["slots"] >= 20
    assert packs["env_kind"] == "vectorised"
    assert packs["trial_ids"][0] == "t0000"


def test_a_dry_run_says_what_is_not_packed_and_why(run: RunCommand) -> None:
    output = run("launch", "cartpole-ppo", "--dry-run", "--set", "resources.num_env_runners=1").stdout
    assert "note: No trial is packed, RLlib trains them all: resources.num_env_runners is 1" in output
    document = json.loads(run("launch", "cartpole-ppo", "--dry-run", "--json", "--set", "engine=rllib").stdout)
    planned = document["plan"]
    assert (planned["engines"], planned["packs"], planned["notes"]) == ({"rllib": 20}, None, [])
    # A baseline's engine is its own, which nobody has to be told.
    output = run("launch", "cartpole-random", "--dry-run").stdout
    assert any(line.split() == ["engine", "baseline"] for line in output.splitlines())
    assert "note:" not in output


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """A stand-in for a cluster, whose machine is `.machine`; `.checked` are the folders its nodes were asked for."""
    found = types.SimpleNamespace(machine=None, checked=[])
    joined = contextlib.nullcontext(found)
    monkeypatch.setattr("tune_jobs.sweeps.dry_run.connected", lambda address, here: joined)
    check = "tune_jobs.sweeps.dry_run._check_nodes"
    monkeypatch.setattr(check, lambda place, *_: (found.checked.append(Path(place).is_dir()), [])[1])
    return found


def test_a_dry_run_says_that_memory_makes_packs_smaller(run: RunCommand, cluster: types.SimpleNamespace) -> None:
    cluster.machine = Machine(7, source="the cluster at auto", memory_bytes=2e7)
    output = run("launch", "cartpole-ppo", "--dry-run", "--address", "auto").stdout
    assert "note: Packs are planned smaller: 7 x 3 trials at once may take" in output


def test_a_dry_run_for_a_cluster_plans_for_the_clusters_machine(
    run: RunCommand, cluster: types.SimpleNamespace, tmp_path: Path
) -> None:
    cluster.machine = Machine(7, source="the cluster at auto")
    output = run("launch", "cartpole-ppo", "--dry-run", "--address", "auto").stdout
    assert "20 in 7 packs of up to 3, each pack on 1 CPU; the cluster at auto has 7 CPUs" in output
    assert cluster.checked == [True]
    assert list(tmp_path.iterdir()) == []


# -- a dry run refuses what a launch does, in the same words


REFUSED = {
    "a file name with a space": ("my sweep.yaml", ["would be called 'my sweep', after its file", "--name"]),
    "a file name of other letters": ("übung.yaml", ["would be called 'übung'", "--name"]),
    "a name that is taken": ("x.yaml --name taken", ["A sweep 'taken' is already in"]),
    "a name in the file that is taken": ("named.yaml", ["A sweep 'taken' is already in"]),
    "a name of a wrong form": ("x.yaml --name a/b", ["The sweep name 'a/b' is not allowed"]),
    "storage that is a file": ("x.yaml --storage x.yaml", ["cannot be written: File exists"]),
    "storage below a file": ("x.yaml --storage x.yaml/a/b", ["cannot be written: Not a directory"]),
    "storage that nobody writes": ("x.yaml --storage /proc/nothing", ["/proc/nothing cannot be written"]),
    "an address that is none": ("x.yaml --address here", ["here"]),
    "an address where nothing listens": ("x.yaml --address 127.0.0.1:9", ["127.0.0.1:9"]),
    "an empty storage": ("x.yaml --storage=", ["storage is ''"]),
    "an empty name": ("x.yaml --name=", ["name"]),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_a_dry_run_refuses_what_a_launch_refuses(run: RunCommand, tmp_path: Path, case: tuple[str, list[str]]) -> None:
    arguments, parts = case
    for name in ("my sweep.yaml", "übung.yaml", "x.yaml"):
        Path(name).write_text(SMALL)
    Path("named.yaml").write_text(SMALL + "name: taken\n")
    Path("sweeps/taken").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    source, _, options = arguments.partition(".yaml")
    command = ("launch", f"{source}.yaml", *options.split())
    launched, planned = run(*command), run(*command, "--dry-run")
    assert launched.exit_code == planned.exit_code
    assert launched.exit_code in (2, 5)
    assert launched.stderr == planned.stderr
    for part in parts:
        assert part in planned.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_a_dry_run_leaves_storage_as_it_was(run: RunCommand, tmp_path: Path) -> None:
    Path("x.yaml").write_text(SMALL)
    assert run("launch", "x.yaml", "--dry-run", "--storage", "a/b").exit_code == 0
    Path("sweeps/x").mkdir(parents=True)
    # The automatic name is taken; a launch takes the next.
    assert run("launch", "x.yaml", "--dry-run").exit_code == 0
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["sweeps", "x", "x.yaml"]


BAD_INPUT: dict[str, tuple[dict[str, Any], int, list[str]]] = {
    "unknown key": (
        {"text": SMALL + "num_sample: 3\n"},
        2,
        ["sweep.yaml: num_sample", "Did you mean 'num_samples'?"],
    ),
    "wrong type": ({"set": "num_samples=many"}, 2, ["num_samples: 'many' is not a number (from --set)"]),
    "empty grid": ({"set": "space.lr={grid: []}"}, 2, ["space.lr.grid: is empty"]),
    "lr of zero": (
        {"set": "space.lr={grid: [0]}"},
        2,
        ["space.lr.grid[0]: 0 is not allowed", "greater than 0"],
    ),
    "lr below zero": (
        {"set": "space.lr={uniform: [-1, 1]}"},
        2,
        ["space.lr.uniform[0]: -1.0 is not allowed"],
    ),
    "activation": (
        {"set": "hyperparams.activation=rleu"},
        2,
        ["hyperparams.activation: 'rleu'", "Did you mean 'relu'?"],
    ),
    "not of the algorithm": (
        {"set": "space.tau={uniform: [0, 1]}"},
        2,
        ["space.tau: ppo has no hyperparameter 'tau'"],
    ),
    "unregistered env": ({"set": "env=CartPoel-v1"}, 2, ["'CartPoel-v1'", "CartPole-v1"]),
    "env that imports": ({"set": "env=evil:Env-v0"}, 2, ["'evil:Env-v0'"]),
    "spaces": (
        {"set": "env=Pendulum-v1", "more": ["--set", "algorithm=dqn"]},
        2,
        ["Pendulum-v1", "continuous"],
    ),
    "engine": ({"set": "engine=packt"}, 2, ["engine: 'packt'", "Did you mean 'packed'?"]),
    "engine that cannot": (
        {"set": "engine=packed", "more": ["--set", "resources.num_env_runners=1"]},
        2,
        ["engine: packed", "resources.num_env_runners is 1"],
    ),
    "no file": ({"spec": "nothing.yaml"}, 2, ["'nothing.yaml'", "cartpole-ppo"]),
    "no yaml": ({"text": "env: [\n"}, 2, ["sweep.yaml, line 2"]),
    "bad name": ({"more": ["--name", "a/b"]}, 2, ["'a/b'"]),
    "bad --set": ({"set": "oops"}, 2, ["--set oops: this is not an assignment"]),
    "too many CPUs": ({"set": "resources.num_env_runners=1000"}, 5, ["1,001 CPUs", "this machine has"]),
    "contradiction": (
        {"set": "hyperparams.minibatch_size=4096"},
        2,
        ["point 0", "minibatch_size 4096 is larger"],
    ),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_clear_message_and_nothing_is_written(run: RunCommand, tmp_path: Path, case: str) -> None:
    given, code, parts = BAD_INPUT[case]
    (tmp_path / "sweep.yaml").write_text(given.get("text", SMALL))
    overrides = ["--set", given["set"]] if "set" in given else []
    result = run("launch", given.get("spec", "sweep.yaml"), "--dry-run", *overrides, *given.get("more", []))
    assert result.exit_code == code
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    for part in parts:
        assert part in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.yaml"]


# -- presets, schema, speed


def test_presets_are_listed_and_printed(run: RunCommand, tmp_path: Path) -> None:
    listed = run("presets").stdout
    for word in ("preset", "expected", "env steps", "time on 2 cores"):
        assert word in listed
    row = next(line for line in listed.splitlines() if "cartpole-random" in line)
    assert "Random play" in row
    assert "3,400" in row
    presets = {preset["name"]: preset for preset in json.loads(run("presets", "--json").stdout)}
    assert set(presets["cartpole-ppo"]) == {
        "name", "title", "source", "shows", "expected", "env_steps", "time", "description", "text",
    }  # fmt: skip
    (tmp_path / "own.yaml").write_text(run("presets", "cartpole-ppo").stdout)
    assert run("launch", "own.yaml", "--dry-run").exit_code == 0
    missing = run("presets", "cartpole-pp")
    assert missing.exit_code == 2
    assert "Did you mean 'cartpole-ppo'?" in missing.stderr


def test_the_schema_is_json_with_and_without_asking_for_it(run: RunCommand) -> None:
    assert json.loads(run("schema").stdout) == json.loads(run("schema", "--json").stdout)
    assert "properties" in json.loads(run("schema").stdout)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A storage folder with one sweep."""
    folder = tmp_path_factory.mktemp("finished")
    make_sweep_folder(folder / "mine", iterations=1)
    return folder


def test_every_command_takes_json_and_has_a_one_line_help() -> None:
    groups = [command for command in cli.commands.values() if isinstance(command, click.Group)]
    inner = {f"{group.name} {name}": command for group in groups for name, command in group.commands.items()}
    outer = {name: command for name, command in cli.commands.items() if not isinstance(command, click.Group)}
    for name, command in (outer | inner).items():
        assert any("--json" in parameter.opts for parameter in command.params), name
        assert command.help, name


def test_version_and_help(run: RunCommand) -> None:
    assert run("--version").stdout.startswith("tune-jobs ")
    assert run("-h").exit_code == 0
    assert "130 interrupted" in " ".join(run("--help").stdout.split())


@pytest.mark.parametrize("arguments", [["--version"], ["launch", "nope", "--dry-run"]])
def test_a_command_ends_without_looking_for_garbage_among_all_that_is_left(arguments: list[str]) -> None:
    code = (
        "import atexit, gc, sys\n"
        "from tune_jobs.cli.commands import main\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 1000, len(gc.get_objects()) < 1000))\n"
        f"sys.argv = ['tune-jobs', *{arguments!r}]\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "True True"
    assert done.returncode == (0 if arguments == ["--version"] else 2)


def heavy_after(calls: Sequence[Sequence[str]], where: Path | None = None, **environment: str) -> tuple[str, list[str]]:
    """What a fresh process prints where these commands are called in it, and what of HEAVY it has loaded then."""
    code = (
        "import sys, tune_jobs.cli.commands\n"
        f"for arguments in {calls!r}:\n"
        "    sys.argv = ['tune-jobs', *arguments]\n"
        "    try:\n"
        "        tune_jobs.cli.commands.main()\n"
        "    except SystemExit:\n"
        "        pass\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules], sep=',')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=where,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )  # fmt: skip
    *printed, loaded = done.stdout.split("\n")[:-1]
    return "\n".join(printed), [name for name in loaded.split(",") if name]


@pytest.mark.parametrize(
    "arguments", [["launch", "cartpole-ppo", "--dry-run"], ["launch", "nope", "--dry-run"], ["schema"]]
)
def test_nothing_heavy_is_imported_before_it_is_needed(arguments: list[str]) -> None:
    assert heavy_after([arguments])[1] == []


def test_help_imports_nothing_heavy() -> None:
    printed, loaded = heavy_after([["--help"], ["--version"], *([name, "--help"] for name in cli.commands)])
    assert printed.count("Usage: tune-jobs") == 1 + len(cli.commands)
    assert loaded == []


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("tune-jobs ", "plain,launch"),
        ("tune-jobs launch --", "plain,--dry-run"),
        ("tune-jobs launch acro", "plain,acrobot-ppo"),
        ("tune-jobs hyperparams ", "plain,dqn"),
        ("tune-jobs status ", "plain,mine"),
        ("tune-jobs evaluate mine/t", "plain,mine/t0001"),
        ("tune-jobs status --storage ", "dir,"),
    ],
)
def test_completion_imports_nothing_heavy(line: str, found: str, finished: Path) -> None:
    # As the shell asks, see `click.shell_completion`.
    asked = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1), "_TUNE_JOBS_COMPLETE": "bash_complete"}
    printed, loaded = heavy_after([[]], finished, TUNE_JOBS_STORAGE=str(finished), **asked)
    assert found in printed.splitlines()
    assert loaded == []
