"""Numbers, times, seeds and paths as a reader sees them."""

import math
from pathlib import Path

import pytest

from analysis.wording import (
    NONE,
    difference_text,
    duration,
    known_return_text,
    moment,
    number,
    range_text,
    return_text,
    seed_range,
    setting_text,
    shown_path,
)


def test_paths_below_the_current_folder_are_relative(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert shown_path(tmp_path / "sweeps" / "a") == "sweeps/a"
    assert shown_path(tmp_path.parent) == str(tmp_path.parent)


def test_small_returns_have_the_decimals_that_tell_them_apart() -> None:
    """As of FrozenLake, whose returns are shares of episodes, all of which one decimal makes 0.1 or 0.2."""
    assert [return_text(v) for v in (0.412, 0.418, 1.0, -0.05)] == ["0.412", "0.418", "1.000", "-0.050"]
    assert [return_text(v) for v in (0.00412, -4.18e-6, 4.18e-12)] == ["0.00412", "-0.00000418", "4.18e-12"]
    assert [difference_text(v) for v in (0.067, -0.0004)] == ["+0.067", "-0.000400"]
    # What stands beside each other has as many: the largest decides.
    assert [return_text(0.4123, 200.0), return_text(200.0, 0.4123)] == ["0.4", "200.0"]
    assert [return_text(0.0, 0.4), return_text(-1e-5, 0.4)] == ["0.000", "0.000"]
    assert [difference_text(-0.04, 200.0), difference_text(0.25, 0.4, 2.5)] == ["+0.0", "+0.2"]
    assert [range_text(0.26, 0.44), range_text(-0.5, 3.0), range_text(188.1, 199.9)] == [
        "0.260 to 0.440", "-0.5 to 3.0", "188.1 to 199.9",
    ]  # fmt: skip
    assert [return_text(math.inf), return_text(0.5, math.nan), known_return_text(0.5, math.inf)] == [
        "inf",
        "0.500",
        "0.500",
    ]


def test_numbers_read_well() -> None:
    assert [number(v) for v in (None, 0, 50176, 0.00123456, 1e-7, 200.0, True, "relu")] == [
        NONE, "0", "50,176", "0.001235", "1e-07", "200", "True", "relu",
    ]  # fmt: skip
    assert [number(v) for v in (999.4, 1234.6, 9999.6, 12345.6, -5e5 - 0.4, 1.5e15, math.inf, math.nan)] == [
        "999.4", "1,235", "10,000", "12,346", "-500,000", "1.5e+15", "inf", "nan",
    ]  # fmt: skip
    assert [duration(v) for v in (0.0, 42.2, 70.4, 7500)] == ["0.0 s", "42 s", "1 min 10 s", "2 h 5 min"]
    assert [duration(v, tenths=False) for v in (0.4, 9.7, 59.6)] == ["0 s", "10 s", "1 min 0 s"]
    assert [duration(v, none="-") for v in (math.nan, math.inf)] == ["-", "-"]
    assert [return_text(v) for v in (None, 0.0, -0.0, -78.25, 2.0)] == [NONE, "0.0", "0.0", "-78.2", "2.0"]
    assert [difference_text(v) for v in (12.34, -2.06, 0.0)] == ["+12.3", "-2.1", "+0.0"]
    assert [setting_text(v) for v in (None, 4096, 1e-3, 100000.0, [64, 64], True, "relu")] == [
        "-", "4096", "0.001", "1e+05", "64x64", "True", "relu",
    ]  # fmt: skip
    assert moment(0.0) == "1970-01-01 00:00 UTC"
    assert moment(None) == NONE
    assert [seed_range(s) for s in ((), (3,), (3, 4, 5), (3, 5))] == ["none", "3", "3 (3 to 5)", "2 (3, 5)"]
