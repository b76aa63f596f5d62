"""Modules of a user's own: which may be imported, from where, and as what."""

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from click.testing import Result

from analysis.records import SweepRecord
from policies.envs import modules as env_modules
from policies.envs.make import check_env, make_env, make_vector_env, normalize_env_id
from policies.envs.modules import (
    ENVIRONMENT_VARIABLE,
    allow_modules,
    allowed_modules,
    import_allowed,
    module_folders,
    path_of,
)
from policies.errors import EnvError, SpecError
from tune_jobs.plan.user_code import load_source, modules_of
from tune_jobs.spec.sweep_spec import SweepSpec

SOURCE = """
import gymnasium as gym
import numpy as np


class Walk(gym.Env):
    metadata = {"render_modes": []}

    def __init__(self, length=3):
        self.length = length
        self.observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.ticks = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.ticks += 1
        return np.zeros(2, np.float32), 1.0, self.ticks >= self.length, False, {}


class Limited(gym.Wrapper):
    def __init__(self, length, render_mode=None):
        super().__init__(gym.wrappers.TimeLimit(Walk(length), 2))
        self.given = render_mode


class NoEnv:
    pass


for version in (1, 2):
    if f"OwnWalk-v{version}" not in gym.registry:
        gym.register(f"OwnWalk-v{version}", Walk, max_episode_steps=9, reward_threshold=2.5)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with modules, of which none is allowed, that is the current one and not on the path."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["/nowhere", *sys.path])
    (tmp_path / "own_walks.py").write_text(SOURCE)
    (tmp_path / "own_broken.py").write_text("import own_missing_dependency\n")
    (tmp_path / "own_raising.py").write_text("raise ZeroDivisionError('at import')\n")
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package" / "__init__.py").write_text("")
    (tmp_path / "own_package" / "inner.py").write_text("THING = 3\n")
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("own_")]:
        del sys.modules[name]
    for env_id in [env_id for env_id in gym.registry if env_id.startswith("OwnWalk")]:
        del gym.registry[env_id]


def test_a_module_is_imported_only_once_it_is_allowed(own: Path) -> None:
    with pytest.raises(SpecError, match="'own_walks' is not allowed") as caught:
        import_allowed("own_walks:Walk")
    assert "--allow-module own_walks" in caught.value.hint
    assert "own_walks" not in sys.modules
    allow_modules(["own_walks"])
    assert import_allowed("own_walks:Walk").__name__ == "Walk"
    assert allowed_modules() == ("own_walks",)


def test_the_environment_variable_allows_for_other_processes(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "own_package.inner, own_walks,")
    assert allowed_modules() == ("own_package.inner", "own_walks")
    assert import_allowed("own_package.inner:THING") == 3


def test_a_package_brings_its_submodules_but_no_name_that_begins_alike(own: Path) -> None:
    allow_modules(["own_package"])
    assert import_allowed("own_package.inner:THING") == 3
    allow_modules(["own_walk"])
    with pytest.raises(SpecError, match="not allowed"):
        import_allowed("own_walks:Walk")


def test_a_submodule_alone_brings_no_other(own: Path) -> None:
    allow_modules(["own_package.other"])
    with pytest.raises(SpecError, match="not allowed"):
        import_allowed("own_package.inner:THING")


@pytest.mark.parametrize("name", ["own_walks.py", "own walks", "", "a..b", "a:b", "1a", ".a", "a/b"])
def test_what_is_no_modules_name_cannot_be_allowed(own: Path, name: str) -> None:
    with pytest.raises(SpecError, match="not the name of a Python module"):
        allow_modules(["own_walks", name])
    assert allowed_modules() == ()


@pytest.mark.parametrize(
    ("path", "words", "hint"),
    [
        ("own_nowhere:A", "'own_nowhere' is allowed, but it was not found", "PYTHONPATH"),
        ("own_broken:A", "ModuleNotFoundError.*own_missing_dependency", "import own_broken"),
        ("own_raising:A", "ZeroDivisionError: at import", "import own_raising"),
        ("own_walks:Wlak", "has nothing called 'Wlak'", "name"),
        ("own_walks", "does not name something", "module:Name"),
        ("own_walks:", "does not name something", "module:Name"),
        (":Walk", "does not name something", "module:Name"),
        ("own_walks:Walk.step", "does not name something", "module:Name"),
    ],
)
def test_what_cannot_be_imported_says_why(own: Path, path: str, words: str, hint: str) -> None:
    allow_modules(["own_nowhere", "own_broken", "own_raising", "own_walks"])
    with pytest.raises(SpecError, match=words) as caught:
        import_allowed(path)
    assert hint in caught.value.hint


def test_an_env_of_an_allowed_module_keeps_its_module_in_its_id(own: Path) -> None:
    with pytest.raises(EnvError, match=r"'own_walks:OwnWalk-v1' names a module.*not allowed"):
        make_env("own_walks:OwnWalk-v1")
    allow_modules(["own_walks"])
    assert normalize_env_id("own_walks:OwnWalk") == "own_walks:OwnWalk-v2"
    info = check_env("own_walks:OwnWalk-v1", {"length": 5}, "dqn")
    assert (info.env_id, info.threshold, info.max_episode_steps) == ("own_walks:OwnWalk-v1", 2.5, 9)
    env = make_vector_env(" own_walks:OwnWalk-v1", {"length": 5}, 2)
    assert [one.unwrapped.length for one in env.unwrapped.envs] == [5, 5]


def test_an_env_class_of_an_allowed_module_needs_no_registration(own: Path) -> None:
    allow_modules(["own_walks"])
    info = check_env("own_walks:Walk", {"max_episode_steps": 2, "length": 7}, "ppo")
    assert (info.env_id, info.threshold, info.max_episode_steps) == ("own_walks:Walk", None, 2)
    env = make_env("own_walks:Walk", {"max_episode_steps": 2})
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(2)] == [False, True]
    with pytest.raises(EnvError, match=r"own_walks:Walk takes no argument 'lenght'.*'length'"):
        make_env("own_walks:Walk", {"lenght": 2})


def test_a_wrapper_of_an_allowed_module_is_an_env_class_too(own: Path) -> None:
    allow_modules(["own_walks"])
    info = check_env("own_walks:Limited", {"length": 7}, "ppo")
    assert (info.env_id, info.max_episode_steps, info.has_vector_entry_point) == ("own_walks:Limited", 2, False)
    env = make_vector_env("own_walks:Limited", {"length": 7}, 2)
    env.reset(seed=0)
    assert [env.step(np.zeros(2, np.int64))[3].tolist() for _ in range(2)] == [[False] * 2, [True] * 2]
    drawn: Any = make_env("own_walks:Limited", {"length": 7}, render_mode="rgb_array")
    while type(drawn).__name__ != "Limited":
        drawn = drawn.env
    assert drawn.given == "rgb_array"
    with pytest.raises(EnvError, match=r"own_walks:Limited takes no argument 'lenght'.*'length'"):
        make_env("own_walks:Limited", {"lenght": 2})


@pytest.mark.parametrize("entry", ["Limited", "'own_wrapped:Limited'", "'own_apart:Limited'"])
def test_a_wrapper_that_a_module_registers_is_an_env_too(own: Path, entry: str) -> None:
    """Gymnasium refuses to make it: "Expect the environment metadata to be dict, actual type: <class 'module'>"."""
    # As of a package whose modules are imported only when an environment is made.
    (own / "own_apart.py").write_text("from own_walks import Limited\n")
    (own / "own_wrapped.py").write_text(
        f"import gymnasium as gym\nfrom own_walks import Limited\n"
        f"gym.register('OwnWalkWrapped-v0', {entry}, max_episode_steps=5, kwargs={{'length': 7}})\n"
    )
    allow_modules(["own_wrapped"])
    info = check_env("own_wrapped:OwnWalkWrapped-v0", {"max_episode_steps": 1}, "ppo")
    assert (info.env_id, info.max_episode_steps) == ("own_wrapped:OwnWalkWrapped-v0", 1)
    env = make_env("own_wrapped:OwnWalkWrapped-v0")
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(2)] == [False, True]
    drawn: Any = make_env("own_wrapped:OwnWalkWrapped-v0", render_mode="rgb_array")
    assert drawn.get_wrapper_attr("given") == "rgb_array"
    assert len(make_vector_env("own_wrapped:OwnWalkWrapped-v0", {}, 2).unwrapped.envs) == 2
    # The entry itself stays as it is.
    assert not callable(getattr(gym.registry["OwnWalkWrapped-v0"].entry_point, "func", None))


NAMESAKES = """
import gymnasium as gym
import own_walks
from own_walks import Walk


class CartPole(own_walks.Walk):
    pass


class OwnWalk(own_walks.Walk):
    pass


gym.register("OwnWalk-v5", lambda: OwnWalk(5))
gym.register("Walk-v3", "own_walks:Walk", max_episode_steps=7)
"""


@pytest.mark.parametrize(
    ("name", "meant", "env_id"),
    [
        ("CartPole", "CartPole", "own_names:CartPole"),
        ("CartPole-v1", "CartPoleEnv", "own_names:CartPole-v1"),
        ("Acrobot", "AcrobotEnv", "own_names:Acrobot-v1"),
        # What is registered has a time limit that the class alone has not.
        ("OwnWalk", "OwnWalk", "own_names:OwnWalk-v5"),
        ("Walk", "Walk", "own_names:Walk-v3"),
    ],
)
def test_a_class_of_ones_own_may_have_the_name_of_anothers_environment(
    own: Path, monkeypatch: pytest.MonkeyPatch, name: str, meant: str, env_id: str
) -> None:
    (own / "own_names.py").write_text(NAMESAKES)
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)
    allow_modules(["own_names", "own_walks"])
    assert type(make_env(f"own_names:{name}").unwrapped).__name__ == meant
    assert normalize_env_id(f"own_names:{name}") == env_id


@pytest.mark.parametrize(
    ("env_id", "written"),
    [
        ("own_walks/Nowhere-v0", "own_walks:own_walks/Nowhere-v0"),
        ("own-walks/Nowhere-v0", "own_walks:own-walks/Nowhere-v0"),
        ("own_nowhere/Walk-v0", None),
        ("own_walks", None),
    ],
)
def test_a_namespace_that_is_a_module_may_be_what_registers_it(
    own: Path, monkeypatch: pytest.MonkeyPatch, env_id: str, written: str | None
) -> None:
    monkeypatch.syspath_prepend(own)
    with pytest.raises(EnvError, match="is registered with Gymnasium") as failure:
        make_env(env_id)
    assert ("registers it, that is written" in failure.value.hint) is (written is not None)
    assert (written or "") in failure.value.hint
    assert "own_walks" not in sys.modules


@pytest.mark.parametrize(("name", "guess"), [("Wlak", "Walk"), ("NoEnv", ""), ("OwnWalk-v7", "OwnWalk-v"), ("", "")])
def test_a_name_that_is_no_env_of_the_module_is_refused(own: Path, name: str, guess: str) -> None:
    allow_modules(["own_walks"])
    with pytest.raises(EnvError, match=f"neither registers an environment '{name}'.*{guess}"):
        make_env(f"own_walks:{name}")


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ("from own_registering.parts import *", True),
        ("def register_envs(): pass", True),
        ("from gymnasium import register, register_envs", False),
        ("exec('def register_envs(): pass', made := {}); register_envs = made['register_envs']", False),
        ("registered = True", False),
        ("class register: pass", False),
        ("def deregister(): pass", False),
    ],
)
def test_a_function_of_the_module_that_may_register_it_is_named(own: Path, source: str, *, named: bool) -> None:
    (own / "own_registering").mkdir()
    (own / "own_registering" / "parts.py").write_text("def register_envs(): pass\n")
    (own / "own_registering" / "__init__.py").write_text(source)
    allow_modules(["own_registering"])
    with pytest.raises(EnvError, match="neither registers an environment 'Walk-v0'") as failure:
        make_env("own_registering:Walk-v0")
    assert ("if own_registering.register_envs() registers it" in failure.value.hint) is named
    assert ("call gymnasium.register in the module" in failure.value.hint) is not named


def test_a_module_for_an_older_numpy_is_refused_with_what_to_do(own: Path) -> None:
    (own / "own_old.py").write_text("import numpy as np\nWHOLE = np.no_such_type\n")
    allow_modules(["own_old"])
    with pytest.raises(EnvError, match="no attribute 'no_such_type'") as failure:
        make_env("own_old:Walk-v0")
    assert "written for a NumPy older than" in failure.value.hint


def test_a_class_becomes_its_path_and_allows_its_module(own: Path) -> None:
    allow_modules(["own_walks"])
    walk = import_allowed("own_walks:Walk")
    allow_modules([])
    env_modules._allowed.clear()
    spec = load_source({"env": {"id": walk, "args": {"length": 2}}, "algorithm": "ppo"})
    assert (spec.env.id, spec.env.args) == ("own_walks:Walk", {"length": 2})
    assert modules_of(spec) == allowed_modules() == ("own_walks",)
    assert load_source({"env": walk, "algorithm": "ppo"}).env.id == "own_walks:Walk"


def test_an_rl_module_by_python_call_is_named_and_allowed(own: Path) -> None:
    spec = load_source({"env": "CartPole-v1", "algorithm": "ppo"}, rl_module="own_package.inner:Net")
    assert spec.rl_module == "own_package.inner:Net"
    assert modules_of(spec) == allowed_modules() == ("own_package.inner",)
    env_modules._allowed.clear()
    # In a mapping it is what a sweep file could say: named, and not allowed by that.
    assert load_source({"env": "CartPole-v1", "algorithm": "ppo", "rl_module": "own_walks:Net"}).rl_module
    assert allowed_modules() == ()


def test_a_class_that_no_other_process_finds_is_refused(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Local(gym.Env[Any, Any]):
        pass

    with pytest.raises(SpecError, match=r"Local is defined in a function or class") as caught:
        load_source({"env": Local, "algorithm": "ppo"})
    assert "module" in caught.value.hint
    in_script = type("Script", (gym.Env,), {"__module__": "__main__"})
    monkeypatch.setattr(sys.modules["__main__"], "Script", in_script, raising=False)
    with pytest.raises(SpecError, match="Script is defined in the main script"):
        path_of(in_script, "environment")
    with pytest.raises(SpecError, match=r"is not a gymnasium\.Env"):
        load_source({"env": dict, "algorithm": "ppo"})
    assert allowed_modules() == ()


def test_the_folders_of_imported_modules_are_known(own: Path) -> None:
    allow_modules(["own_walks", "own_package.inner", "own_nowhere", "json"])
    assert str(own) not in module_folders()
    import_allowed("own_walks:Walk")
    import_allowed("own_package.inner:THING")
    assert module_folders().count(str(own)) == 1


def test_a_sweep_json_from_before_there_were_allowed_modules_is_read() -> None:
    record = SweepRecord(
        name="old", state="completed", spec={"env": {"id": "CartPole-v1", "args": {"max_episode_steps": 9}},
        "algorithm": "ppo"}, evaluation_seeds=(1,), confirmation_seeds=(2,), num_trials=1, created_at=0.0,
    )  # fmt: skip
    data = record.model_dump(mode="json")
    assert data.pop("allowed_modules") == []
    again = SweepRecord.model_validate(data)
    assert again.allowed_modules == ()
    spec = SweepSpec.model_validate(again.spec)
    assert (spec.env.wrapped_args, spec.env.failure_penalty, spec.rl_module) == ({"max_episode_steps": 9}, None, None)


def test_the_command_line_allows_what_a_sweep_file_cannot(own: Path, run: Callable[..., Result]) -> None:
    (own / "own_walks.py").write_text(f"{SOURCE}\nprint('a word on standard output')\n")
    (own / "sweep.yaml").write_text("env: own_walks:OwnWalk\nalgorithm: ppo\n")
    refused = run("launch", "sweep.yaml", "--dry-run")
    assert refused.exit_code == 2
    assert "'own_walks' is not allowed" in refused.output
    done = run("launch", "sweep.yaml", "--dry-run", "--json", "--allow-module", "own_walks")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["plan"]["env"]["id"] == "own_walks:OwnWalk-v2"
    assert run("resume", "none", "--allow-module", "own-walks").exit_code == 2
    (own / "sweep.yaml").write_text("env: own_walks:OwnWalk\nalgorithm: ppo\nallowed_modules: [own_walks]\n")
    assert "allowed_modules" in run("launch", "sweep.yaml", "--dry-run").output


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("algorithm: ppo\nrl_module: own_walks:Walk", "rl_module is own_walks:Walk.*not allowed"),
        ("algorithm: ppo\nrl_module: own_package.inner:THING", "rl_module is own_package.inner:THING, which is no"),
        ("algorithm: random\nrl_module: own_package.inner:THING", "own_package.inner:THING, but algorithm random"),
        ("algorithm: ppo\nrl_module: own_package.inner:NOTHING", "has nothing called 'NOTHING'"),
    ],
)
def test_an_rl_module_is_checked_before_anything_starts(
    own: Path, run: Callable[..., Result], text: str, words: str
) -> None:
    (own / "sweep.yaml").write_text(f"env: CartPole-v1\n{text}\n")
    result = run("launch", "sweep.yaml", "--dry-run", "--allow-module", "own_package")
    assert result.exit_code == 2
    assert re.search(words, result.output)
