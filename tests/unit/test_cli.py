"""The command line: what it passes on, what it prints, its exit codes; and that no traceback is shown."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fake_sweeps import SWEEP, TRIALS, FakeSweeps, RunCommand, evaluation

from analysis.records import ReplicationRecord
from policies.errors import CannotRunError, NotFoundError, TrialsFailedError
from tune_jobs.cli.commands import cli
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.status import BestSoFar, SweepStatus

ROOT = Path(__file__).parents[2]
SMALL = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {uniform: [1e-4, 1e-2]}}\nnum_samples: 2\n"
HEAVY = ("ray", "torch", "pandas", "matplotlib", "imageio", "PIL")


def options(**given: Any) -> dict[str, Any]:
    """What the commands that run trials pass on, unless told otherwise."""
    return {"storage": None, "address": None, "finish": True, "progress": "auto", "wait_for_nodes": 0.0, **given}


LAUNCHED = {"overrides": ("a.b=1", "c=2"), "name": "n"}
SHOWN = {"storage": None, "progress": "auto"}
EVALUATED = {**SHOWN, "num_episodes": 100, "first_seed": None, "env_id": None, "action": None}
FILMED = {**SHOWN, "output": None, "seed": None, "env_id": None, "action": None}
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
    (
        "inject mine lr=1e-3 b=[64,64] --storage s",
        ("inject", ("mine", {"lr": 1e-3, "b": [64, 64]}), options(storage="s")),
    ),
    ("stop mine", ("stop", ("mine",), {"storage": None})),
    ("status mine --storage s", ("status", ("mine",), {"storage": "s"})),
    ("list --storage s", ("list_sweeps", ("s",), {})),
    ("trials mine", ("trials", ("mine",), {"storage": None})),
    ("best mine", ("best", ("mine",), {**SHOWN, "num_episodes": 100})),
    ("best mine --progress none", ("best", ("mine",), {"storage": None, "num_episodes": 100, "progress": "none"})),
    (
        "evaluate mine/t0001 --num-episodes 7 --first-seed 0",
        ("evaluate", ("mine/t0001",), {**EVALUATED, "num_episodes": 7, "first_seed": 0}),
    ),
    ("evaluate random --env CartPole-v1", ("evaluate", ("random",), {**EVALUATED, "env_id": "CartPole-v1"})),
    (
        "evaluate constant --env CartPole-v1 --action 1",
        ("evaluate", ("constant",), {**EVALUATED, "env_id": "CartPole-v1", "action": 1}),
    ),
    (
        "video constant --env Pendulum-v1 --action [-0.5]",
        ("video", ("constant",), {**FILMED, "env_id": "Pendulum-v1", "action": (-0.5,)}),
    ),
    ("video mine", ("video", ("mine",), FILMED)),
    ("video mine --output out --seed 0", ("video", ("mine",), {**FILMED, "output": "out", "seed": 0})),
    ("report mine", ("report", ("mine",), SHOWN)),
    ("report mine --progress none", ("report", ("mine",), {"storage": None, "progress": "none"})),
]


@pytest.mark.parametrize(("arguments", "call"), COMMANDS)
def test_commands_pass_their_arguments_on(
    run: RunCommand, sweeps: FakeSweeps, arguments: str, call: tuple[str, tuple[Any, ...], dict[str, Any]]
) -> None:
    result = run(*arguments.split())
    assert sweeps.calls == [call]
    assert result.exit_code == (3 if call[0] in ("launch", "resume", "extend", "inject") else 0)


@pytest.mark.parametrize("arguments", [arguments for arguments, _ in COMMANDS])
def test_json_is_one_document_on_standard_output_whatever_else_is_printed(
    run: RunCommand, sweeps: FakeSweeps, arguments: str
) -> None:
    result = run(*arguments.split(), "--json")
    json.loads(result.stdout, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))


def test_the_document_of_a_launch_holds_everything(run: RunCommand, sweeps: FakeSweeps) -> None:
    document = json.loads(run("launch", "x", "--json").stdout)
    assert document["exit_code"] == 3
    assert document["trials"][1]["training_return"] is None
    assert document["best"]["optimism_gap"] == 5.0
    assert document["best"]["confirmation"]["solved"] is True
    assert document["best"]["confirmation"]["mean_return"] == 195.0
    assert document["artifacts"]["report"].endswith("index.html")


def test_numbers_that_json_lacks_become_null() -> None:
    record = to_json(evaluation("x", float("nan"), float("inf")))
    assert record["returns"] == [None, None]
    assert record["mean_return"] is None


def test_a_launch_tells_the_winner_the_failures_and_where_all_lies(
    run: RunCommand, sweeps: FakeSweeps, tmp_path: Path
) -> None:
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


def test_an_interrupted_launch_says_how_to_resume_on_its_last_line(
    run: RunCommand, sweeps: FakeSweeps, tmp_path: Path
) -> None:
    place = str(tmp_path / "my sweeps" / "mine")
    sweeps.answers["launch"] = dataclasses.replace(
        sweeps.answers["launch"],
        place=place,
        best=None,
        why_no_best="no trial was evaluated",
        interrupted=True,
        exit_code=130,
    )
    result = run("launch", "x", "--storage", "my sweeps")
    assert result.exit_code == 130
    assert "no trial was evaluated" in result.stdout
    assert result.stderr.splitlines()[-1].endswith(f"tune-jobs resume '{place}'")


def test_trials_are_a_table_in_which_no_value_is_cut_or_taken_for_markup(run: RunCommand, sweeps: FakeSweeps) -> None:
    lines = run("trials", "mine").stdout.splitlines()
    failed = next(line for line in lines if "t0000" in line)
    for part in ("failed", "0.1", "64x32", "ValueError: [bold]step[/bold] broke"):
        assert part in failed
    completed = next(line for line in lines if "t0001" in line)
    for part in ("completed", "3e-05", "1 min 1 s", "200.0", "training_return"):
        assert part in completed


def test_a_sweep_whose_process_is_gone_is_not_called_running(run: RunCommand, sweeps: FakeSweeps) -> None:
    running = SWEEP.model_copy(update={"state": "running"})
    sweeps.answers["status"] = SweepStatus(running, {"running": 2}, alive=False)
    assert "interrupted" in run("status", "mine").stdout
    sweeps.answers["status"] = SweepStatus(running, {"running": 2}, alive=True)
    assert "interrupted" not in run("status", "mine").stdout


BEST_SO_FAR = BestSoFar("t0003", 7, 7_168, {"lr": 3e-5}, 9, 123.45)
RUNNING = SweepStatus(
    SWEEP.model_copy(update={"state": "running", "run_time_s": 0.0}), {"completed": 1, "running": 2}, alive=True,
    num_env_steps=79_999, max_env_steps=160_000, env_steps_per_s=1_234.5, time_left_s=84.0, best=BEST_SO_FAR,
)  # fmt: skip


def facts(output: str) -> dict[str, str]:
    """The lines of a command that prints facts, by name."""
    pairs = (line.split("  ", 1) for line in output.splitlines() if "  " in line.strip())
    return {name.strip(): text.strip() for name, text in pairs}


def test_the_status_tells_progress_the_best_and_the_time_left(run: RunCommand, sweeps: FakeSweeps) -> None:
    sweeps.answers["status"] = RUNNING
    told = facts(run("status", "mine").stdout)
    assert told["progress"] == "49 %: 79,999 of at most 160,000 env steps"
    assert told["trials"] == "2: 1 completed, 2 running"
    assert told["best so far"] == "123.5  lr 3e-05  (t0003, at 7,168 env steps)"
    assert told["speed"] == "1,234 env steps/s"
    assert told["time left"] == "about 1 min 24 s"
    document = json.loads(run("status", "mine", "--json").stdout)
    assert (document["num_env_steps"], document["max_env_steps"], document["time_left_s"]) == (79_999, 160_000, 84.0)
    assert (document["best"]["trial_id"], document["best"]["score"]) == ("t0003", 123.45)
    assert document["counts"] == {"completed": 1, "running": 2}


@pytest.mark.parametrize(
    ("state", "alive", "words"),
    [
        ("running", True, "not known before the trials that are left report env steps"),
        ("completed", True, "the trials are done; the best is being confirmed and filmed, and the report written"),
        ("interrupted", False, "nothing runs; `tune-jobs resume '/my sweeps/mine'` continues it"),
        ("created", False, "nothing runs; `tune-jobs resume '/my sweeps/mine'` starts it"),
        ("completed", False, None),
    ],
)
def test_time_left_is_told_in_words_where_there_is_no_number(
    run: RunCommand, sweeps: FakeSweeps, state: str, alive: bool, words: str | None
) -> None:
    record = SWEEP.model_copy(update={"state": state})
    changes: dict[str, Any] = {"alive": alive, "time_left_s": None, "place": "/my sweeps/mine"}
    sweeps.answers["status"] = dataclasses.replace(RUNNING, sweep=record, **changes)
    assert facts(run("status", "mine", "--storage", "/my sweeps").stdout).get("time left") == words


def test_why_the_time_left_is_not_known(run: RunCommand, sweeps: FakeSweeps) -> None:
    def told(*, steps: int, **record: Any) -> str:
        update = {"state": "running", "spec": {"env": "CartPole-v1", "algorithm": "ppo", "num_samples": 2}, **record}
        known = SWEEP.model_copy(update=update)
        sweeps.answers["status"] = dataclasses.replace(RUNNING, sweep=known, num_env_steps=steps, time_left_s=None)
        return facts(run("status", "mine").stdout)["time left"]

    race = (ReplicationRecord(num_points=2, points=(0, 1), by="confirm"),)
    assert told(steps=0) == "not known before the first env steps are reported"
    leaders = "not known before the leaders that get more seeds report env steps"
    assert told(steps=5_000, num_trials=4, replications=race) == leaders
    # Points that came after the race are what runs.
    assert (
        told(steps=5_000, num_trials=6, replications=race)
        == "not known before the trials that are left report env steps"
    )
    # What another version wrote is no reason to say nothing.
    assert told(steps=5_000, spec={}, replications=race) == "not known before the trials that are left report env steps"


def test_a_status_without_scores_steps_or_a_known_spec_says_so(run: RunCommand, sweeps: FakeSweeps) -> None:
    sweeps.answers["status"] = SweepStatus(SWEEP, {}, alive=False)
    told = facts(run("status", "mine").stdout)
    assert told["best so far"] == "no evaluation yet"
    assert told["progress"] == "0 env steps"
    assert told["trials"] == "2: none"
    assert "speed" not in told


def test_an_empty_storage_is_no_error(run: RunCommand, sweeps: FakeSweeps) -> None:
    sweeps.answers["list_sweeps"] = []
    assert "no sweeps" in run("list").stdout


def test_evaluations_are_told_beside_random_ones(run: RunCommand, sweeps: FakeSweeps) -> None:
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


@pytest.mark.parametrize(
    ("returns", "ends"),
    [
        ((-45.6321, 793.069), "-45.6 to 793.1"),
        ((-1.0, 0.5), "-1.000 to 0.500"),
        ((0.0123, 0.25), "0.012 to 0.250"),
        ((-3.0, 2_571_264.0), "-3 to 2571264"),
    ],
)
def test_the_least_and_the_largest_return_are_rounded_as_the_mean_is(
    run: RunCommand, sweeps: FakeSweeps, returns: tuple[float, float], ends: str
) -> None:
    sweeps.answers["evaluate"] = (evaluation("p", *returns), evaluation("random", 20.0))
    assert f"over 2 episodes ({ends})" in run("evaluate", "p").stdout


# -- errors


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (NotFoundError("No sweep 'mine'.", "List them."), 4),
        (CannotRunError("The storage is full.", "Free some."), 5),
        (TrialsFailedError("All failed.", "See trials."), 3),
        (KeyboardInterrupt(), 130),
        (SweepInterrupted(), 130),
    ],
)
def test_errors_end_with_message_hint_and_exit_code(run: RunCommand, sweeps: FakeSweeps, error: Any, code: int) -> None:
    sweeps.answers["launch"] = error
    result = run("launch", "x")
    assert result.exit_code == code
    message = getattr(error, "message", "Interrupted.")
    hint = "nothing was kept." if isinstance(error, SweepInterrupted) else "`tune-jobs resume SWEEP` continues it."
    assert f"error: {message}" in result.stderr
    assert getattr(error, "hint", hint) in result.stderr
    document = json.loads(run("launch", "x", "--json").stdout)
    assert (document["error"], document["exit_code"]) == (message, code)


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ("interrupted", "Interrupted; what is done is kept. Continue with: tune-jobs resume mine"),
        ("completed", "Interrupted; all trials are done. Make what is missing with: tune-jobs resume mine"),
    ],
)
def test_an_interrupted_sweep_is_shown_as_far_as_it_got(
    run: RunCommand, sweeps: FakeSweeps, state: str, told: str
) -> None:
    result = sweeps.answers["launch"]
    sweep = result.sweep.model_copy(update={"state": state})
    result = dataclasses.replace(result, sweep=sweep, interrupted=True, exit_code=130)
    sweeps.answers["launch"] = SweepInterrupted(result)
    shown = run("launch", "x")
    assert shown.exit_code == 130
    assert shown.stderr.strip().splitlines()[-1] == told
    assert json.loads(run("launch", "x", "--json").stdout)["exit_code"] == 130


def test_an_interrupted_extend_says_that_another_one_adds_again(run: RunCommand, sweeps: FakeSweeps) -> None:
    result = dataclasses.replace(sweeps.answers["extend"], interrupted=True, exit_code=130)
    sweeps.answers["extend"] = sweeps.answers["resume"] = SweepInterrupted(result)
    told = "The samples are in the sweep by now: extend again would add as many once more."
    first, last = run("extend", "mine", "--num-samples", 3).stderr.strip().splitlines()
    assert first == told
    assert last.endswith("tune-jobs resume mine")
    assert told not in run("resume", "mine").stderr


def test_an_unexpected_error_is_one_line_and_its_traceback_is_kept(
    run: RunCommand, sweeps: FakeSweeps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sweeps.answers["best"] = ZeroDivisionError("a bug")
    result = run("best", "mine")
    assert result.exit_code == 1
    assert "error: Unexpected ZeroDivisionError: a bug" in result.stderr
    (kept,) = tmp_path.glob("tune-jobs-error-*.txt")
    assert str(kept) in result.stderr
    assert "Traceback" in kept.read_text()


def test_debug_shows_the_traceback(tmp_path: Path, sweeps: FakeSweeps) -> None:
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
        ["inject", "mine"],
        ["inject", "mine", "lr"],
        ["inject", "mine", "lr="],
        ["inject", "mine", "=1"],
        ["inject", "mine", "lr=[1"],
        ["inject", "mine", "lr=1", "lr=2"],
        ["best", "mine", "--num-episodes", "x"],
        ["evaluate", "p", "--first-seed", "-1"],
        ["evaluate", "random"],
        ["video", "random"],
        ["video", "constant"],
        ["evaluate", "constant", "--env", "CartPole-v1", "--action", "left"],
    ],
)
def test_wrong_arguments_are_exit_code_2(run: RunCommand, sweeps: FakeSweeps, arguments: list[str]) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr
    assert sweeps.calls == []


@pytest.mark.parametrize("command", [("trials", "mine"), ("resume", "mine")])
def test_what_was_damaged_is_told_where_trials_are(
    run: RunCommand, sweeps: FakeSweeps, command: tuple[str, str]
) -> None:
    note = "checkpoint 000004 is damaged and kept as damaged/000004; the trial goes on from its start"
    trials = [TRIALS[0], TRIALS[1].model_copy(update={"notes": (note,)})]
    sweeps.answers["trials"] = trials
    sweeps.answers["resume"] = dataclasses.replace(sweeps.answers["resume"], trials=trials)
    assert f"t0001: {note}" in run(*command).output
