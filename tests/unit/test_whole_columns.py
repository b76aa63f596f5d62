"""Tables on a terminal have whole columns, and name those it has no room for; a pipe has all of them."""

import dataclasses
import io
import re
import sys
from collections.abc import Callable

import pytest
from fake_results import IMPORTANCE
from spec_errors import MINIMAL
from test_monitor import make_trial

from tune_jobs.cli.importance_view import show_importance
from tune_jobs.cli.plan_view import show_plan
from tune_jobs.cli.token_view import show_tokens
from tune_jobs.cli.trials_table import show_trials
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.service.access.tokens import Token
from tune_jobs.spec.file import load_spec

NAMES = ("lr", "gamma", "gae_lambda", "clip_param", "entropy_coeff", "vf_loss_coeff", "grad_clip", "vf_clip_param")
LEFT_OUT = "Left out, as 80 columns are too few: "


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def on_terminal(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], None]], str]:
    """What a function prints on a terminal of 80 columns."""

    def printed(call: Callable[[], None]) -> str:
        with monkeypatch.context() as patch:
            patch.setenv("COLUMNS", "80")
            patch.setenv("TERM", "xterm")
            patch.setattr(sys, "stdout", terminal := Terminal())
            call()
        lines = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue()).splitlines()
        assert all(len(line) <= 80 for line in lines)
        return "\n".join(lines)

    return printed


def show_two_tokens() -> None:
    made = 1.75e9
    show_tokens(
        [
            Token("a1b2c3d4", "continuous-integration", "submitter", made, made + 3e7, None, made + 50),
            Token("0f9e8d7c", "ana", "viewer", made, None, None, None),
        ],
        made + 100,
        as_json=False,
    )


def test_a_tokens_id_can_be_copied_at_80_columns(on_terminal: Callable[[Callable[[], None]], str]) -> None:
    text = on_terminal(show_two_tokens)
    for word in ("a1b2c3d4", "0f9e8d7c", "continuous-integration", "submitter", "expires"):
        assert word in text
    assert "…" not in text
    assert f"{LEFT_OUT}last used, made. To see them, widen the" in text


def test_a_pipe_has_all_of_a_tokens_columns(capsys: pytest.CaptureFixture[str]) -> None:
    show_two_tokens()
    header = next(line for line in capsys.readouterr().out.splitlines() if "name" in line)
    assert header.split() == ["id", "name", "role", "state", "made", "expires", "last", "used"]


def show_a_plan() -> None:
    space = {name: {"uniform": [0.0001, 0.9]} for name in NAMES}
    spec = load_spec({**MINIMAL, "space": space, "num_samples": 2})
    show_plan(spec, make_plan(spec, Machine(2)), as_json=False)


def test_a_plans_values_are_whole_at_80_columns(
    on_terminal: Callable[[Callable[[], None]], str], capsys: pytest.CaptureFixture[str]
) -> None:
    show_a_plan()
    wide = next(line for line in capsys.readouterr().out.splitlines() if "t0000" in line).split()
    text = on_terminal(show_a_plan)
    narrow = next(line for line in text.splitlines() if "t0000" in line).split()
    assert len(narrow) > 4
    assert set(narrow) < set(wide)
    assert narrow[:3] == wide[:3]
    assert LEFT_OUT in text


def test_scores_by_value_are_whole_at_80_columns(on_terminal: Callable[[Callable[[], None]], str]) -> None:
    levels = (dataclasses.replace(IMPORTANCE.effects[0].levels[0], label="0.0003162 to 0.003162", mean=188.1),)
    effect = dataclasses.replace(IMPORTANCE.effects[0], name="num_envs_per_env_runner", levels=levels)
    item = dataclasses.replace(IMPORTANCE.hyperparams[0], name="num_envs_per_env_runner")
    found = dataclasses.replace(IMPORTANCE, hyperparams=(item,), effects=(effect,))
    text = on_terminal(lambda: show_importance(found, as_json=False))
    for words in ("0.0003162 to 0.003162", " 188.1 ", " 20 to 60 % ", "mattered"):
        assert words in text
    assert "…" not in text
    assert f"{LEFT_OUT}95 % interval." in text


@pytest.mark.parametrize("force", ["1", None])
def test_a_pipe_has_all_columns_of_trials_where_colours_are_forced_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], force: str | None
) -> None:
    """As continuous integration forces them."""
    if force is not None:
        monkeypatch.setenv("FORCE_COLOR", force)
    point = {f"hyperparameter_number_{number}": 0.1 * number for number in range(12)}
    show_trials([make_trial(0, "completed", steps=10).model_copy(update={"point": point})], as_json=False)
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*point, "ended by"))
    assert "Left out" not in printed
