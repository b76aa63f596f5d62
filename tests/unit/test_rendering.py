from __future__ import annotations

import importlib
import os
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import pytest

from policies.acting.policy import RandomPolicy
from policies.acting.video import record_video
from policies.envs import rendering
from policies.envs.faults import close_env
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.rendering import choose_before_import, display_hint, draw_without_display, drawing_hint
from policies.errors import EnvError

VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "SDL_AUDIODRIVER", "MUJOCO_GL")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only on Linux are there machines without a display")


@pytest.fixture(autouse=True)
def _nothing_is_known_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in VARIABLES:
        # Set first, so that what a test leaves behind is taken away.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    rendering._mujoco_backend.cache_clear()
    yield
    rendering._mujoco_backend.cache_clear()


def draw_where(
    monkeypatch: pytest.MonkeyPatch, *backends: str, imported: bool = True, with_dm_control: bool = False
) -> list[str]:
    """Prepare to draw where these backends work, and return which ones were tried."""
    tried: list[str] = []

    def draws(backend: str) -> bool:
        tried.append(backend)
        return backend in backends

    monkeypatch.setattr(rendering, "_draws", draws)
    monkeypatch.setattr(rendering, "find_spec", {"dm_control": with_dm_control}.get)
    if imported:
        monkeypatch.setitem(sys.modules, "mujoco", types.ModuleType("mujoco"))
    else:
        monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    draw_without_display()
    return tried


@pytest.mark.parametrize(
    ("working", "chosen", "tried"),
    [
        (["egl", "osmesa"], "egl", ["egl"]),
        (["osmesa"], "osmesa", ["egl", "osmesa"]),
        # What MuJoCo says then names what is missing.
        ([], None, ["egl", "osmesa"]),
    ],
)
def test_without_a_display_mujoco_draws_with_the_first_that_works(
    monkeypatch: pytest.MonkeyPatch, working: list[str], chosen: str | None, tried: list[str]
) -> None:
    assert draw_where(monkeypatch, *working) == tried
    assert os.environ.get("MUJOCO_GL") == chosen
    draw_without_display()
    assert os.environ.get("MUJOCO_GL") == chosen


def test_what_works_is_looked_for_once_in_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = draw_where(monkeypatch)
    draw_without_display()
    assert tried == ["egl", "osmesa"]


@pytest.mark.parametrize("name", ["DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"])
def test_what_the_user_has_set_stays(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "glfw")
    assert draw_where(monkeypatch, "egl") == []
    assert os.environ.get("MUJOCO_GL") == ("glfw" if name == "MUJOCO_GL" else None)
    assert os.environ.get("SDL_VIDEODRIVER") == ("dummy" if name == "MUJOCO_GL" else None)


def test_who_draws_no_robot_waits_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert draw_where(monkeypatch, "egl", imported=False) == []
    assert "MUJOCO_GL" not in os.environ


def test_what_chooses_when_it_is_imported_finds_the_choice_made(monkeypatch: pytest.MonkeyPatch) -> None:
    assert draw_where(monkeypatch, "egl", imported=False, with_dm_control=True) == ["egl"]
    assert os.environ["MUJOCO_GL"] == "egl"


def test_before_an_import_nothing_is_tried_for_what_may_not_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_where(monkeypatch, with_dm_control=True)
    rendering._mujoco_backend.cache_clear()
    monkeypatch.setattr(rendering, "_draws", pytest.fail)
    # What is imported may be told when something is drawn: a plan of a robot need not wait for that.
    choose_before_import()
    monkeypatch.delitem(sys.modules, "mujoco")
    monkeypatch.setattr(rendering, "find_spec", lambda _: None)
    choose_before_import()
    assert "MUJOCO_GL" not in os.environ


EARLY = """
import os
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

given = os.environ.get("MUJOCO_GL")

class Early(CartPoleEnv):
    def __init__(self, render_mode=None):
        raise ValueError(repr(given))

gym.register("Early-v0", Early)
"""
"""A module that chooses what it draws with when it is imported."""
IN_CHILD = """
from policies.guard import child

arguments = {"env_id": "%sEarly-v0", "env_args": {}, "algorithm": None}
asked = {"folders": ["."], "module_folders": [], "modules": ["chooses_early"], "job": "check_env"}
print(child._answer({**asked, "arguments": arguments}, None))
"""
IN_TRIAL = """
from policies.envs.make import make_env
from policies.envs.modules import allow_modules

allow_modules(["chooses_early"])
make_env("chooses_early:Early-v0", {"pixels": %s})
"""


@pytest.mark.parametrize(
    ("program", "found"),
    [
        # What is evaluated there may be filmed later.
        (IN_CHILD % "chooses_early:", "'egl'"),
        ("import chooses_early" + IN_CHILD % "", "None"),
        (IN_TRIAL % True, "'egl'"),
        (IN_TRIAL % False, "None"),
    ],
)
def test_the_choice_is_made_before_a_module_that_may_be_drawn(tmp_path: Path, program: str, found: str) -> None:
    (tmp_path / "chooses_early.py").write_text(EARLY)
    (tmp_path / "dm_control").mkdir()
    (tmp_path / "dm_control" / "__init__.py").touch()
    code = "from policies.envs import rendering\nrendering._draws = lambda backend: True\n" + program
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert f"ValueError: {found}" in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("program", "draws"),
    [
        ("import sys; sys.exit(0)", True),
        ("raise ImportError('no device')", False),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", False),
        ("import time; time.sleep(60)", False),
    ],
)
def test_a_library_that_fails_crashes_or_hangs_does_not_draw(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, program: str, draws: bool
) -> None:
    package = tmp_path / "mujoco" / "egl"
    package.mkdir(parents=True)
    (tmp_path / "mujoco" / "__init__.py").touch()
    lines = [
        "import os",
        "class GLContext:",
        "    def __init__(self, width: int, height: int) -> None: pass",
        "    def make_current(self) -> None: assert os.environ['MUJOCO_GL'] == 'egl'",
        program,
    ]
    (package / "__init__.py").write_text("\n".join(lines) + "\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    if "sleep" in program:
        monkeypatch.setattr(rendering, "_TRIAL_TIMEOUT_S", 1.0)
    assert rendering._draws("egl") is draws


def test_a_robot_is_drawn_without_a_display_and_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    if rendering._mujoco_backend() is None:
        pytest.skip("neither EGL nor OSMesa draws here")
    # In a process of its own: in this one MuJoCo's libraries may be loaded for another way to draw.
    program = """
from policies.envs.make import make_env

env = make_env("Hopper-v5", render_mode="rgb_array")
env.reset(seed=0)
picture = env.render()
print(picture.shape, picture.std() > 10)
env.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    # What Mesa says of this machine's drivers is its own.
    said = [line for line in done.stderr.splitlines() if not line.startswith(("libEGL", "MESA"))]
    assert (done.stdout, said) == ("(480, 480, 3) True\n", [])


@pytest.mark.parametrize("display", [None, ":0"])
@pytest.mark.parametrize("where", ["import", "constructor", "render", "another error"])
def test_who_wants_a_display_is_told_what_gives_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str, display: str | None
) -> None:
    said = "what broke" if where == "another error" else "Cannot connect to display None"
    lines = ["import gymnasium as gym", "from gymnasium.envs.classic_control import CartPoleEnv"]
    lines += ["class Window(CartPoleEnv):", "    def __init__(self, render_mode=None):"]
    fails = f"raise Exception({said!r})"
    lines += ["        super().__init__(render_mode)" if where == "render" else f"        {fails}"]
    lines += ["    def render(self):", f"        {fails}", "gym.register('Window-v0', Window)"]
    name = f"wants_a_window_{where.replace(' ', '_')}_{'with' if display else 'without'}"
    (tmp_path / f"{name}.py").write_text("\n".join([fails] * (where == "import") + lines) + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("policies.envs.modules._allowed", {name})
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(EnvError, match=said) as failure:
        record_video(RandomPolicy.for_env("CartPole-v1"), env_id=f"{name}:Window-v0", seeds=0)
    assert ("xvfb-run" in failure.value.hint) == (display is None and where != "another error")
    assert failure.value.hint


WITH_A_WINDOW = """
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

made = []


class Window(CartPoleEnv):
    def __init__(self, render_mode{default}, is_right=True):
        made.append(render_mode)
        if {refuses}:
            raise ValueError("not without a window")
        if not is_right:
            raise ValueError("it is not right")
        super().__init__(render_mode)


gym.register("SelfShown-v0", Window, max_episode_steps=5{given})
"""


@pytest.fixture
def with_a_window(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., types.ModuleType]:
    """Import a module of an env whose window opens by itself."""
    monkeypatch.syspath_prepend(tmp_path)
    # So that what a test registers is taken away.
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)

    def make(default: str, refuses: str = "False", given: str = "") -> types.ModuleType:
        name = f"window_{tmp_path.name}"
        (tmp_path / f"{name}.py").write_text(WITH_A_WINDOW.format(default=default, refuses=refuses, given=given))
        monkeypatch.setattr("policies.envs.modules._allowed", {name})
        return importlib.import_module(name)

    return make


@pytest.mark.parametrize(
    ("default", "given"),
    [('="human"', ""), ("=None", ', kwargs={"render_mode": "human"}'), ("", ', kwargs={"render_mode": "human"}')],
)
def test_no_window_is_opened_where_nothing_is_to_be_seen(
    with_a_window: Callable[..., types.ModuleType], default: str, given: str
) -> None:
    module = with_a_window(default, given=given)
    for env_id in [f"{module.__name__}:SelfShown-v0"] + [f"{module.__name__}:Window"] * (default == '="human"'):
        check_env(env_id, None)
        make_vector_env(env_id, None, 2).close()
        assert set(module.made) == {None}
        close_env(make_env(env_id, render_mode="rgb_array"))
        close_env(make_env(env_id, render_mode="human"))
        assert [module.made.pop(), module.made.pop()] == ["human", "rgb_array"]


def test_an_env_that_takes_no_other_mode_than_a_window_gets_it(
    with_a_window: Callable[..., types.ModuleType],
) -> None:
    module = with_a_window('="human"', refuses='render_mode != "human"')
    close_env(make_env(f"{module.__name__}:Window"))
    assert module.made == [None, "human"]


@pytest.mark.parametrize("default", ['="rgb_array"', "=None"])
def test_other_modes_by_default_stay(with_a_window: Callable[..., types.ModuleType], default: str) -> None:
    module = with_a_window(default)
    close_env(make_env(f"{module.__name__}:Window"))
    assert module.made == ["rgb_array" if "rgb" in default else None]


def test_what_else_a_constructor_says_is_said(with_a_window: Callable[..., types.ModuleType]) -> None:
    module = with_a_window('="human"')
    with pytest.raises(EnvError, match="it is not right"):
        make_env(f"{module.__name__}:Window", {"is_right": False})


@pytest.mark.parametrize("where", ["constructor", "reset", "step"])
@pytest.mark.parametrize(
    "error", ["ModuleNotFoundError('No module named pyvirtualdisplay')", "ImportError('no libGL')"]
)
def test_what_is_not_installed_is_to_be_installed_wherever_it_is_missed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str, error: str
) -> None:
    lines = ["from gymnasium.envs.classic_control import CartPoleEnv", "class Lacking(CartPoleEnv):"]
    lines += [
        f"    def {'__init__' if where == 'constructor' else where}(self, *args, **kwargs):",
        f"        raise {error}",
    ]
    name = f"lacking_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text("\n".join(lines) + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("policies.envs.modules._allowed", {name})
    with pytest.raises(EnvError) as failure:
        check_env(f"{name}:Lacking", None)
    assert failure.value.hint == "Install the package that the message names, on every machine that runs trials."


class NoSuchDisplayException(Exception):  # noqa: N818 (as pyglet calls it)
    pass


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("error", "hinted"),
    [
        (NoSuchDisplayException('Cannot connect to "None"'), True),
        (OSError("X11: The DISPLAY environment variable is missing"), True),
        (KeyError("display_mode"), False),
        (ValueError("nothing is displayed"), False),
        (ImportError("this needs an X11 display"), True),
        # With a display it would be missing, too.
        (ModuleNotFoundError("No module named 'pyvirtualdisplay'"), False),
        (MuteError(), False),
    ],
)
def test_that_a_display_is_wanted_is_known_by_the_error_and_its_name(error: Exception, *, hinted: bool) -> None:
    assert (display_hint(error) is not None) is hinted


def raised_in_c(module: str) -> Exception:
    error: Exception = type("FatalError", (Exception,), {"__module__": module})("no more room")
    return error


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("the motor broke"), "Mend its render()"),
        (ValueError("negligible"), "Mend its render()"),
        (MuteError(), "Mend its render()"),
        (RuntimeError("an OpenGL platform library has not been loaded"), "libegl1"),
        (RuntimeError("No available video device"), "libegl1"),
        (ImportError("cannot import name"), "libegl1"),
        (
            gym.error.DependencyNotInstalled('pygame is not installed, run `pip install "gymnasium[toy-text]"`'),
            "libegl1",
        ),
        (OSError("X11: The DISPLAY environment variable is missing"), "xvfb-run"),
        (RuntimeError("gladLoadGL error"), "libegl1"),
        (RuntimeError("Offscreen framebuffer is not complete, error 0x0"), "libegl1"),
        (RuntimeError("x11 not available"), "libegl1"),
        (raised_in_c("mujoco"), "libegl1"),
        (raised_in_c("OpenGL.error"), "libegl1"),
        (raised_in_c("pygame"), "Mend its render()"),
        (raised_in_c("my_envs"), "Mend its render()"),
    ],
)
def test_only_who_lacks_something_to_draw_with_is_told_to_install_it(error: Exception, words: str) -> None:
    assert words in drawing_hint(error)


def test_what_raises_an_error_is_known_by_where_it_is_raised() -> None:
    """MuJoCo's libraries raise errors that speak of attributes where one is missing."""
    for package, words in (("OpenGL.raw", "libegl1"), ("my_envs.opengl", "Mend its render()")):
        caught = None
        try:
            exec("None.queryString", {"__name__": package})  # as it were a module of that package
        except AttributeError as error:
            caught = error
        assert caught is not None
        assert words in drawing_hint(caught)
