"""What is said of errors: whatever others wrote into theirs, every file and terminal takes it."""

import json
import pickle
import re
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner

from policies.errors import EnvFailedError, TuneJobsError, fit, said_by, tellable
from tests.narrowing import present
from tune_jobs.cli.commands import cli
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED

DOCS = Path(__file__).parents[2] / "docs"


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


class WordlessError(Exception):
    def __str__(self) -> str:
        return cast("str", 3)


def kinds(kind: type[TuneJobsError]) -> list[type[TuneJobsError]]:
    return [kind, *(inner for outer in kind.__subclasses__() for inner in kinds(outer))]


@pytest.mark.parametrize("place", ["design.md", "reference/commands.md", "--help"])
def test_every_list_of_exit_codes_has_all_of_them(place: str) -> None:
    text = CliRunner().invoke(cli, [place]).output if place == "--help" else (DOCS / place).read_text()
    paragraph = " ".join(re.split(r"Exit codes:?\n?", text)[1].strip().split("\n\n")[0].split())
    listed = [int(code) for code in re.findall(r"(?:^|[,;] )(\d+)(?= [a-z])", paragraph)]
    assert listed == sorted({0, INTERRUPTED, *(kind.exit_code for kind in kinds(TuneJobsError))})


def test_what_others_wrote_is_text_that_can_be_written_and_shown() -> None:
    error = TuneJobsError("a \udcff b \x1b[2J c \x00", "d\r\n\te\ud800")
    assert (error.message, error.hint) == ("a \\udcff b \\x1b[2J c \\x00", "d\\r\n\te\\ud800")
    str(error).encode()
    assert pickle.loads(pickle.dumps(error)).args == error.args


def test_text_in_any_script_stays_as_it_is() -> None:
    assert fit("naïve 小車 🚗\n\tof two lines") == "naïve 小車 🚗\n\tof two lines"


@pytest.mark.parametrize("error", [MuteError(), WordlessError()])
def test_an_exception_that_cannot_be_shown_is_told_without_words(error: MuteError | WordlessError) -> None:
    assert said_by(error) == "it cannot be shown"


def test_of_a_long_message_the_middle_is_left_out() -> None:
    said = said_by(ValueError("begin" + "x" * 5_000_000 + "end."))
    assert len(said) < 2_100
    assert said.startswith("beginxxx")
    assert "[... 4,998,009 characters ...]" in said
    assert said.endswith("xxxend")


@pytest.mark.parametrize("error", [ValueError("\udcff"), ValueError("y" * 1_000_000), MuteError(), WordlessError()])
def test_an_envs_error_can_be_told(error: ValueError | MuteError | WordlessError) -> None:
    from policies.envs.faults import env_failed

    failed = env_failed("It raised an error in step()", error)
    assert isinstance(failed, EnvFailedError)
    assert len(failed.message) < 3_000
    json.dumps(failed.message, ensure_ascii=False).encode()


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (RuntimeError("display Surface quit"), "env.own_process: true"),
        (RuntimeError("video system not initialized"), "env.own_process: true"),
        (RuntimeError("font not initialized"), "env.own_process: true"),
        (AttributeError("module 'numpy' has no attribute 'bool8'. Did you mean: 'bool'?"), "an older NumPy"),
        (
            AttributeError("`np.float_` was removed in the NumPy 2.0 release. Use `np.float64` instead."),
            "an older NumPy",
        ),
        (TypeError("only 0-dimensional arrays can be converted to Python scalars"), "an older NumPy"),
        (ImportError("cannot import name 'Inf' from 'numpy' (numpy/__init__.py)"), "an older NumPy"),
        (ImportError("numpy.core.multiarray failed to import"), "an older NumPy"),
        (ValueError("numpy.dtype size changed, may indicate binary incompatibility"), "an older NumPy"),
        (ImportError("cannot import name 'inf' from 'numpyro'"), "Install the package"),
        (ImportError("libfoo is not there"), "Install the package"),
        (TypeError("Drive.reset() got an unexpected keyword argument 'options'"), "def reset(self, *, seed=None, "),
        (TypeError("reset() got an unexpected keyword argument 'seed'"), "def reset(self, *, seed=None, "),
        (TypeError("Masked.__init__() got an unexpected keyword argument 'render_mode'"), "take render_mode=None, "),
        (TypeError("Masked.__init__() got an unexpected keyword argument 'mode'"), None),
        (TypeError("preset() got an unexpected keyword argument 'seed'"), None),
        (ValueError("reset() got an unexpected keyword argument 'seed'"), None),
        (AttributeError("module 'nump' has no attribute 'bool8'"), None),
        (ValueError("the network is not initialized"), None),
        (MuteError(), None),
    ],
)
def test_what_to_do_about_an_error_of_an_env_is_known_by_its_words(error: Exception, advice: str | None) -> None:
    from policies.envs.faults import known_hint

    hint = known_hint(error)
    assert (hint is None) == (advice is None)
    assert (advice or "") in (hint or "")


def test_numpy_says_what_the_hint_goes_by() -> None:
    from policies.envs.faults import numpy_hint

    def take() -> None:
        from numpy import no_such_type  # type: ignore[attr-defined] # noqa: F401

    for said in (caught(lambda: np.no_such_type), caught(take)):  # type: ignore[attr-defined]
        assert said is not None
        assert f"older than {np.__version__}" in str(numpy_hint(said))


def caught(raise_it: Callable[[], Any]) -> Exception | None:
    try:
        raise_it()
    except Exception as error:  # noqa: BLE001
        return error
    return None


def raise_for_another() -> None:
    try:
        raise_alone()
    except ValueError as error:
        raise EnvFailedError(f"It failed: {error}.", "Mend it.") from error


def raise_alone() -> None:
    raise ValueError("\udcff")


@pytest.mark.parametrize(
    ("raise_it", "kind", "words"),
    [
        (raise_for_another, EnvFailedError, "It failed: \\udcff.\nMend it."),
        (raise_alone, TuneJobsError, "ValueError: \\udcff"),
    ],
)
def test_an_error_can_be_carried_to_another_process_whatever_it_was_raised_for(
    raise_it: Callable[[], Any], kind: type[EnvFailedError] | type[TuneJobsError], words: str
) -> None:
    """As Ray does it: with its traceback, that of its cause included, in UTF-8."""
    told = tellable(present(caught(raise_it)))
    assert (type(told), str(told)) == (kind, words)
    "".join(traceback.format_exception(told)).encode()


def test_other_errors_are_carried_as_they_are() -> None:
    error = present(caught(lambda: cast("dict[str, int]", {})["a key"]))
    assert tellable(error) is error
