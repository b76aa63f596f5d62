"""A policy is loaded from where its sweep is kept."""

import json
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest
from policy_factory import make_image_policy, make_portable
from store_parts import make_best, make_sweep
from stores import LocalHarness, ObjectHarness

import tune_jobs
from policies.acting.load import load_policy as load_alone
from policies.errors import NotFoundError
from policies.portable.file import save_policy

ROOT = Path(__file__).parents[2]
WITHOUT_THE_REST = """
import importlib.metadata, json, re, sys

allowed = {"tune-jobs", *json.loads(sys.argv[1])}
known = importlib.metadata.packages_distributions()
refused = {
    name for name, brought_by in known.items()
    if not {re.sub("[-_.]+", "-", one).lower() for one in brought_by} & allowed
}
# What the interpreter's own start imported would be found without being looked for.
for name in [name for name in sys.modules if name.partition(".")[0] in refused]:
    del sys.modules[name]

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in refused:
            raise ModuleNotFoundError(f"{name} is not installed here", name=name)

sys.meta_path.insert(0, Refused())
"""


def test_a_sweeps_best_is_loaded_by_its_url(tmp_path: Path) -> None:
    sweep = ObjectHarness(tmp_path).storage().sweep("mine")
    sweep.create()
    with pytest.raises(NotFoundError, match="mine"):
        tune_jobs.load_policy(sweep.place)
    sweep.write_record(make_sweep())
    with pytest.raises(NotFoundError, match="no best policy yet"):
        tune_jobs.load_policy(sweep.place)
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    assert tune_jobs.load_policy(sweep.place).env_id == "CartPole-v1"


def test_a_sweeps_best_is_loaded_by_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = LocalHarness(tmp_path).storage().sweep("mine")
    sweep.create()
    sweep.write_record(make_sweep())
    with pytest.raises(NotFoundError, match="no best policy yet"):
        tune_jobs.load_policy(sweep.place)
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    assert tune_jobs.load_policy(sweep.place).env_id == "CartPole-v1"
    monkeypatch.chdir(sweep.place)
    assert tune_jobs.load_policy(".").env_id == "CartPole-v1"
    # A folder that holds none is no sweep's, whatever it is called.
    with pytest.raises(NotFoundError, match="There is no policy file"):
        tune_jobs.load_policy(tmp_path)


def test_a_tilde_is_a_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    save_policy(make_portable("CartPole-v1"), tmp_path / "p")
    for path in ("~/p", "~/p/policy.json", "~/p/policy.safetensors", Path("~/p")):
        assert tune_jobs.load_policy(path).env_id == load_alone(path).env_id == "CartPole-v1"
    sweep = LocalHarness(tmp_path).storage().sweep("mine")
    sweep.create()
    sweep.write_record(make_sweep())
    sweep.write_best(make_best(), make_portable("Pendulum-v1"))
    assert tune_jobs.load_policy(f"~/{Path(sweep.place).relative_to(tmp_path)}").env_id == "Pendulum-v1"
    # The ~ of somebody who isn't known is a name.
    for load in (tune_jobs.load_policy, load_alone):
        with pytest.raises(NotFoundError, match="~nobody-at-all/p"):
            load("~nobody-at-all/p")


def test_without_what_opens_sweeps_a_folder_that_holds_no_policy_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tune_jobs.store.opening", None)
    with pytest.raises(NotFoundError, match="There is no policy file"):
        tune_jobs.load_policy(tmp_path)


def test_a_file_is_loaded_without_ray_torch_or_what_asks_an_object_store(tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    code = (
        f"import sys, tune_jobs; print(tune_jobs.load_policy({str(tmp_path)!r}).env_id); "
        "print({'ray', 'torch', 'obstore', 'tune_jobs.sweeps.verbs'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["CartPole-v1", "set()"]


def named_packages() -> list[str]:
    """The packages that the guide says are enough to act."""
    guide = (ROOT / "docs" / "guides" / "restore.md").read_text()
    (line,) = re.findall(r"^pip install ((?!-)[\w ]+)$", guide, re.MULTILINE)
    return str(line).split()


def with_their_own(names: list[str]) -> list[str]:
    """These packages, and what pip installs along with them."""
    found: list[str] = []
    waiting = list(names)
    while waiting:
        name = re.sub("[-_.]+", "-", waiting.pop()).lower()
        if name not in found:
            found.append(name)
            needed = [text for text in requires(name) or () if "extra ==" not in text]
            waiting += [re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in needed]
    return found


def test_none_of_the_packages_that_are_said_to_be_enough_to_act_can_be_left_out(tmp_path: Path) -> None:
    packages = named_packages()
    for name in packages:
        done = act_without_the_rest(tmp_path, [other for other in with_their_own(packages) if other != name])
        assert done.returncode != 0
        assert f"{name} is not installed here" in done.stderr


def test_the_packages_that_are_said_to_be_enough_to_act_are(tmp_path: Path) -> None:
    done = act_without_the_rest(tmp_path, with_their_own(named_packages()))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["ray", "torch", "click", "yaml"]
    # The two tables say the same.
    for page in ("README.md", "docs/benchmarks.md"):
        text = (ROOT / page).read_text()
        (row,) = re.findall(r"^\| best policy usable without the framework .*\| yes: (.*) \|$", text, re.MULTILINE)
        assert row.split(", ") == named_packages()


def act_without_the_rest(folder: Path, packages: list[str]) -> "subprocess.CompletedProcess[str]":
    """Load policies and act in a process that finds no third-party module but those of these packages."""
    portables = [make_portable("CartPole-v1"), make_portable("Pendulum-v1"), make_image_policy()]
    for number, portable in enumerate(portables):
        save_policy(portable, folder / str(number))
    code = f"""{WITHOUT_THE_REST}
import tune_jobs

for number in range({len(portables)}):
    policy = tune_jobs.load_policy(f"{{sys.argv[2]}}/{{number}}")
    action = policy.act(policy.observation_space.sample())
    assert policy.action_space.contains(action), action
for name in ("ray", "torch", "click", "yaml"):
    try:
        __import__(name)
    except ModuleNotFoundError:
        print(name)
"""
    command = [sys.executable, "-c", code, json.dumps(packages), str(folder)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
