"""The command line: what it passes on, what it prints, its exit codes; and that no traceback is shown."""

import dataclasses
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.records import BestRecord, CheckpointRecord, EvaluationRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, NotFoundError, TrialsFailedError
from tune_jobs.cli import cli
from tune_jobs.cli_output import to_json

ROOT = Path(__file__).parents[2]
SMALL = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {uniform: [1e-4, 1e-2]}}\nnum_samples: 2\n"
HEAVY = ("ray", "torch", "pandas", "matplotlib", "imageio", "PIL")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder; whatever goes wrong has to be a message, not an exception."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)

    def invoke(*arguments):
        result = CliRunner().invoke(cli, [str(argument) for argument in arguments], prog_name="tune-jobs")
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        assert "Traceback" not in result.output
        return result

    return invoke


# -- a stand-in for tune_jobs.sweeps, whose trials take minutes


@dataclasses.dataclass(frozen=True)
class Result:
    folder: Path
    sweep: SweepRecord
    trials: list[TrialRecord]
    best: BestRecord | None
    why_no_best: str | None
    artifacts: dict[str, Path]
    interrupted: bool = False
    notes: tuple[str, ...] = ("no video: it can't be drawn",)
    exit_code: int = 0


@dataclasses.dataclass(frozen=True)
class Status:
    sweep: SweepRecord
    counts: dict[str, int]
    alive: bool


SWEEP = SweepRecord(
    name="mine",
    state="completed",
    spec={},
    evaluation_seeds=(1,),
    confirmation_seeds=(9,),
    num_trials=2,
    created_at=0.0,
    run_time_s=200.0,
)
CHECKPOINT = CheckpointRecord(
    trial_id="t0001",
    iteration=30,
    num_env_steps=30_720,
    path="trials/t0001/checkpoints/30",
    evaluation_return=200.0,
)
TRIALS = [
    TrialRecord(
        trial_id="t0000",
        index=0,
        point_index=0,
        seed=1,
        point={"lr": 0.1, "hidden_sizes": [64, 32]},
        status="failed",
        error="ValueError: [bold]step[/bold] broke\n  more",
        num_env_steps=5,
    ),
    TrialRecord(
        trial_id="t0001",
        index=1,
        point_index=1,
        seed=2,
        point={"lr": 3e-5, "hidden_sizes": [64]},
        status="completed",
        stop_reason="training_return",
        training_return=float("nan"),
        best_evaluation_return=200.0,
        time_s=61.0,
    ),
]


def evaluation(policy, *returns, threshold=195.0):
    return EvaluationRecord(
        policy=policy,
        env_id="CartPole-v0",
        seeds=tuple(range(5, 5 + len(returns))),
        returns=returns,
        lengths=(1,) * len(returns),
        threshold=threshold,
    )


BEST = BestRecord(
    checkpoint=CHECKPOINT,
    point={"lr": 3e-5},
    seed=2,
    selection_score=200.0,
    confirmation=evaluation("best", 190.0, 200.0),
    random=evaluation("random", 20.0, 22.0),
)


@pytest.fixture
def sweeps(monkeypatch, tmp_path):
    """Calls are kept in `.calls`; what they return or raise can be replaced in `.answers`."""
    fake = types.ModuleType("tune_jobs.sweeps")
    folder = tmp_path / "sweeps" / "mine"
    result = Result(folder, SWEEP, TRIALS, BEST, None, {"report": folder / "report" / "index.html"}, exit_code=3)
    status = Status(SWEEP, {"completed": 1, "failed": 1, "running": 0}, alive=False)
    fake.calls = []
    fake.answers = {
        "launch": result,
        "resume": result,
        "extend": result,
        "stop": True,
        "status": status,
        "list_sweeps": [status],
        "trials": TRIALS,
        "best": BEST,
        "evaluate": (evaluation("x", 195.0), evaluation("random", 20.0)),
        "video": {"mp4": Path("a.mp4")},
        "report": Path("index.html"),
    }

    def make(name):
        def call(*args, **kwargs):
            fake.calls.append((name, args, kwargs))
            print("a library's chatter")
            answer = fake.answers[name]
            if isinstance(answer, BaseException):
                raise answer
            return answer

        return call

    for name in fake.answers:
        setattr(fake, name, make(name))
    monkeypatch.setitem(sys.modules, "tune_jobs.sweeps", fake)
    import tune_jobs

    monkeypatch.setattr(tune_jobs, "sweeps", fake, raising=False)
    return fake


def options(**given):
    """What the commands that run trials pass on, unless told otherwise."""
    return {"storage": None, "address": None, "finish": True, "progress": "auto", **given}


LAUNCHED = {"overrides": ("a.b=1", "c=2"), "name": "n"}
EVALUATED = {"storage": None, "num_episodes": 100, "first_seed": None, "env_id": None}
FILMED = {"storage": None, "output": None, "seed": None, "env_id": None}
COMMANDS = [
    (
        "launch x.yaml --set a.b=1 --set c=2 --name n --address auto --no-finish",
        ("launch", ("x.yaml",), options(address="auto", finish=False, **LAUNCHED)),
    ),
    (
        "launch x.yaml --storage s --progress none",
        ("launch", ("x.yaml",), options(storage="s", progress="none", overrides=(), name=None)),
    ),
    ("resume mine", ("resume", ("mine",), options(retry_failed=False))),
    ("resume mine --retry-failed --no-finish", ("resume", ("mine",), options(retry_failed=True, finish=False))),
    ("extend mine --num-samples 3 --storage s", ("extend", ("mine", 3), options(storage="s"))),
    ("stop mine", ("stop", ("mine",), {"storage": None})),
    ("status mine --storage s", ("status", ("mine",), {"storage": "s"})),
    ("list --storage s", ("list_sweeps", ("s",), {})),
    ("trials mine", ("trials", ("mine",), {"storage": None})),
    ("best mine", ("best", ("mine",), {"storage": None, "num_episodes": 100})),
    (
        "evaluate mine/t0001 --num-episodes 7 --first-seed 0",
        ("evaluate", ("mine/t0001",), {**EVALUATED, "num_episodes": 7, "first_seed": 0}),
    ),
    ("evaluate random --env CartPole-v1", ("evaluate", ("random",), {**EVALUATED, "env_id": "CartPole-v1"})),
    ("video mine", ("video", ("mine",), FILMED)),
    ("video mine --output out --seed 0", ("video", ("mine",), {**FILMED, "output": Path("out"), "seed": 0})),
    ("report mine", ("report", ("mine",), {"storage": None})),
]


@pytest.mark.parametrize(("arguments", "call"), COMMANDS)
def test_commands_pass_their_arguments_on(run, sweeps, arguments, call):
    result = run(*arguments.split())
    assert sweeps.calls == [call]
    assert result.exit_code == (3 if call[0] in ("launch", "resume", "extend") else 0)


@pytest.mark.parametrize("arguments", [arguments for arguments, _ in COMMANDS])
def test_json_is_one_document_on_standard_output_whatever_else_is_printed(run, sweeps, arguments):
    result = run(*arguments.split(), "--json")
    json.loads(result.stdout, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))


def test_the_document_of_a_launch_holds_everything(run, sweeps):
    document = json.loads(run("launch", "x", "--json").stdout)
    assert document["exit_code"] == 3
    assert document["trials"][1]["training_return"] is None
    assert document["best"]["optimism_gap"] == 5.0
    assert document["best"]["confirmation"]["solved"] is True
    assert document["best"]["confirmation"]["mean_return"] == 195.0
    assert document["artifacts"]["report"].endswith("index.html")


def test_numbers_that_json_lacks_become_null():
    record = to_json(evaluation("x", float("nan"), float("inf")))
    assert record["returns"] == [None, None]
    assert record["mean_return"] is None


def test_a_launch_tells_the_winner_the_failures_and_where_all_lies(run, sweeps, tmp_path):
    output = run("launch", "x").stdout
    for part in (
        "2 trials: 1 completed, 1 failed",
        "t0000 failed: ValueError: [bold]step[/bold] broke",
        "lr 3e-05",
        "t0001, iteration 30, 30,720 env steps",
        "200.0 mean evaluation return",
        "195.0 ± 5.0 over 2 episodes",
        "gap +5.0",
        "21.0 ± 1.0",
        "CartPole-v0",
        "solved (threshold 195)",
        "report  sweeps/mine/report/index.html",
        "note: no video: it can't be drawn",
    ):
        assert part in output


def test_an_interrupted_launch_says_how_to_resume_on_its_last_line(run, sweeps):
    sweeps.answers["launch"] = dataclasses.replace(
        sweeps.answers["launch"],
        best=None,
        why_no_best="no trial was evaluated",
        interrupted=True,
        exit_code=130,
    )
    result = run("launch", "x", "--storage", "my sweeps")
    assert result.exit_code == 130
    assert "no trial was evaluated" in result.stdout
    assert result.stderr.splitlines()[-1].endswith("tune-jobs resume mine --storage 'my sweeps'")


def test_trials_are_a_table_in_which_no_value_is_cut_or_taken_for_markup(run, sweeps):
    lines = run("trials", "mine").stdout.splitlines()
    failed = next(line for line in lines if "t0000" in line)
    for part in ("failed", "0.1", "64x32", "ValueError: [bold]step[/bold] broke"):
        assert part in failed
    completed = next(line for line in lines if "t0001" in line)
    for part in ("completed", "3e-05", "1 min 1 s", "200.0", "training_return"):
        assert part in completed


def test_a_sweep_whose_process_is_gone_is_not_called_running(run, sweeps):
    running = SWEEP.model_copy(update={"state": "running"})
    sweeps.answers["status"] = Status(running, {"running": 2}, alive=False)
    assert "interrupted" in run("status", "mine").stdout
    sweeps.answers["status"] = Status(running, {"running": 2}, alive=True)
    assert "interrupted" not in run("status", "mine").stdout


def test_an_empty_storage_is_no_error(run, sweeps):
    sweeps.answers["list_sweeps"] = []
    assert "no sweeps" in run("list").stdout


def test_evaluations_are_told_beside_random_ones(run, sweeps):
    sweeps.answers["evaluate"] = (evaluation("p", 100.0, 190.0), evaluation("random", 20.0))
    output = run("evaluate", "p").stdout
    assert "145.0 ± 45.0 over 2 episodes (100 to 190)" in output
    assert "random policy" in output
    assert "not solved (threshold 195)" in output
    sweeps.answers["evaluate"] = (
        evaluation("p", 1.0, threshold=None),
        evaluation("random", 1.0, threshold=None),
    )
    assert "no threshold" in run("evaluate", "p").stdout


# -- errors


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (NotFoundError("No sweep 'mine'.", "List them."), 4),
        (CannotRunError("The storage is full.", "Free some."), 5),
        (TrialsFailedError("All failed.", "See trials."), 3),
        (KeyboardInterrupt(), 130),
    ],
)
def test_errors_end_with_message_hint_and_exit_code(run, sweeps, error, code):
    sweeps.answers["launch"] = error
    result = run("launch", "x")
    assert result.exit_code == code
    message = getattr(error, "message", "Interrupted.")
    assert f"error: {message}" in result.stderr
    assert getattr(error, "hint", "tune-jobs resume SWEEP") in result.stderr
    document = json.loads(run("launch", "x", "--json").stdout)
    assert (document["error"], document["exit_code"]) == (message, code)


def test_an_unexpected_error_is_one_line_and_its_traceback_is_kept(run, sweeps, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sweeps.answers["best"] = ZeroDivisionError("a bug")
    result = run("best", "mine")
    assert result.exit_code == 1
    assert "error: Unexpected ZeroDivisionError: a bug" in result.stderr
    (kept,) = tmp_path.glob("tune-jobs-error-*.txt")
    assert str(kept) in result.stderr
    assert "Traceback" in kept.read_text()


def test_debug_shows_the_traceback(tmp_path, sweeps):
    sweeps.answers["best"] = ZeroDivisionError("a bug")
    result = CliRunner().invoke(cli, ["--debug", "best", "mine"])
    assert "Traceback" in result.stderr
    assert result.exit_code == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["lunch"],
        ["launch"],
        ["launch", "x", "--nme", "y"],
        ["extend", "mine"],
        ["extend", "mine", "--num-samples", "0"],
        ["best", "mine", "--num-episodes", "x"],
        ["evaluate", "p", "--first-seed", "-1"],
        ["evaluate", "random"],
        ["video", "random"],
    ],
)
def test_wrong_arguments_are_exit_code_2(run, sweeps, arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr
    assert sweeps.calls == []


# -- dry runs and bad input, by the real validation


def test_a_dry_run_prints_the_plan_and_writes_nothing(run, tmp_path):
    result = run("launch", "cartpole-ppo", "--dry-run", "--set", "resources.max_concurrent=1")
    assert result.exit_code == 0
    for part in (
        "CartPole-v0 (solved at 195)",
        "20: 20 points",
        "1, each on 1 CPU",
        "at most 2,020,620",
        "MB",
        "t0019",
        "64",
        "linear",
        "Nothing was started",
    ):
        assert part in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_of_many_trials_shows_the_first_ones(run):
    output = run("launch", "cartpole-ppo", "--dry-run", "--set", "num_samples=100").stdout
    assert "t0023" in output
    assert "t0024" not in output
    assert "and 376 more" in output


def test_a_dry_run_as_json_holds_spec_and_plan(run):
    document = json.loads(run("launch", "cartpole-ppo", "--dry-run", "--json", "--name", "mine").stdout)
    assert document["spec"]["name"] == "mine"
    assert document["plan"]["num_trials"] == len(document["plan"]["trials"]) == 20
    assert document["plan"]["env"]["threshold"] == 195.0


def test_a_dry_run_for_a_cluster_plans_for_the_clusters_machine(run, sweeps):
    from tune_jobs.plan import Machine

    sweeps.machine = lambda address: Machine(7, source=f"the cluster at {address}")
    output = run("launch", "cartpole-ppo", "--dry-run", "--address", "auto").stdout
    assert "7, each on 1 CPU; the cluster at auto has 7 CPUs" in output


BAD_INPUT = {
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
    "no file": ({"spec": "nothing.yaml"}, 2, ["'nothing.yaml'", "cartpole-ppo"]),
    "no yaml": ({"text": "env: [\n"}, 2, ["sweep.yaml, line 2"]),
    "bad name": ({"more": ["--name", "a/b"]}, 2, ["'a/b'"]),
    "bad --set": ({"set": "oops"}, 2, ["--set oops: this is no assignment"]),
    "too many CPUs": ({"set": "resources.num_env_runners=1000"}, 5, ["1001 CPUs", "this machine has"]),
    "contradiction": (
        {"set": "hyperparams.minibatch_size=4096"},
        2,
        ["point 0", "minibatch_size 4096 is larger"],
    ),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_clear_message_and_nothing_is_written(run, tmp_path, case):
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


def test_presets_are_listed_and_printed(run, tmp_path):
    assert "cartpole-ppo" in run("presets").stdout
    assert "cartpole-ppo" in {preset["name"] for preset in json.loads(run("presets", "--json").stdout)}
    (tmp_path / "own.yaml").write_text(run("presets", "cartpole-ppo").stdout)
    assert run("launch", "own.yaml", "--dry-run").exit_code == 0
    missing = run("presets", "cartpole-pp")
    assert missing.exit_code == 2
    assert "Did you mean 'cartpole-ppo'?" in missing.stderr


def test_the_schema_is_json_with_and_without_asking_for_it(run):
    assert json.loads(run("schema").stdout) == json.loads(run("schema", "--json").stdout)
    assert "properties" in json.loads(run("schema").stdout)


def test_every_command_takes_json_and_has_a_one_line_help():
    for name, command in cli.commands.items():
        assert any("--json" in parameter.opts for parameter in command.params), name
        assert command.help, name


def test_version_and_help(run):
    assert run("--version").stdout.startswith("tune-jobs ")
    assert run("-h").exit_code == 0
    assert "130 interrupted" in " ".join(run("--help").stdout.split())


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["launch", "cartpole-ppo", "--dry-run"], ["launch", "nope", "--dry-run"], ["schema"]],
)
def test_nothing_heavy_is_imported_before_it_is_needed(arguments):
    code = (
        "import sys, tune_jobs.cli\n"
        "try:\n"
        f"    tune_jobs.cli.cli({arguments!r})\n"
        "except SystemExit:\n"
        "    pass\n"
        f"print('HEAVY', [name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.splitlines()[-1] == "HEAVY []"
