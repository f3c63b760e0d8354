"""One Gymnasium vector environment for every game: all copies are stepped in one call."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mbagent_envs.drawing import draw_ansi, draw_rgb
from mbagent_envs.env import GameEnv, check_options, check_render_mode, resolve_game
from mbagent_envs.game import Game, check_integer
from mbagent_envs.random_keys import derive, draw_keys
from mbagent_envs.types import Bits, Bools, Floats


class GameVectorEnv(gym.vector.VectorEnv[Bits, npt.NDArray[Any], npt.NDArray[Any]]):
    """Many copies of one game, stepped together; build it with `gymnasium.make_vec`.

    Copy ``i`` follows the same trajectory as a single environment with seed ``seed + i``, so this class can
    replace `gymnasium.vector.SyncVectorEnv` in every autoreset mode.

    Args:
        game: a game's name, ``"module:Class"``, class or instance.
        num_envs: number of copies.
        max_episode_steps: steps until truncation; None for the game's own limit, -1 for no limit.
        render_mode: ``"rgb_array"``, ``"ansi"``, or None; `render` returns one picture for each copy.
        autoreset_mode: when a finished copy is reset: ``"NextStep"`` (the following call of `step` resets it and
            ignores its action), ``"SameStep"`` (immediately; the last observation is in ``infos["final_obs"]``)
            or ``"Disabled"`` (call `reset` with ``options={"reset_mask": mask}``).
        **arguments: the game's own.

    Raises:
        TypeError: for an unknown argument or one of the wrong type.
        ValueError: for an invalid value.
    """

    metadata: dict[str, Any] = {**GameEnv.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        game: str | type[Game] | Game,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        self.game = resolve_game(game, arguments)
        self.num_envs = check_integer("num_envs", num_envs, 1)
        self.render_mode = check_render_mode(render_mode)
        if self.render_mode == "human":
            raise ValueError("render_mode 'human' shows one game; take 'rgb_array' for many, or one environment.")
        limit = self.game.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.max_episode_steps = limit if limit == -1 else check_integer("max_episode_steps", limit, 1)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = copy.deepcopy(self.game.observation_space)
        self.single_action_space = copy.deepcopy(self.game.action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._seeds = [-1] * self.num_envs
        self._keys = np.zeros(self.num_envs, dtype=np.uint64)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._done = np.zeros(self.num_envs, dtype=np.bool_)
        self._obs: Bits | None = None

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The copies' generators, as in `gymnasium.vector.SyncVectorEnv`; created at first use if unseeded."""
        return tuple(self._generator(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The copies' seeds."""
        self.np_random  # noqa: B018 -- creates missing generators
        return tuple(self._seeds)

    def _generator(self, i: int) -> np.random.Generator:
        generator = self._generators[i]
        if generator is None:
            generator, self._seeds[i] = seeding.np_random()
            self._generators[i] = generator
        return generator

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Bits, dict[str, Any]]:
        """Start an episode in every copy.

        Args:
            seed: copy ``i`` is seeded with ``seed + i``, or with ``seed[i]``; None continues its generator's
                sequence.
            options: ``{"state": obs}`` starts from this observation (one for all, or one for each) instead of
                a random one; ``{"reset_mask": bool [num_envs]}`` resets only some copies.

        Raises:
            ValueError: for an unknown option, an invalid state, or a wrong number of seeds or states.
        """
        given = check_options(options, ("state", "reset_mask"))
        mask = self._reset_mask(given.get("reset_mask"))
        seeds = self._seed_list(seed)
        start = self._start_states(given["state"]) if "state" in given else None
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
        if self._obs is None:
            self._obs = np.zeros(self.observation_space.shape or (), dtype=np.int8)
        self._begin(mask)
        if start is not None:
            self._obs[mask] = start[mask]
        return self._obs.copy(), {}

    def _reset_mask(self, mask: Any) -> Bools:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] must be bool ({self.num_envs},) with a True in it; it is {mask!r}.")
        if self._obs is None and not mask.all():
            raise gym.error.ResetNeeded("the first reset must be of all copies; leave out options['reset_mask'].")
        return mask

    def _seed_list(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be one integer or {self.num_envs} of them, but there are {len(seed)}.")
        return list(seed)

    def _start_states(self, state: Any) -> Bits:
        array = np.asarray(state)
        if array.shape == self.single_observation_space.shape:
            array = np.broadcast_to(array, (self.num_envs, *array.shape))
        states = self.game.check_observations(array)
        if len(states) != self.num_envs:
            raise ValueError(f"options['state'] must be one observation or {self.num_envs}, but there are {len(states)}.")
        return states

    def _begin(self, mask: Bools) -> None:
        """Start an episode in the copies of ``mask``, bool ``[num_envs]``."""
        assert self._obs is not None
        chosen = np.flatnonzero(mask)
        self._keys[chosen] = [draw_keys(self._generator(int(i)), 1)[0] for i in chosen]
        self._elapsed[chosen] = 0
        self._done[chosen] = False
        self._obs[chosen] = self.game.initial(derive(self._keys[chosen], 0))

    def step(self, actions: npt.NDArray[Any]) -> tuple[Bits, Floats, Bools, Bools, dict[str, Any]]:
        """Take one step in every copy.

        Args:
            actions: integers ``[num_envs]``.

        Returns:
            Observations int8 ``[num_envs, *shape]``, rewards float64, terminations and truncations bool
            ``[num_envs]``, infos.

        Raises:
            InvalidActionError: if an action is outside the action space.
            gymnasium.error.ResetNeeded: before the first reset, or with autoreset disabled when a finished
            copy was not reset.
        """
        if self._obs is None:
            raise gym.error.ResetNeeded("Cannot call envs.step() before calling envs.reset()")
        checked = self.game.check_actions(actions, self.num_envs)
        stale = self._done.copy()  # finished in the previous step
        if self.autoreset_mode is AutoresetMode.DISABLED and stale.any():
            raise gym.error.ResetNeeded(
                f"copies {np.flatnonzero(stale).tolist()} have ended; reset them with options={{'reset_mask': mask}} first."
            )
        self._elapsed += 1
        obs, self._obs = (
            self._obs,
            self.game.transition(self._obs, checked, derive(self._keys, self._elapsed)),
        )
        rewards = self.game.reward(obs, checked, self._obs)
        terminations = self.game.terminated(obs, checked, self._obs)
        truncations = self._elapsed >= self.max_episode_steps if self.max_episode_steps > 0 else np.zeros_like(stale)
        if stale.any():  # this call was their reset
            rewards[stale], terminations[stale], truncations[stale] = 0.0, False, False
            self._begin(stale)
        self._done = terminations | truncations
        infos = self._reset_finished() if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any() else {}
        return self._obs.copy(), rewards, terminations, truncations, infos

    def _reset_finished(self) -> dict[str, Any]:
        """Reset the copies that have just finished; return the infos with their last observations."""
        assert self._obs is not None
        finished = self._done.copy()
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(finished):
            final_obs[i] = self._obs[i].copy()
        self._begin(finished)
        return {
            "final_obs": final_obs,
            "_final_obs": finished,
            "final_info": {},
            "_final_info": finished.copy(),
        }

    def render(self) -> tuple[Any, ...] | None:
        """Draw every copy: a tuple of uint8 ``[height, width, 3]`` or of strings, by ``render_mode``."""
        if self.render_mode is None:
            gym.logger.warn("render() was called without a render_mode; give one to gymnasium.make_vec, say 'rgb_array'.")
            return None
        if self._obs is None:
            raise gym.error.ResetNeeded("Cannot call envs.render() before calling envs.reset()")
        draw = draw_ansi if self.render_mode == "ansi" else draw_rgb
        return tuple(draw(self.game.scene(obs)) for obs in self._obs)
