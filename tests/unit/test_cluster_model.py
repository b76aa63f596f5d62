"""The model of clusters that are not at hand, against what was measured on one that is and against what is known."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks.cluster.costs import wait_ms_a_trial
from tests.benchmarks.cluster.measured import Driven
from tests.benchmarks.cluster.model import Costs, Load, fitted, limits, predicted_cpu_s, read, table, used

ROOT = Path(__file__).parents[2]
MEASURED = ROOT / "tests" / "benchmarks" / "cluster" / "measured_costs.json"
COSTS = Costs(sweep_s=2.0, trial_s=0.005, report_s=0.001, gcs_s=0.002, requests=10.0)


def _driven(num_trials: int, num_reports: int, cpu_s: float) -> Driven:
    return Driven(
        num_trials, {}, num_reports, run_cpu_s=0.0, run_wall_s=0.0, launch_cpu_s=cpu_s, launch_wall_s=0.0, peak_bytes=0,
        work_s=0.0, daemons_cpu_s={"gcs_server": 0.002 * num_trials},
    )  # fmt: skip


def test_what_a_sweep_takes_beyond_its_trials_work() -> None:
    driven = dataclasses.replace(_driven(100, 100, 1.0), run_wall_s=8.0, work_s=300.0)
    # 50 at once: 6 s at least, and so 2 s too many.
    assert wait_ms_a_trial(driven, 50) == pytest.approx(20.0)


def test_costs_are_found_again() -> None:
    sizes = [(100, 100), (1_000, 1_000), (300, 900), (300, 3_000)]
    found = fitted([_driven(*size, predicted_cpu_s(COSTS, *size)) for size in sizes], requests=10.0)
    assert found.sweep_s == pytest.approx(2.0)
    assert found.trial_s == pytest.approx(0.005)
    assert found.report_s == pytest.approx(0.001)
    assert found.gcs_s == pytest.approx(0.002)


def test_no_cost_is_below_nothing() -> None:
    found = fitted([_driven(100, 100, 1.0), _driven(200, 200, 3.0), _driven(100, 600, 1.1)], requests=0.0)
    assert min(found.sweep_s, found.trial_s, found.report_s) >= 0
    with pytest.raises(ValueError, match="2 sweeps do not tell three costs apart"):
        fitted([_driven(1, 1, 1.0)] * 2, requests=0.0)


def test_one_trial_at_a_time_waits_for_nobody() -> None:
    outcome = used(COSTS, Load(num_at_once=1, work_s=3.0, reports=3))
    took_s = 3.0 + 3 * 0.001 + 0.005
    assert outcome.trials_per_s == pytest.approx(1 / took_s)
    assert outcome.driver_share == pytest.approx(0.008 / took_s)
    assert outcome.speed == pytest.approx(3.0 / took_s)


def test_a_driver_that_is_full_sets_the_pace() -> None:
    outcome = used(COSTS, Load(num_at_once=4_000, work_s=3.0, reports=3))
    assert outcome.trials_per_s == pytest.approx(1 / 0.008, rel=0.02)
    assert outcome.driver_share > 0.97
    assert outcome.speed < 0.1


def test_the_first_limit_is_named() -> None:
    few, many = Load(80, 600.0, 10), Load(8_000, 600.0, 10)
    assert limits(COSTS, few, used(COSTS, few)) == []
    assert limits(COSTS, many, used(COSTS, many)) == ["Ray's placement groups"]
    short = Load(800, 3.0, 3)
    assert limits(COSTS, short, used(COSTS, short))[0] == "the driver"


def test_the_model_has_the_driver_time_of_what_was_measured() -> None:
    costs = read(MEASURED)
    for item in json.loads(MEASURED.read_text())["sweeps"]:
        if item["kind"] == "single":
            driven = Driven(**item["driven"])
            predicted = predicted_cpu_s(costs, driven.num_trials, driven.num_reports)
            assert predicted == pytest.approx(driven.launch_cpu_s, rel=0.25), item


def test_the_guide_has_the_table_of_what_was_measured() -> None:
    guide = ROOT / "docs" / "guides" / "large-clusters.md"
    # Between empty lines, without which it is no table.
    assert f"\n\n{table(read(MEASURED))}\n\n" in guide.read_text(encoding="utf-8")


def test_the_program_prints_the_table_alone() -> None:
    command = [sys.executable, "-m", "tests.benchmarks.cluster.model", str(MEASURED)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == f"{table(read(MEASURED))}\n"
