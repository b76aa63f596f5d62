"""Atari games: what is observed of them everywhere, and what training alone sees of them.

The preprocessing is Gymnasium's `AtariPreprocessing`, which follows Machado et al. 2018, "Revisiting the Arcade
Learning Environment": a random number of no-ops after a reset, each action for several frames, the brighter of the last
two frames, as a small grey image of bytes. It belongs to the environment, so it travels in the env arguments, under the
reserved key `atari`. The lost lives and the clipped rewards of Mnih et al. 2015 belong to training alone, and are never
among the env arguments.

Words: a *game* is one whole episode, with all its lives; a *frame* is one picture of the emulator, of 60 in a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import AtariPreprocessing, TimeLimit
from numpy.typing import NDArray

from policies.envs.signatures import named_parameters
from policies.envs.training_view import TrainingView
from policies.errors import EnvError

ATARI = "atari"
INSTALL = "Install it, on every machine that runs trials: pip install 'tune-jobs[atari]'."
_FRAMES_PER_SECOND = 60
_PACKAGE = "ale_py"
_RAM = "ram"


@dataclass(frozen=True)
class AtariFrames:
    """The preprocessing of an Atari game's observations."""

    frame_skip: int = 4
    """The frames for which an action is repeated."""
    noop_max: int = 30
    """The most no-ops after a reset."""
    screen_size: int = 84
    """Rows and columns of the image."""

    @classmethod
    def take_from(cls, env_args: dict[str, Any]) -> Self | None:
        """Take the reserved key out of an environment's arguments; None: they have none.

        Raises:
            EnvError: Its value is no mapping of this class's fields to whole numbers.
        """
        given = env_args.pop(ATARI, None)
        if given is None:
            return None
        known = {one.name for one in fields(cls)}
        numbers = given.values() if isinstance(given, Mapping) else [None]
        if not all(isinstance(one, int) and not isinstance(one, bool) for one in numbers) or not known.issuperset(
            given
        ):
            raise EnvError(
                f"{ATARI} is {given!r}; it must be a mapping of {', '.join(sorted(known))} to whole numbers.",
                "Correct it, or leave it out.",
            )
        return cls(**given)

    def game_args(self, env_id: str, creator: Callable[..., Any] | None, env_args: Mapping[str, Any]) -> dict[str, Any]:
        """Return the constructor's arguments, so that the game itself skips no frames and has no limit of steps.

        Args:
            env_id: The env's id, for messages.
            creator: The env's class, or what makes it.
            env_args: The arguments of its constructor; `max_episode_steps` is left out.

        Raises:
            EnvError: The environment skips no frames, as an Atari game does, its arguments ask for it, or they ask for
                the emulator's memory in place of its screen.
        """
        args = {name: value for name, value in env_args.items() if name != "max_episode_steps"}
        takes = named_parameters(creator)
        if "frameskip" not in takes:
            raise _no_game(env_id)
        if args.setdefault("frameskip", 1) != 1:
            raise EnvError(
                f"The env argument 'frameskip' of {env_id} is {args['frameskip']!r}, but env.{ATARI} skips frames "
                "itself: they would be skipped twice.",
                f"Leave it out, and set env.{ATARI}.frame_skip.",
            )
        if args.get("obs_type") == _RAM:
            raise EnvError(
                f"The env argument 'obs_type' of {env_id} is {_RAM!r}, but env.{ATARI} observes the screen, not "
                "the emulator's memory.",
                f"Leave it out, or leave env.{ATARI} out.",
            )
        if "obs_type" in takes:
            # The frames are read from the emulator; drawing each of them in colour too would cost a tenth of the time.
            args.setdefault("obs_type", "grayscale")
        return args

    def limit_outside(self, spec: EnvSpec, env_args: dict[str, Any]) -> EnvSpec:
        """Return a registry entry without its limit, which goes to the arguments if they have none.

        Gymnasium would set it inside the preprocessing, where it counts frames.
        """
        if spec.max_episode_steps is None:
            return spec
        env_args.setdefault("max_episode_steps", spec.max_episode_steps)
        return replace(spec, max_episode_steps=None)

    def wrap(self, env: gym.Env[Any, Any], env_args: Mapping[str, Any]) -> gym.Env[Any, Any]:
        """Return a game with its preprocessing and, around it, its time limit in env steps.

        Args:
            env: Made with `game_args`.
            env_args: The arguments of its constructor, with those of its registry entry.

        Raises:
            EnvError: It is no Atari game, takes no no-ops where some are asked for, or OpenCV is not installed.
        """
        if not hasattr(env.unwrapped, "ale"):
            raise _no_game(env.spec.id if env.spec is not None else type(env.unwrapped).__name__)
        if self.noop_max and not isinstance(env.action_space, gym.spaces.Discrete):
            raise EnvError(
                f"env.{ATARI} begins a game with no-ops, up to {self.noop_max}, which a game with continuous actions "
                "does not take.",
                f"Set env.{ATARI}.noop_max: 0, or leave 'continuous' out of the env's arguments.",
            )
        try:
            wrapped: gym.Env[Any, Any] = AtariPreprocessing(
                env,
                noop_max=self.noop_max,
                frame_skip=self.frame_skip,
                screen_size=self.screen_size,
                grayscale_newaxis=True,
            )
        except gym.error.DependencyNotInstalled as error:
            raise EnvError(f"env.{ATARI} needs OpenCV, which is not installed.", INSTALL) from error
        wrapped.metadata = {**env.metadata, "render_fps": _FRAMES_PER_SECOND / self.frame_skip}
        # A limit of the emulator's counts frames, and is no one's business who asks for the env's.
        limits = [env_args.get("max_episode_steps"), _in_steps(env_args.get("max_num_frames_per_episode"), self)]
        limit = min((one for one in limits if one is not None), default=None)
        return wrapped if limit is None else TimeLimit(wrapped, limit)


def _in_steps(num_frames: Any, frames: AtariFrames) -> int | None:
    return max(1, num_frames // frames.frame_skip) if isinstance(num_frames, int) and num_frames > 0 else None


def _no_game(env_id: str) -> EnvError:
    return EnvError(
        f"{env_id} has env.{ATARI}, but is no game of the Arcade Learning Environment.",
        f"Leave env.{ATARI} out, or choose a game such as ALE/Pong-v5.",
    )


def lives_of(game: gym.Env[Any, Any]) -> int:
    """Return the lives that are left in a game, by the emulator itself: not all infos are kept."""
    inner: Any = game.unwrapped
    return int(inner.ale.lives())


def is_of_emulator(entry_point: Any) -> bool:
    """Whether an entry of Gymnasium's registry is one of the emulator's own package."""
    module = entry_point if isinstance(entry_point, str) else getattr(entry_point, "__module__", "")
    return str(module).partition(":")[0].partition(".")[0] == _PACKAGE


def is_atari_id(env_id: str) -> bool:
    """Whether an id is one that the emulator's package registers, as far as its form tells."""
    return env_id.startswith("ALE/") or "NoFrameskip-v" in env_id


class AtariTraining(TrainingView):
    """What training sees of games: the sign of each reward, and the loss of a life as an end.

    A game goes on when a life is lost: only what is learnt of that step has an end there.

    Args:
        env: A loop over games, with whatever is around it.
        terminal_on_life_loss: Whether `lost_lives` are found.
        clip_rewards: Whether rewards become their signs.
    """

    def __init__(
        self, env: gym.vector.VectorEnv[Any, Any, Any], *, terminal_on_life_loss: bool, clip_rewards: bool
    ) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        self._games: list[Any] = list(inner.envs) if terminal_on_life_loss else []
        self._clip = clip_rewards
        self._lives = self._lives_now()
        self._ended = np.zeros(env.num_envs, np.bool_)

    def _lives_now(self) -> NDArray[np.int64]:
        return np.array(list(map(lives_of, self._games)), np.int64)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all games."""
        result = self.env.reset(seed=seed, options=options)
        self._lives, self._ended = self._lives_now(), np.zeros(self.num_envs, np.bool_)
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all games; `terminated` says which are over."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        self.own_rewards = rewards
        if self._games:
            lives, ended = self._lives_now(), np.logical_or(terminated, truncated)
            # A step after a game's end only reset it.
            self.lost_lives = (lives < self._lives) & ~ended & ~self._ended
            self._lives, self._ended = lives, ended
        return observations, np.sign(rewards) if self._clip else rewards, terminated, truncated, info
