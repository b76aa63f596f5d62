"""Where an environment fails, what its own package asks for and does not get is named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from policies.envs.faults import name_hint
from policies.envs.make import check_env
from policies.envs.modules import import_module_allowed
from policies.envs.requirements import module_of_file, unmet_requirements
from policies.errors import EnvError, SpecError

Install = Callable[..., str]
MEND = "Check the env's arguments against its documentation."


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Installs a package with a class `Robot`, whose constructor runs some code, and returns its name."""

    def install(requires: list[str], code: str = "raise ValueError('an arm too many')", top: str = "") -> str:
        name = f"robots_{tmp_path.name}"
        folder, info = tmp_path / name, tmp_path / f"{name}-2.1.dist-info"
        folder.mkdir()
        info.mkdir()
        lines = [top, "from gymnasium.envs.classic_control import CartPoleEnv", "class Robot(CartPoleEnv):"]
        lines += ["    def __init__(self, render_mode=None):", f"        {code}"]
        (folder / "__init__.py").write_text("\n".join(lines) + "\n")
        wanted = "".join(f"Requires-Dist: {text}\n" for text in requires)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 2.1\n{wanted}")
        (info / "top_level.txt").write_text(f"{name}\n")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr("policies.envs.modules._allowed", {name})
        return name

    return install


def hint_on(name: str) -> str:
    with pytest.raises(EnvError) as failure:
        check_env(f"{name}:Robot", None)
    return failure.value.hint


def test_a_requirement_of_another_version_is_named_where_an_env_fails(install: Install) -> None:
    name = install(["numpy<1.0", "gymnasium>=1.0", "no-such-package>=3"])
    assert hint_on(name) == (
        f"{MEND} {name} 2.1 asks for numpy<1.0, where {np.__version__} is installed: that may be why."
    )


def test_a_package_that_is_not_there_is_named_where_an_import_fails(install: Install) -> None:
    name = install(["no-such-package>=3", "numpy<1.0"], "import no_such_module")
    assert hint_on(name) == (
        "Install the package that the message names, on every machine that runs trials. "
        f"{name} 2.1 asks for numpy<1.0, where {np.__version__} is installed; no-such-package>=3, which is not "
        "installed: that may be why."
    )


def test_a_module_that_cannot_be_imported_names_them_too(install: Install) -> None:
    name = install(["numpy<1.0"], top="from numpy import no_such_name")
    with pytest.raises(SpecError) as failure:
        import_module_allowed(name)
    assert f"{name} 2.1 asks for numpy<1.0, where {np.__version__} is installed" in failure.value.hint


@pytest.mark.parametrize(
    "requires",
    [
        [],
        ["numpy>=1.0"],
        ["no-such-package; extra == 'all'", "numpy<1.0; extra == 'all'"],
        ["numpy<1.0; python_version < '3.0'"],
        ["numpy (unreadable"],
        ["no-such-package"],
    ],
    ids=str,
)
def test_what_is_met_or_not_asked_for_here_is_not_named(install: Install, requires: list[str]) -> None:
    assert hint_on(install(requires)) == MEND


@pytest.mark.parametrize(
    "metadata",
    [
        b"",
        b"Metadata-Version: 2.1\nName: {name}\nRequires-Dist: numpy<1.0\n",
        b"Metadata-Version: 2.1\nName: {name}\nVersion: 2.1\nRequires-Dist: {name}>=3\n",
        b"Metadata-Version: 2.1\nVersion: 2.1\nRequires-Dist: numpy<1.0\n",
        b"Metadata-Version: 2.1\nName: {name}\nVersion: new\nRequires-Dist: {name}>=3\n",
        b"Name: {name}\nVersion: 2.1\nRequires-Dist: \xff\xfe<1\n",
    ],
    ids=str,
)
def test_whatever_the_metadata_is_the_env_s_own_error_is_told(
    install: Install, tmp_path: Path, metadata: bytes
) -> None:
    name = install([])
    (tmp_path / f"{name}-2.1.dist-info" / "METADATA").write_bytes(metadata.replace(b"{name}", name.encode()))
    with pytest.raises(EnvError, match="an arm too many") as failure:
        check_env(f"{name}:Robot", None)
    assert failure.value.hint.startswith(MEND)


def test_what_was_installed_by_nothing_known_asks_for_nothing() -> None:
    assert unmet_requirements("no_such_module_at_all") is None
    assert module_of_file("/no/such/place/robots/arm.py") is None


def test_a_file_belongs_to_the_module_at_the_innermost_place_of_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = tmp_path / "lib" / "packages"
    monkeypatch.setattr("sys.path", ["", str(tmp_path), str(inner)])
    assert module_of_file(str(inner / "robots" / "parts" / "arm.py")) == "robots"
    assert module_of_file(str(inner / "arm.py")) == "arm"
    assert module_of_file(str(tmp_path / "lib" / "arm.py")) == "lib"


@pytest.mark.parametrize(
    ("error", "package"),
    [
        (ModuleNotFoundError("No module named 'pkg_resources'"), "setuptools<82"),
        (ModuleNotFoundError("No module named 'cv2.gapi'"), "opencv-python-headless"),
        (ModuleNotFoundError("No module named 'no_such_module'"), None),
        (RuntimeError("No module named 'cv2'"), None),
        (ImportError("cannot import name 'no_such_name' from 'yaml'"), None),
    ],
    ids=str,
)
def test_a_module_is_installed_by_the_name_of_its_package(error: Exception, package: str | None) -> None:
    wanted = f'Install it, on every machine that runs trials: pip install "{package}".'
    assert name_hint(error) == (None if package is None else wanted)


def test_the_name_of_the_package_is_said_where_an_env_is_made(install: Install) -> None:
    name = install([], "raise ModuleNotFoundError(\"No module named 'pkg_resources'\")")
    assert hint_on(name) == 'Install it, on every machine that runs trials: pip install "setuptools<82".'
