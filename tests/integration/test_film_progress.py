"""While a film is made, which frame is drawn is said."""

from pathlib import Path

import pytest

from policies.acting.policy import RandomPolicy
from policies.envs import modules as env_modules
from policies.errors import EnvError
from policies.guard import guarded
from policies.guard.guard import guarding
from tune_jobs.sweeps.filming import telling_frames

STEPS, DRAWING_S = 8, 0.4
SLOW = f"""
import time
from gymnasium.envs.classic_control import CartPoleEnv

class Slow(CartPoleEnv):
    def render(self):
        time.sleep({DRAWING_S})
        return super().render()
"""


@pytest.fixture
def slow_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    name = f"slow_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(SLOW)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(env_modules, "_allowed", {name})
    return f"{name}:Slow"


def test_the_frame_that_is_drawn_is_said(slow_id: str, tmp_path: Path) -> None:
    said = list[str]()
    with guarding() as guard:
        info = guarded.check_env(slow_id, None)
        policy = RandomPolicy(info.observation_space, info.action_space, env_id=info.env_id)
        with telling_frames(said.append, "filming it"):
            film = tmp_path / "film.mp4"
            guarded.record_video(policy, env_id=info.env_id, seeds=3, mp4=film, max_steps=STEPS)
        assert guard.num_renders == STEPS + 1
        told = list(said)
        guarded.evaluate_policy(policy, env_id=info.env_id, seeds=[1])
    assert film.stat().st_size > 0
    assert said == told, "it goes on after the film"
    assert said[0] == "filming it"
    frames = [int(text.removeprefix("filming it: frame ")) for text in said[1:]]
    assert frames == sorted(frames)
    # One is looked for twice a second.
    assert len(set(frames)) >= 3
    assert frames[0] >= 1
    assert frames[-1] <= STEPS + 1


def test_after_a_film_that_fails_nothing_is_said(slow_id: str, tmp_path: Path) -> None:
    said = list[str]()
    with guarding() as guard:
        before = guard.look
        policy_env = guarded.check_env("CartPole-v1", None)
        policy = RandomPolicy(policy_env.observation_space, policy_env.action_space, env_id="CartPole-v1")
        with pytest.raises(EnvError), telling_frames(said.append, "filming it"):
            guarded.record_video(policy, env_id=f"{slow_id}er", seeds=3, mp4=tmp_path / "film.mp4")
        assert guard.look is before
    assert said == ["filming it"]
