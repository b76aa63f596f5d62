"""The systemd unit of the guide, read as systemd reads it."""

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tune_jobs.cli.serve_command import serve

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "service.md"


@pytest.fixture(scope="module")
def text() -> str:
    (found,) = re.findall(r"```ini\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    return str(found)


def test_it_is_stopped_after_sweeps_have_saved(text: str) -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read_string(text)
    service = unit["Service"]
    program, command, *options = service["ExecStart"].split()
    assert (Path(program).name, command) == ("tune-jobs", "serve")
    drain_s = serve.make_context("serve", options).params["drain_s"]
    assert drain_s < float(service["TimeoutStopSec"])
    # Else Ray's processes end before the trials have saved.
    assert service["KillMode"] == "mixed"
    assert service["Environment"] == f"TUNE_JOBS_STORAGE=/var/lib/{service['StateDirectory']}"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")
def test_systemd_understands_each_line(text: str, tmp_path: Path) -> None:
    unit = tmp_path / "tune-jobs.service"
    # It looks whether the program is there.
    unit.write_text(text.replace("/opt/tune-jobs/bin/tune-jobs", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False, timeout=60
    )
    said = [line for line in (done.stdout + done.stderr).splitlines() if unit.name in line]
    assert (done.returncode, said) == (0, [])
