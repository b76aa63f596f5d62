"""compare, export, importance, replicate and reproduce on the command line: what they pass on, print and end with."""

import json
from typing import Any

import pytest
from fake_results import DIFFERENT
from fake_sweeps import FakeSweeps, RunCommand

from policies.errors import CannotRunError, NotFoundError, SpecError
from tune_jobs.sweeps.interrupted import SweepInterrupted

Call = tuple[str, tuple[Any, ...], dict[str, Any]]

COMPARED = {"objective": None, "top": 3, "html": None, "storage": None}
EXPORTED = {"output": None, "top": None, "storage": None}
REPLICATED = {
    "wait_for_nodes": 0.0,
    "top": 5,
    "seeds": 5,
    "storage": None,
    "address": None,
    "finish": True,
    "progress": "auto",
}
REPRODUCED = {"output": None, "progress": "auto", "storage": None}
COMMANDS: list[tuple[str, Call]] = [
    ("compare mine other", ("compare", (["mine", "other"],), COMPARED)),
    ("compare mine --top 4", ("compare", (["mine"],), {**COMPARED, "top": 4})),
    (
        "compare mine/t0003 other --objective area --html page.html --storage s",
        ("compare", (["mine/t0003", "other"],), {**COMPARED, "objective": "area", "html": "page.html", "storage": "s"}),
    ),
    ("export mine", ("export", (["mine"], None), EXPORTED)),
    ("export mine --format sweep", ("export", (["mine"], "sweep"), EXPORTED)),
    (
        "export mine --format latex --top 4 --out table.tex --storage s",
        ("export", (["mine"], "latex"), {"output": "table.tex", "top": 4, "storage": "s"}),
    ),
    ("export mine other --format pdf", ("export", (["mine", "other"], "pdf"), EXPORTED)),
    ("importance mine", ("importance", ("mine",), {"storage": None})),
    ("importance mine --storage s", ("importance", ("mine",), {"storage": "s"})),
    ("replicate mine", ("replicate", ("mine",), REPLICATED)),
    (
        "replicate mine --top 3 --seeds 2 --address auto --no-finish --progress none --storage s",
        (
            "replicate",
            ("mine",),
            {
                "top": 3,
                "seeds": 2,
                "storage": "s",
                "address": "auto",
                "finish": False,
                "progress": "none",
                "wait_for_nodes": 0.0,
            },
        ),
    ),
    ("reproduce mine/t0001", ("reproduce", ("mine/t0001",), REPRODUCED)),
    (
        "reproduce mine/t0001 --out again --progress none --storage s",
        ("reproduce", ("mine/t0001",), {"output": "again", "progress": "none", "storage": "s"}),
    ),
]


@pytest.mark.parametrize(("arguments", "call"), COMMANDS)
def test_commands_pass_their_arguments_on(run: RunCommand, sweeps: FakeSweeps, arguments: str, call: Call) -> None:
    result = run(*arguments.split())
    assert sweeps.calls == [call]
    assert result.exit_code == (3 if call[0] == "replicate" else 0)


@pytest.mark.parametrize("arguments", [arguments for arguments, _ in COMMANDS])
def test_json_is_one_document_on_standard_output_whatever_else_is_printed(
    run: RunCommand, sweeps: FakeSweeps, arguments: str
) -> None:
    result = run(*arguments.split(), "--json")
    json.loads(result.stdout, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    assert "a library's chatter" in result.stderr


def test_a_comparison_is_facts_and_a_verdict(run: RunCommand, sweeps: FakeSweeps) -> None:
    output = run("compare", "mine", "other", "--html", "page.html").stdout
    for part in (
        "PPO on CartPole-v1", "[bold]x[/bold]", "A is better than B.", "+70.0 (+60.0 to +80.0 with 95 %)",
        "P(A > B), a training scores more: 0.90 (0.60 to 1.00 with 95 %)", "note: Their spaces are others.",
        "page  page.html",
    ):  # fmt: skip
        assert part in output
    document = json.loads(run("compare", "mine", "other", "--json").stdout)
    assert [item["name"] for item in document["entries"]] == ["mine", "other"]
    assert document["pairs"][0]["difference"]["mean"] == 70.0
    assert document["entries"][0]["df"] is None  # infinite


def test_what_mattered_is_sentences_and_tables(run: RunCommand, sweeps: FakeSweeps) -> None:
    output = run("importance", "mine").stdout
    for part in (
        "depends most on lr, which accounts for 40 % (20 to 60 %)", "Judged at [5,000] env steps.", "mattered",
        "Scores by value: return in the later half of training", "188.0", "180.0 to 196.0",
    ):  # fmt: skip
        assert part in output
    document = json.loads(run("importance", "mine", "--json").stdout)
    assert document["hyperparams"][1] == {"name": "gamma", "share": None, "low": None, "high": None, "is_clear": False}
    assert document["effects"][0]["levels"][1]["mean"] is None


def test_an_export_says_what_it_wrote(run: RunCommand, sweeps: FakeSweeps) -> None:
    output = run("export", "mine").stdout
    assert "trials    mine-csv/trials.csv" in output
    assert "settings  mine-csv/settings.csv" in output
    assert json.loads(run("export", "mine", "--json").stdout) == {
        "trials": "mine-csv/trials.csv", "settings": "mine-csv/settings.csv",
    }  # fmt: skip


def test_a_repetition_is_a_verdict_and_differences_are_exit_code_3(run: RunCommand, sweeps: FakeSweeps) -> None:
    equal = run("reproduce", "mine/t0001")
    assert "mine/t0001: all 6 iterations are equal, and the weights of 2 kept checkpoints." in equal.stdout
    assert "[dim]A note.[/dim]" in equal.stdout
    assert json.loads(run("reproduce", "mine/t0001", "--json").stdout)["equal"] is True
    sweeps.answers["reproduce"] = DIFFERENT
    different = run("reproduce", "mine/t0001")
    assert different.exit_code == 3
    assert "differs from iteration 4 of 6 on" in different.stdout
    assert "training_return: 20.0 was recorded, now nan" in different.stdout
    assert "cpu: One; now Another" in different.stdout
    shown = run("reproduce", "mine/t0001", "--json")
    document = json.loads(shown.stdout)
    assert (shown.exit_code, document["equal"], document["first_difference"]) == (3, False, 4)


@pytest.mark.parametrize("command", ["compare mine", "export mine", "importance mine", "reproduce mine/t0001"])
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (SpecError("They are the same.", "Name others."), 2),
        (NotFoundError("No sweep 'mine'.", "List them."), 4),
        (CannotRunError("The storage is full.", "Free some."), 5),
        (KeyboardInterrupt(), 130),
    ],
)
def test_errors_end_with_message_hint_and_exit_code(
    run: RunCommand, sweeps: FakeSweeps, command: str, error: Any, code: int
) -> None:
    words = command.split()
    sweeps.answers[words[0]] = error
    result = run(*words)
    assert result.exit_code == code
    message = getattr(error, "message", "Interrupted.")
    assert f"error: {message}" in result.stderr
    assert getattr(error, "hint", "") in result.stderr
    document = json.loads(run(*words, "--json").stdout)
    assert (document["error"], document["exit_code"]) == (message, code)


@pytest.mark.parametrize("command", ["replicate mine", "reproduce mine/t0001"])
def test_what_is_interrupted_before_it_began_changed_nothing(run: RunCommand, sweeps: FakeSweeps, command: str) -> None:
    words = command.split()
    sweeps.answers[words[0]] = SweepInterrupted()
    result = run(*words)
    assert result.exit_code == 130
    assert "nothing was changed." in result.stderr.lower()


def test_a_reproduction_that_is_interrupted_names_no_sweep_to_resume(run: RunCommand, sweeps: FakeSweeps) -> None:
    sweeps.answers["reproduce"] = KeyboardInterrupt()
    assert "Nothing was changed." in (told := run("reproduce", "mine/t0001").stderr)
    assert "resume" not in told


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["compare"], "SOURCES"),
        (["compare", "mine", "--objective", "fastest"], "steps_to_threshold"),
        (["compare", "mine", "--top", "1"], "--top"),
        (["export"], "SWEEPS"),
        (["export", "mine", "--format", "xlsx"], "parquet"),
        (["export", "mine", "--top", "0"], "--top"),
        (["importance"], "SWEEP"),
        (["importance", "mine", "other"], "other"),
        (["replicate", "mine", "--seeds", "0"], "--seeds"),
        (["replicate", "mine", "--top", "few"], "--top"),
        (["reproduce"], "SOURCE"),
        (["reproduce", "mine/t0001", "--progress", "loud"], "--progress"),
    ],
)
def test_wrong_arguments_are_exit_code_2_and_named(
    run: RunCommand, sweeps: FakeSweeps, arguments: list[str], named: str
) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert named in result.stderr
    assert sweeps.calls == []
