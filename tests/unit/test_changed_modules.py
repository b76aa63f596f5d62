"""Modules of a user's own in a notebook: imported again since, or from another working directory."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from policies.envs import modules as env_modules
from policies.envs.modules import (
    ENVIRONMENT_VARIABLE,
    allow_modules,
    import_allowed,
    look_in,
    module_folders,
    path_of,
)
from policies.errors import SpecError
from tune_jobs.plan.user_code import load_source


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a module that was imported as a notebook does, whose path has the folder as an empty text."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    (tmp_path / "changed_envs.py").write_text("import gymnasium\n\n\nclass Walk(gymnasium.Env):\n    pass\n")
    allow_modules(["changed_envs"])
    importlib.invalidate_caches()
    import_allowed("changed_envs:Walk")
    yield tmp_path
    del sys.modules["changed_envs"]


def test_a_class_of_a_module_that_was_imported_again_since_is_known_by_its_name(own: Path) -> None:
    """The notebook's own name of it is from before the module was edited."""
    before = import_allowed("changed_envs:Walk")
    importlib.reload(sys.modules["changed_envs"])
    assert import_allowed("changed_envs:Walk") is not before
    assert load_source({"env": before, "algorithm": "ppo"}).env.id == "changed_envs:Walk"
    sys.modules["changed_envs"].Walk = "no class any more"  # type: ignore[attr-defined]
    with pytest.raises(SpecError, match="Walk is defined in a function or class of changed_envs"):
        path_of(before, "environment")


MADE = """
import gymnasium


def make(level):
    return type("Maze", (gymnasium.Env,), {"level": level})


Maze = make(1)
"""


def test_of_classes_that_a_function_gives_one_name_only_the_modules_own_is_taken(own: Path) -> None:
    """The processes of trials would train in that one whichever is given."""
    (own / "changed_envs.py").write_text(MADE)
    module = importlib.reload(sys.modules["changed_envs"])
    assert path_of(module.Maze, "environment") == "changed_envs:Maze"
    with pytest.raises(SpecError, match=r"Maze is not the class that changed_envs\.Maze is now") as caught:
        load_source({"env": module.make(9), "algorithm": "ppo"})
    assert "needs a name of its own at the top level of changed_envs" in caught.value.hint


def test_the_folder_of_a_module_is_known_after_a_change_of_the_working_directory(
    own: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert module_folders() == [str(own)]


def test_a_folder_that_was_never_on_the_path_is_not_put_on_that_of_others_for_an_editable_installation(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of which setuptools puts the name of a finder on the path."""
    others = [entry for entry in sys.path if entry and Path(entry) != own]
    monkeypatch.setattr(sys, "path", ["__editable__.changed_envs-1.0.finder.__path_hook__", *others])
    assert module_folders() == []


def test_folders_of_another_process_are_looked_in_last_and_only_where_they_are(own: Path) -> None:
    before = list(sys.path)
    look_in([str(own), str(own / "of another machine"), before[-1]])
    assert sys.path == [*before, str(own)]
