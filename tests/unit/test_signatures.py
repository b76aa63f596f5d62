"""What functions take is known without evaluating their annotations, which Python 3.14 does where it is asked."""

import inspect
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.envs.registration import EnvSpec

from policies.envs.atari import AtariFrames
from policies.envs.own_vectors import takes_vector_entry_point
from policies.envs.rendering import without_window
from policies.envs.signatures import named_parameters, needs_nothing, takes_any_name

VALUE, STRING = 1, 4
"""Two members of Python 3.14's `annotationlib.Format`."""


class Game(CartPoleEnv):
    """Its annotations shall name what is imported for type checkers alone."""

    def __init__(self, render_mode: str | None = "human", frameskip: int = 4) -> None:
        super().__init__(render_mode=render_mode)
        self.frameskip = frameskip

    def action_mask(self) -> list[int]:
        return [1, 1]


def many(num_envs: int, **options: Any) -> None:
    """Stands for a vectorised version."""


@pytest.fixture
def _lazy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's signatures are as 3.14's: the annotations above name what does not exist."""
    real = inspect.signature

    def signature(function: Callable[..., Any], *, annotation_format: int = VALUE) -> inspect.Signature:
        if annotation_format != STRING and function.__module__ == __name__:
            raise NameError("name 'torch' is not defined")
        return real(function)

    monkeypatch.setattr(inspect, "signature", signature)
    monkeypatch.setattr(sys, "version_info", (3, 14, 0, "final", 0))
    monkeypatch.setitem(sys.modules, "annotationlib", SimpleNamespace(Format=SimpleNamespace(STRING=STRING)))


@pytest.mark.usefixtures("_lazy")
def test_annotations_that_cannot_be_evaluated_are_none_of_what_is_asked() -> None:
    assert named_parameters(Game) == {"render_mode", "frameskip"}
    assert not takes_any_name(Game)
    assert takes_any_name(many)
    assert needs_nothing(Game(None).action_mask)
    spec = EnvSpec("Game-v0", Game, vector_entry_point=many)  # type: ignore[arg-type]
    assert takes_vector_entry_point(spec, {})
    assert without_window(lambda **given: given, {}, creator=Game, given={}) == {"render_mode": None}
    assert AtariFrames().game_args("Game-v0", Game, {}) == {"frameskip": 1}


@pytest.mark.skipif(sys.version_info < (3, 14), reason="older Pythons evaluate annotations at once")
def test_names_that_only_type_checkers_know_are_not_looked_for() -> None:
    made: dict[str, Any] = {}
    exec("def make(device: torch.device | None = None, *, size: Missing[int] = 3, **rest: Any): ...", made)
    assert named_parameters(made["make"]) == {"device", "size"}
    assert takes_any_name(made["make"])
    assert needs_nothing(made["make"])
