"""One Gymnasium environment for every game."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from mbagent_envs.drawing import Window, draw_ansi, draw_rgb
from mbagent_envs.flier_catcher import FlierCatcher
from mbagent_envs.game import Game, RewardFn, build_game
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.maneuverer import Maneuverer
from mbagent_envs.random_keys import derive, draw_keys
from mbagent_envs.types import Bits, Floats

GAMES: dict[str, type[Game]] = {
    "GeyserRunner": GeyserRunner,
    "Maneuverer": Maneuverer,
    "FlierCatcher": FlierCatcher,
}
"""The games by name."""

RENDER_MODES = ("human", "rgb_array", "ansi")


def resolve_game(game: str | type[Game] | Game, arguments: Mapping[str, Any]) -> Game:
    """Return the game given by a name in `GAMES`, ``"module:Class"``, a class, or an instance.

    Raises:
        ValueError: if there is no such game, or an argument's value is invalid.
        TypeError: if an argument is unknown or of the wrong type, or given together with an instance.
    """
    if isinstance(game, Game):
        if arguments:
            raise TypeError(f"arguments ({', '.join(arguments)}) go with a game's name or class, not with {game!r}.")
        return game
    if isinstance(game, str):
        module, _, name = game.partition(":")
        found = getattr(importlib.import_module(module), name, None) if name else GAMES.get(game)
    else:
        found = game
    if not (isinstance(found, type) and issubclass(found, Game)):
        raise ValueError(f"there is no game {game!r}; take one of {', '.join(GAMES)}, 'module:Class', or a Game.")
    return build_game(found, arguments)


def check_render_mode(render_mode: str | None) -> str | None:
    """Return ``render_mode``, or raise ValueError if there is no such mode."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be one of {', '.join(RENDER_MODES)} or None, but it is {render_mode!r}.")
    return render_mode


def check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset as a new dict, or raise ValueError if one is unknown."""
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(f"reset's options must be a dict or None, but they are {options!r} of type {type(options).__name__}.")
    given = dict(options or {})
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ValueError(f"reset has no option {unknown[0]!r}; its options are {', '.join(map(repr, known))}.")
    return given


class GameEnv(gym.Env[Bits, np.int64]):
    """A game (see `mbagent_envs.Game`) as a Gymnasium environment; build it with `gymnasium.make`.

    In addition to Gymnasium's interface, ``env.unwrapped`` gives a planner access to the true rules: `game`,
    `reward_fn`, `reward_functions`, `transition` and `transition_distribution`. At each reset one key is drawn
    from ``np_random``, which determines all random events of the episode, so an episode depends only on the
    seed and the actions.

    Args:
        game: a game's name, ``"module:Class"``, class or instance.
        render_mode: ``"human"`` (a window; needs pygame), ``"rgb_array"``, ``"ansi"``, or None.
        **arguments: the game's own.

    Raises:
        TypeError: for an unknown argument or one of the wrong type.
        ValueError: for an invalid value.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 8}  # noqa: RUF012

    def __init__(self, game: str | type[Game] | Game, render_mode: str | None = None, **arguments: Any) -> None:
        self.game = resolve_game(game, arguments)
        self.render_mode = check_render_mode(render_mode)
        self.observation_space = copy.deepcopy(self.game.observation_space)  # environments can share a game,
        self.action_space = copy.deepcopy(self.game.action_space)  # but never their spaces' generators
        self._obs: Bits | None = None
        self._episode_key = np.zeros(1, dtype=np.uint64)
        self._elapsed = 0
        self._window: Window | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bits, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds ``np_random``; None continues its sequence.
            options: ``{"state": obs}`` starts from this observation instead of a random one.

        Raises:
            ValueError: for an unknown option, or an invalid state.
        """
        given = check_options(options, ("state",))
        start = self.game.check_observations(np.asarray(given["state"])[None]) if "state" in given else None
        super().reset(seed=seed)
        self._episode_key = draw_keys(self.np_random, 1)
        self._elapsed = 0
        self._obs = self.game.initial(derive(self._episode_key, 0)) if start is None else start.copy()
        if self.render_mode == "human":
            self.render()
        return self._obs[0].copy(), {}

    def step(self, action: Any) -> tuple[Bits, float, bool, bool, dict[str, Any]]:
        """Take one step; ``truncated`` is always False (`gymnasium.wrappers.TimeLimit` sets it).

        Raises:
            InvalidActionError: if the action is outside the action space.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._obs is None:
            raise gym.error.ResetNeeded("Cannot call env.step() before calling env.reset()")
        actions = self.game.check_actions(np.asarray(action)[None], 1)
        self._elapsed += 1
        obs, self._obs = (
            self._obs,
            self.game.transition(self._obs, actions, derive(self._episode_key, self._elapsed)),
        )
        reward = float(self.game.reward(obs, actions, self._obs)[0])
        terminated = bool(self.game.terminated(obs, actions, self._obs)[0])
        if self.render_mode == "human":
            self.render()
        return self._obs[0].copy(), reward, terminated, False, {}

    @property
    def reward_fn(self) -> RewardFn:
        """The environment's own reward, ``(obs [B, ...], action [B], next_obs [B, ...]) -> float64 [B]``."""
        return self.game.reward

    @property
    def reward_functions(self) -> Mapping[str, RewardFn]:
        """Goals by name; ``"default"`` is the environment's own reward."""
        return self.game.reward_functions

    def transition(self, obs: npt.ArrayLike, actions: npt.ArrayLike, rng: np.random.Generator) -> Bits:
        """Sample next observations by the true rules; the environment's own state is not changed.

        Args:
            obs: observations ``[B, *shape]``.
            actions: integers ``[B]``.
            rng: source of one key for each row.

        Returns:
            Next observations, int8 ``[B, *shape]``.

        Raises:
            ValueError: if a row of ``obs`` is not a state of this game.
            InvalidActionError: if an action is outside the action space.
        """
        states = self.game.check_observations(obs)
        checked = self.game.check_actions(actions, len(states))
        return self.game.transition(states, checked, draw_keys(rng, len(states)))

    def transition_distribution(self, obs: npt.ArrayLike, action: int) -> tuple[Bits, Floats]:
        """List the possible next observations after one observation, ``[*shape]``, and one action.

        Returns:
            The distinct next observations, int8 ``[M, *shape]``, and their probabilities, float64 ``[M]``.

        Raises:
            ValueError: if ``obs`` is not a state of this game.
            InvalidActionError: if the action is outside the action space.
            NotImplementedError: if there are too many successors to list.
        """
        state = self.game.check_observations(np.asarray(obs)[None])[0]
        checked = self.game.check_actions(np.asarray(action)[None], 1)
        return self.game.transition_distribution(state, int(checked[0]))

    def render(self) -> Any:
        """Draw the present state: uint8 ``[height, width, 3]``, a string, or a window, by ``render_mode``.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            gymnasium.error.DependencyNotInstalled: if a window is requested and pygame is missing.
        """
        if self.render_mode is None:
            gym.logger.warn("render() was called without a render_mode; give one to gymnasium.make, say 'rgb_array'.")
            return None
        if self._obs is None:
            raise gym.error.ResetNeeded("Cannot call env.render() before calling env.reset()")
        scene = self.game.scene(self._obs[0])
        if self.render_mode == "ansi":
            return draw_ansi(scene)
        picture = draw_rgb(scene)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = Window(type(self.game).__name__, int(self.metadata["render_fps"]))
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
