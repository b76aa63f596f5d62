"""Where environments print to outside of trials: standard error, and the sweep's log while it is being finished."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

LOUD = (
    "import os\nfrom hostile_envs import Hostile\n"
    "class Loud(Hostile):\n"
    "    def reset(self, **kwargs):\n"
    "        print('by Python')\n"
    "        os.write(1, b'by the system\\n')\n"
    "        os.write(2, b'as an error\\n')\n"
    "        os.system('echo by a child')\n"
    "        return super().reset(**kwargs)\n"
)
SAID = ("by Python", "by the system", "as an error", "by a child")
ROOT = Path(__file__).parents[2]


@pytest.fixture
def said_by(tmp_path: Path) -> Callable[[str], str]:
    """Run a program with a loud environment, and return what is on its standard error."""
    (tmp_path / "loud_envs.py").write_text(LOUD)

    def run(code: str) -> str:
        paths = os.pathsep.join([str(tmp_path), str(ROOT / "tests" / "unit"), str(ROOT)])
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONPATH": paths, "TUNE_JOBS_ALLOWED_MODULES": "loud_envs", "PYTHONUNBUFFERED": ""},
            cwd=tmp_path,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stdout == ""
        return done.stderr

    return run


BEGINNING = (
    "from pathlib import Path\n"
    "from policies.guard import guarded\n"
    "from policies.guard.guard import guarding\n"
    "def look(): guarded.check_env('loud_envs:Loud', {})\n"
)


def test_in_the_block_the_log_has_it_and_before_and_after_standard_error(
    said_by: Callable[[str], str], tmp_path: Path
) -> None:
    said = said_by(
        f"{BEGINNING}"
        "def sizes(): return [path.stat().st_size for path in (Path('logs/a.log'), Path('logs/b.log'))]\n"
        "with guarding():\n"
        "    look()\n"
        "    with guarded.printing_to(Path('logs/a.log')):\n"
        "        look()\n"
        "        with guarded.printing_to(Path('logs/b.log')):\n"
        "            look()\n"
        "        look()\n"
        "    look()\n"
        "    before = sizes()\n"
        "    look()\n"
        "assert sizes() == before, sizes()\n"
    )
    texts = said, *((tmp_path / "logs" / name).read_text() for name in ("a.log", "b.log"))
    once = texts[2].count("by the system")
    assert once > 0
    for text, times in zip(texts, (3, 2, 1), strict=True):
        assert {what: text.count(what) for what in SAID} == dict.fromkeys(SAID, times * once)


def test_a_log_that_can_not_be_written_leaves_it_on_standard_error(said_by: Callable[[str], str]) -> None:
    said = said_by(f"{BEGINNING}with guarded.printing_to(Path('loud_envs.py/log')):\n    look()\n")
    assert all(what in said for what in SAID)


def test_the_children_of_parallel_episodes_print_there_too(said_by: Callable[[str], str], tmp_path: Path) -> None:
    said = said_by(
        f"{BEGINNING}"
        "with guarding() as guard, guarded.printing_to(Path('a.log')):\n"
        "    for other in guard.others(2):\n"
        "        other.run('check_env', 'loud_envs:Loud', env_args={}, algorithm=None)\n"
    )
    assert "by the system" not in said
    assert (tmp_path / "a.log").read_text().count("by the system") >= 2


FINISHING = (
    "from pathlib import Path\n"
    "from tune_jobs.store.sweep_store import SweepStore\n"
    "from tune_jobs.sweeps.finishing import _Finish\n"
    "from policies.guard import guarded\n"
    "store = SweepStore(Path('mine'))\n"
    "store.create()\n"
    "{before}\n"
    "with _Finish(store, 'none', keep=False)._working('choosing') as say:\n"
    "    guarded.check_env('loud_envs:Loud', {{}})\n"
)


def test_while_a_sweep_is_finished_its_log_has_it(said_by: Callable[[str], str], tmp_path: Path) -> None:
    said = said_by(FINISHING.format(before=""))
    assert "by the system" not in said
    assert all(what in (tmp_path / "mine" / "driver.log").read_text() for what in SAID)


def test_a_sweep_whose_log_is_a_link_is_finished_all_the_same(said_by: Callable[[str], str], tmp_path: Path) -> None:
    said = said_by(FINISHING.format(before="Path('mine/driver.log').symlink_to('elsewhere')"))
    assert all(what in said for what in SAID)
    assert not (tmp_path / "mine" / "elsewhere").exists()
