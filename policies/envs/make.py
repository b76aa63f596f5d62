"""Check and make Gymnasium environments.

Words: an *env id* names a registered environment (`CartPole-v1`); *env arguments* are the keyword arguments
its constructor takes; a *sub-environment* is one of the copies that a vector environment steps at once.

What an id means is decided in `policies.envs.ids`; Gymnasium is given what was found, never the id. The env arguments
may hold the reserved keys of `policies.envs.wrappers`, so that wherever a policy's environment is made, the policy
observes what it did in training.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator

from policies.envs import atari, calls
from policies.envs.calls import Call
from policies.envs.checked import PlainSteps
from policies.envs.failures import FailureRule, check_failure_penalty, failure_rule
from policies.envs.faults import close_env, hint_on, is_of_env, place_in_env
from policies.envs.first_step import Carried, Largest, check_first_step
from policies.envs.flat import FlatBox, FlatObservations, UnsupportedMemberError, flattened, needs_flattening
from policies.envs.ids import as_creator, find_env, normalize_env_id
from policies.envs.images import SeenImage, image_seen
from policies.envs.loops import make_loop
from policies.envs.mask_hints import UnusedMask, unused_mask
from policies.envs.masks import MasksActions, may_be_masked, seen_by_networks
from policies.envs.mujoco_warnings import say_each_once
from policies.envs.own_actions import Choices, TakesActions, UnsupportedActionsError, is_taken, made_of
from policies.envs.own_process import InOwnProcess
from policies.envs.own_vectors import own_vector_env, takes_vector_entry_point
from policies.envs.rendering import choose_before_import, draw_without_display, without_window
from policies.envs.signatures import named_parameters, takes_any_name
from policies.envs.space_hints import action_hint, observation_hint, one_choice_hint
from policies.envs.spaces import unwritable_key
from policies.envs.time_limits import check_limit, time_limit_of
from policies.envs.wrappers import PIXELS, FailurePenalty, ObservationWrappers, constructor_args, wrapper_of
from policies.errors import EnvError, said_by
from policies.suggestions import did_you_mean

if TYPE_CHECKING:
    from policies.hyperparams import Algorithm

__all__ = [
    "ALLOWED_MODULES",
    "ATARI_TRAINING",
    "FAILURE_PENALTY",
    "MODULE_FOLDERS",
    "EnvInfo",
    "check_env",
    "make_env",
    "make_vector_env",
    "normalize_env_id",
]

# These stand in an env runner's `env_config` beside the env's arguments, never among them.
FAILURE_PENALTY, ATARI_TRAINING, ALLOWED_MODULES = "failure_penalty", "atari_training", "allowed_modules"
MODULE_FOLDERS = "module_folders"
# Keyword arguments of gym.make and gym.make_vec that are set here and not by a sweep file, and the keys of env runners
# from above.
_RESERVED_ARGS = frozenset({
    "id", "render_mode", "disable_env_checker", "num_envs", "vectorization_mode", "vector_kwargs", "wrappers",
    FAILURE_PENALTY, ATARI_TRAINING, ALLOWED_MODULES, MODULE_FOLDERS,
})  # fmt: skip
_RGB_ARRAY = "rgb_array"
_LIMIT = "max_episode_steps"
"""The one argument of gym.make that a sweep file may set; it is the constructor's, too, if that has one of the name."""


@dataclass(frozen=True)
class EnvInfo:
    """Facts about an environment, found before anything is trained on it."""

    env_id: str
    env_args: dict[str, Any] = field(hash=False)
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    threshold: float | None
    """Mean episode return from which the env counts as solved; None if the env defines none."""
    max_episode_steps: int | None
    """Env steps after which an episode is truncated; None if it never is."""
    has_vector_entry_point: bool
    """Whether `make_vector_env` uses the env's own vectorised version, unless this, once made, resets otherwise."""
    failure: FailureRule | None = None
    """The rule by which its episodes end by failure; None if they never do, or it is not known."""
    mask: str | None = None
    """Where its mask of actions comes from, in words; None if it has none, or none that is used."""
    unused_mask: UnusedMask | None = None
    """What looks like a mask of actions, which is not used."""
    is_flattened: bool = False
    """Whether its own observations are neither vectors nor images, and were made such (`policies.envs.flat`)."""
    unrepeated: str | None = None
    """How its first observation differs when the same seed is given again; None: it does not."""
    largest: Largest | None = None
    """The number farthest from 0 in its first observation; None: it was not looked at."""
    carried: Carried = field(default_factory=Carried)
    """What an episode leaves to the next one, beside what `unrepeated` says."""

    @property
    def observes_images(self) -> bool:
        """Whether observations are images, of shape (rows, columns, channels), and not vectors."""
        return len(seen_by_networks(self.observation_space).shape or ()) == 3

    @cached_property
    def image(self) -> SeenImage | None:
        """The image that convolutions can see, as a whole or among other members; None: there is none."""
        return image_seen(self.observation_space)


def check_env(env_id: str, env_args: Mapping[str, Any] | None, algorithm: Algorithm | None = None) -> EnvInfo:
    """Make an environment, reset it and step it once, and check that an algorithm can train on it.

    Args:
        env_id: Gymnasium id.
        env_args: Keyword arguments of its constructor; None: none.
        algorithm: The algorithm that the action space is checked for; None: any.

    Raises:
        EnvError: The id is not registered, an argument is wrong, the env cannot be made, its spaces are of a kind
            that the algorithm cannot take, or what it returns is not what Gymnasium asks for.
    """
    env = make_env(env_id, env_args)
    try:
        env_id, spec = find_env(env_id)
        kwargs = dict(env_args or {})
        wrappers = ObservationWrappers.take_from(kwargs)
        mask = wrapper_of(env, MasksActions)
        is_flattened = bool(wrapper_of(env, FlatObservations) or (mask and isinstance(mask.space.seen, FlatBox)))
        is_changed = mask or is_flattened or wrapper_of(env, TakesActions)
        info = EnvInfo(
            env_id=env_id,
            env_args=copy.deepcopy(dict(env_args or {})),
            observation_space=env.observation_space,
            action_space=env.action_space,
            threshold=None if spec.reward_threshold is None else float(spec.reward_threshold),
            max_episode_steps=time_limit_of(env),
            has_vector_entry_point=not is_changed
            and _may_be_vectorised(env_id, spec, wrappers)
            and takes_vector_entry_point(spec, kwargs),
            failure=failure_rule(env_id, spec, env.metadata, kwargs),
            mask=None if mask is None else mask.place,
            is_flattened=is_flattened,
        )
        _check_action_space(info, algorithm)
        _check_observation_space(info)
        _check_keys(info)
        tried = check_first_step(env, info.env_id, constructor_args(info.env_args))
        unused = None if mask is not None or wrappers.action_mask is not None else unused_mask(env, tried.infos)
        return replace(
            info, unused_mask=unused, unrepeated=tried.unrepeated, largest=tried.largest, carried=tried.carried
        )
    finally:
        close_env(env)


def make_env(
    env_id: str, env_args: Mapping[str, Any] | None = None, *, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make one environment, with its time limit and the wrappers that its arguments ask for.

    Args:
        env_id: Gymnasium id, or `module:Name`.
        env_args: Keyword arguments of its constructor, and reserved keys of `policies.envs.wrappers`; None: none.
        render_mode: One of Gymnasium's render modes; None: no rendering.

    Raises:
        EnvError: The id is not registered, an argument is wrong, or the constructor failed.
    """
    env_id, spec, kwargs, wrappers = _find(env_id, env_args)
    if wrappers.pixels:
        if render_mode not in (None, _RGB_ARRAY):
            raise EnvError(f"{env_id} observes pixels, so it cannot have the render mode {render_mode!r}.", "Use none.")
        render_mode = _prepare_pixels(env_id, spec)
    if render_mode is not None:
        # Here the module of the env is imported, and with it what it draws with.
        draw_without_display()
        kwargs["render_mode"] = render_mode
    try:
        with calls.inside(Call.CONSTRUCTOR):
            # The passive checker only prints warnings, at each env made, and slows every step.
            env = _made(partial(gym.make, disable_env_checker=True), env_id, spec, kwargs, wrappers)
        return calls.watch_env(wrappers.wrap(env, {**spec.kwargs, **kwargs}))
    except BaseException as error:  # an env's constructor may raise anything
        raise _cannot_make(env_id, env_args, error) from error


def make_vector_env(
    env_id: str,
    env_args: Mapping[str, Any] | None,
    num_envs: int,
    *,
    failure_penalty: float | None = None,
    atari_training: Mapping[str, bool] | None = None,
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make a vector environment: the env's own vectorised version if it has one, else a loop over envs.

    Both reset a sub-environment in the step after its episode ended (`AutoresetMode.NEXT_STEP`) and both have
    the env's time limit. Which one is made is `EnvInfo.has_vector_entry_point`, if its own does not reset otherwise.

    Args:
        env_id: Gymnasium id, or `module:Name`.
        env_args: The same as for `make_env`.
        num_envs: Number of sub-environments.
        failure_penalty: Reward of steps that end by failure, for training alone: the outermost wrapper is then a
            `FailurePenalty`. None: the env's own reward.
        atari_training: The arguments of an `AtariTraining`, for training alone: it is then the outermost wrapper. The
            env's arguments must have `atari`. None: the games as they are.

    Raises:
        EnvError: In the same cases as `make_env`; or there is a penalty, and the env has no failure.
    """
    env_id, spec, kwargs, wrappers = _find(env_id, env_args)
    own_args = dict(kwargs)  # before the render mode joins them
    try:
        with calls.inside(Call.CONSTRUCTOR):
            env = own_vector_env(spec, num_envs, kwargs) if _may_be_vectorised(env_id, spec, wrappers) else None
            if env is None:
                if wrappers.pixels:
                    kwargs["render_mode"] = _prepare_pixels(env_id, spec)
                given = {**spec.kwargs, **kwargs}
                around = lambda game: wrappers.wrap_images(game, given), wrappers.wrap_mask, flattened, PlainSteps
                make_all = partial(make_loop, num_envs=num_envs, wrappers=around)
                env = _made(make_all, env_id, spec, kwargs, wrappers)
        env = calls.watch_env(wrappers.wrap_vector(env))
    except BaseException as error:  # an env's constructor may raise anything
        raise _cannot_make(env_id, env_args, error) from error
    if atari_training is not None:
        return atari.AtariTraining(env, **atari_training)
    if failure_penalty is None:
        return env
    inner: Any = env.unwrapped
    scalar = inner.envs[0] if isinstance(inner, gym.vector.SyncVectorEnv) else _creator(env_id, spec)
    rule = failure_rule(env_id, spec, getattr(scalar, "metadata", {}), own_args)
    return FailurePenalty(env, check_failure_penalty(env_id, rule, failure_penalty), failure_penalty)


def _find(env_id: str, env_args: Mapping[str, Any] | None) -> tuple[str, EnvSpec, dict[str, Any], ObservationWrappers]:
    """Return the normalised id, the registry entry, the constructor's arguments, and the wrappers for the env."""
    kwargs = copy.deepcopy(dict(env_args or {}))
    if kwargs.get(PIXELS):
        choose_before_import()
    with calls.inside(Call.IMPORT):
        env_id, spec = find_env(env_id)
        wrappers = ObservationWrappers.take_from(kwargs)
        _check_args(env_id, spec, kwargs)
    if wrappers.atari is not None:
        spec = wrappers.atari.limit_outside(spec, kwargs)
    say_each_once()
    return env_id, spec, kwargs, wrappers


def _made(
    make: Callable[..., Any], env_id: str, spec: EnvSpec, kwargs: dict[str, Any], wrappers: ObservationWrappers
) -> Any:
    """Make an environment, or several, of the constructor's arguments as the wrappers need them."""
    creator = _creator(env_id, spec)
    if wrappers.atari is not None:
        kwargs = wrappers.atari.game_args(env_id, creator, kwargs)
    entry: Any = partial(InOwnProcess, env_id) if wrappers.own_process else creator
    # Gymnasium's functions take it for themselves, also from what the env is registered with where they make many.
    given = {**spec.kwargs, **kwargs} if _LIMIT in named_parameters(creator) else spec.kwargs
    if creator is not None and _LIMIT in given:
        spec = replace(spec, kwargs={name: value for name, value in spec.kwargs.items() if name != _LIMIT})
        entry = partial(entry, max_episode_steps=given[_LIMIT])
        if hasattr(creator, "metadata"):  # by which gym.make knows for whom it opens a window
            vars(entry)["metadata"] = creator.metadata
    made = replace(spec, entry_point=entry) if isinstance(entry, partial) else spec
    return without_window(partial(make, made), kwargs, creator, spec.kwargs)


def _may_be_vectorised(env_id: str, spec: EnvSpec, wrappers: ObservationWrappers) -> bool:
    """Whether a vectorised version, around which there are no wrappers, may observe what they make."""
    is_wrapped = wrappers.own_process or wrappers.observes_images
    return not (is_wrapped or may_be_masked(_creator(env_id, spec), wrappers.action_mask))


def _prepare_pixels(env_id: str, spec: EnvSpec) -> str:
    """Return the render mode that gives pixels.

    Raises:
        EnvError: The env does not have that mode.
    """
    draw_without_display()
    modes = (getattr(_creator(env_id, spec), "metadata", None) or {}).get("render_modes")
    if modes is not None and _RGB_ARRAY not in modes:
        raise EnvError(
            f"{env_id} has pixels: true, but cannot be drawn: it has no render mode {_RGB_ARRAY!r} "
            f"(it has: {', '.join(map(str, modes)) or 'none'}).",
            "Leave pixels out, or add the render mode to the env.",
        )
    return _RGB_ARRAY


def _creator(env_id: str, spec: EnvSpec) -> Callable[..., Any] | None:
    """Return the env's class, or the function that makes it; None if the registry entry has neither.

    Raises:
        EnvError: The env's module cannot be imported.
    """
    if isinstance(spec.entry_point, str):
        try:
            creator: Callable[..., Any] = load_env_creator(spec.entry_point)
        except BaseException as error:  # importing an env's module may raise anything
            raise _cannot_make(env_id, {}, error) from error
        return as_creator(creator)
    return None if spec.entry_point is None else as_creator(spec.entry_point)


def _check_args(env_id: str, spec: EnvSpec, env_args: dict[str, Any]) -> None:
    """Refuse arguments that the constructor does not take, and suggest the nearest one that it takes."""
    creator = _creator(env_id, spec)
    takes_any, known = takes_any_name(creator), {_LIMIT, *named_parameters(creator)} - _RESERVED_ARGS
    for name, value in env_args.items():
        if name in _RESERVED_ARGS:
            raise EnvError(
                f"The env argument {name!r} (value {value!r}) cannot be set: it is chosen where the env is used.",
                f"Remove {name!r} from the env's arguments.",
            )
        if name not in known and not takes_any:
            raise EnvError(
                f"{env_id} takes no argument {name!r} (value {value!r}).{did_you_mean(name, sorted(known))}",
                f"It takes: {', '.join(sorted(known))}.",
            )
    if _LIMIT in env_args:
        check_limit(env_id, env_args[_LIMIT])


def _cannot_make(env_id: str, env_args: Mapping[str, Any] | None, error: BaseException) -> EnvError:
    if not is_of_env(error):
        raise error
    if isinstance(error, EnvError):  # raised by a wrapper, with a message of its own
        return error
    said, place = said_by(error), place_in_env(error)
    detail = f"{said}{f' ({place})' if place else ''}" if said else f"at {place or 'a place that is not its own'}"
    arguments = f" with arguments {given!r}" if (given := constructor_args(env_args or {})) else ""
    message = f"The environment {env_id!r} cannot be made{arguments}: {type(error).__name__}: {detail}."
    if "box2d" in detail.lower():
        # gymnasium[box2d] asks for a source build; this wheel holds the same module.
        return EnvError(message, "Install it, on every machine that runs trials: pip install Box2D==2.3.10")
    return EnvError(message, hint_on(error, "Check the env's arguments against its documentation."))


def _check_observation_space(info: EnvInfo) -> None:
    space = info.observation_space
    if not needs_flattening(space):
        return
    # It would have been made vectors, if that could be done.
    hint = observation_hint(info.env_id, space)
    try:
        FlatBox(space)
    except UnsupportedMemberError as error:
        raise EnvError(f"{info.env_id} has observations of which no vector can be made: {error}.", hint) from error
    except ValueError as error:
        raise EnvError(f"{info.env_id} cannot be trained on: {error} ({space}).", hint) from error
    raise EnvError(f"{info.env_id} has observations {space}, which were not made vectors.", hint)


def _check_keys(info: EnvInfo) -> None:
    """Refuse members that a policy file could not name."""
    spaces = (("observations", seen_by_networks(info.observation_space)), ("actions", info.action_space))
    for what, space in spaces:
        key = unwritable_key(getattr(space, "original", space))
        if key is not None:
            raise EnvError(
                f"{info.env_id} has {what} with a member {key}, and no file of a policy can name that.",
                "Name the members of a Dict by texts, by numbers, or by tuples of these.",
            )


def _check_action_space(info: EnvInfo, algorithm: Algorithm | None) -> None:
    space = info.action_space
    if not is_taken(space):
        try:
            made_of(space)
        except UnsupportedActionsError as error:
            raise EnvError(
                f"{info.env_id} has actions {error}, which no policy gives: actions are choices or numbers.",
                action_hint(),
            ) from error
    if algorithm != "dqn":
        return
    if isinstance(space, gym.spaces.Box):
        raise EnvError(
            f"DQN cannot train on {info.env_id}: its actions are continuous ({space}), and DQN needs Discrete ones.",
            "Use 'algorithm: ppo', or an env with Discrete actions.",
        )
    if isinstance(space, Choices):
        raise EnvError(
            f"DQN cannot train on {info.env_id}: its actions are {len(space.sizes)} choices at once ({space}), and DQN "
            "needs a single one.",
            f"Use 'algorithm: ppo', which makes each choice by itself. "
            f"{one_choice_hint(info.env_id, space.original, info.mask)}",
        )
