"""Reference policies, which plan with the true rules of each game.

GeyserRunner is solved exactly. In Maneuverer and FlierCatcher the near future is deterministic (a layout is constant
until the target is reached; visible fliers move on), so dynamic programming over it plans well for any goal,
without being provably optimal. The policies work for any reward function of the right form, not only the
named goals.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mbagent_envs.flier_catcher import FlierCatcher
from mbagent_envs.game import Game, RewardFn
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.jit import compiled
from mbagent_envs.maneuverer import Maneuverer
from mbagent_envs.random_keys import derive
from mbagent_envs.types import Bits, Floats, Ints

ReferencePolicy = Callable[[Bits], Ints]
"""Observations int8 ``[B, *shape]`` -> actions int64 ``[B]``."""

_TIE = 1e-7  # relative difference below which values count as equal, so that rounding has no effect


def reference_policy(game: Game, reward: str | RewardFn = "default", gamma: float = 0.99) -> ReferencePolicy | None:
    """Return a policy that plays ``game`` well for a goal, or None if there is none for this game.

    Args:
        game: a game, as at ``env.unwrapped.game``.
        reward: the name of one of the game's goals, or a reward function.
        gamma: discount of the plan, in [0, 1).

    Returns:
        For GeyserRunner the optimal policy for the discounted infinite horizon (value iteration over all states); for
        Maneuverer the optimal path within the layout, with the average value of new layouts after the target; for
        FlierCatcher the best path among the visible fliers.

    Raises:
        ValueError: if there is no goal of that name, or ``gamma`` is outside [0, 1).
    """
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be in [0, 1), but it is {gamma}.")
    if isinstance(reward, str):
        if reward not in game.reward_functions:
            raise ValueError(f"there is no goal {reward!r}; take one of {', '.join(game.reward_functions)}.")
        reward = game.reward_functions[reward]
    if isinstance(game, GeyserRunner):
        return _geyser_runner(game, reward, gamma)
    if isinstance(game, Maneuverer):
        return _LayoutPlanner(game, reward, gamma)
    if isinstance(game, FlierCatcher):
        return _FlierPlanner(game, reward, gamma)
    return None


def _best(values: Floats) -> Ints:
    """Return the first best action of ``values`` ``[B, A]``, ignoring rounding errors."""
    best = values.max(axis=1, keepdims=True)
    good = values >= best - _TIE * (1 + np.abs(best))
    chosen: Ints = np.argmax(good, axis=1)
    return chosen


def geyser_states(game: GeyserRunner) -> Bits:
    """Return all states, int8 ``[width * g, width + g]``, in position-major order."""
    geysers = game.width // 2
    position = np.repeat(np.eye(game.width, dtype=np.int8), geysers, axis=0)
    eruption = np.tile(np.eye(geysers, dtype=np.int8), (game.width, 1))
    return np.concatenate([position, eruption], axis=1)


def _geyser_index(game: GeyserRunner, obs: Bits) -> Ints:
    position, eruption = np.argmax(obs[:, : game.width], axis=1), np.argmax(obs[:, game.width :], axis=1)
    index: Ints = position * (game.width // 2) + eruption
    return index


def geyser_values(game: GeyserRunner, reward: RewardFn, gamma: float) -> Floats:
    """Return the optimal action values of every state of `geyser_states`, float64 ``[states, actions]``."""
    states, n_actions = geyser_states(game), len(game.action_names)
    following, chance = [], []
    for state in states:
        for action in range(n_actions):
            listed, probabilities = game.transition_distribution(state, action)
            following.append(listed)
            chance.append(probabilities)
    shape = (len(states), n_actions, len(chance[0]))  # all states have the same number of successors
    weights, next_obs = np.reshape(chance, shape), np.concatenate(following)
    next_state = _geyser_index(game, next_obs).reshape(shape)
    obs = np.repeat(states, n_actions * shape[2], axis=0)
    actions = np.tile(np.repeat(np.arange(n_actions), shape[2]), len(states))
    earned = (weights * reward(obs, actions, next_obs).reshape(shape)).sum(axis=2)
    values: Floats = np.zeros(shape[:2])
    scale = 1.0 + float(np.abs(earned).max())
    while True:
        updated: Floats = earned + gamma * (weights * values.max(axis=1)[next_state]).sum(axis=2)
        if np.abs(updated - values).max() < 1e-11 * scale:
            return updated
        values = updated


def _geyser_runner(game: GeyserRunner, reward: RewardFn, gamma: float) -> ReferencePolicy:
    actions = _best(geyser_values(game, reward, gamma))
    return lambda obs: actions[_geyser_index(game, obs)]


class _LayoutPlanner:
    """Maneuverer by value iteration within the layout, which is deterministic until the target is reached.

    Args:
        game: the game.
        reward: the goal.
        gamma: discount.
    """

    def __init__(self, game: Maneuverer, reward: RewardFn, gamma: float) -> None:
        self._game, self._reward, self._gamma = game, reward, gamma
        cells = game.size**2
        self._chunk = 1 + 2_000_000 // cells**2  # number of layouts processed together, which bounds the memory
        self._plans: dict[bytes, Ints] = {}  # walls and target -> action for each cell
        self._redrawn = self._value_of_redrawing(max(4, 600 // cells))

    def _value_of_redrawing(self, samples: int) -> Floats:
        """Return the value of having reached the target at each cell, ``[cells]``.

        This is the mean over ``samples`` layouts drawn around the cell, whose values in turn depend on it.
        """
        game, gamma, cells = self._game, self._gamma, self._game.size**2
        around = np.zeros((cells * samples, *game.observation_space.shape), dtype=np.int8)
        places = np.eye(cells, dtype=np.int8).reshape(cells, game.size, game.size)
        around[:, 0] = around[:, 2] = np.repeat(places, samples, axis=0)
        actions, keys = np.zeros(len(around), dtype=np.int64), derive(0, np.arange(len(around)))
        drawn = game.transition(around, actions, keys)
        earned = self._reward(around, actions, drawn).reshape(cells, samples).mean(axis=1)
        problem = self._problem(drawn)
        redrawn, values = np.zeros(cells), np.zeros((len(drawn), cells))
        for _ in range(1000):
            _solve(*problem, redrawn, gamma, 1e-6, values)
            own = values.reshape(cells, samples, cells)[np.arange(cells), :, np.arange(cells)].mean(axis=1)
            before, redrawn = redrawn, earned + gamma * own
            if np.abs(redrawn - before).max() < 1e-4 * (1 + np.abs(own).max()):
                break
        return redrawn

    def __call__(self, obs: Bits) -> Ints:
        """Return the best action of each row."""
        layouts = [row.tobytes() for row in obs[:, 1:]]
        new = {layout: row for row, layout in enumerate(layouts) if layout not in self._plans}
        if new:
            if len(self._plans) > 100_000:
                self._plans.clear()
                new = {layout: row for row, layout in enumerate(layouts)}
            plans = self._plan(obs[list(new.values())])
            self._plans.update(zip(new, plans, strict=True))
        players = obs[:, 0].reshape(len(obs), -1).argmax(axis=1)
        return np.array([self._plans[layout][cell] for layout, cell in zip(layouts, players, strict=True)], dtype=np.int64)

    def _plan(self, obs: Bits) -> Ints:
        """Return the best action for each layout and cell, int64 ``[B, cells]``."""
        next_cell, earned, target = self._problem(obs)
        values = np.zeros((len(obs), self._game.size**2))
        _solve(next_cell, earned, target, self._redrawn, self._gamma, 1e-10, values)
        values[np.arange(len(obs)), target] = self._redrawn[target]
        following = np.take_along_axis(values, next_cell.reshape(len(obs), -1), axis=1).reshape(earned.shape)
        return _best((earned + self._gamma * following).reshape(-1, earned.shape[2])).reshape(values.shape)

    def _problem(self, obs: Bits) -> tuple[Ints, Floats, Ints]:
        """Return next cells and rewards ``[B, cells, actions]`` in each layout, and the targets ``[B]``."""
        batch, cells, n_actions = len(obs), self._game.size**2, len(self._game.action_names)
        next_cell = np.empty((batch, cells, n_actions), dtype=np.int64)
        earned = np.empty((batch, cells, n_actions))
        for b in range(0, batch, self._chunk):
            chunk = slice(b, b + self._chunk)
            next_cell[chunk], earned[chunk] = self._step(obs[chunk])
        return next_cell, earned, obs[:, 2].reshape(batch, cells).argmax(axis=1)

    def _step(self, obs: Bits) -> tuple[Ints, Floats]:
        """Compute the result of every action from every cell of a few layouts."""
        batch, size, n_actions = len(obs), self._game.size, len(self._game.action_names)
        cells = size**2
        states = np.repeat(obs[:, None], cells, axis=1)
        states[:, :, 0] = np.eye(cells, dtype=np.int8).reshape(cells, size, size)
        before = np.repeat(states.reshape(-1, *obs.shape[1:]), n_actions, axis=0)
        actions = np.tile(np.arange(n_actions), batch * cells)
        held = before.copy()
        held[:, 2] = 0  # without a target no layout is drawn
        after = self._game.transition(held, actions, np.zeros(len(held), dtype=np.uint64))
        after[:, 2] = before[:, 2]
        next_cell = np.argmax(after[:, 0].reshape(batch, cells, n_actions, cells), axis=3)
        return next_cell, self._reward(before, actions, after).reshape(batch, cells, n_actions)


@compiled
def _solve(
    next_cell: Ints,
    earned: Floats,
    target: Ints,
    redrawn: Floats,
    gamma: float,
    tolerance: float,
    values: Floats,
) -> None:
    """Iterate the state values ``[B, cells]`` in place until they are optimal, with fixed values at the targets."""
    batch, cells, n_actions = earned.shape
    for b in range(batch):
        for _ in range(100_000):
            change = 0.0
            size = 1.0
            for cell in range(cells):
                best = -np.inf
                for action in range(n_actions):
                    following = next_cell[b, cell, action]
                    after = redrawn[following] if following == target[b] else values[b, following]
                    best = max(best, earned[b, cell, action] + gamma * after)
                change = max(change, abs(best - values[b, cell]))
                size = max(size, abs(best))
                values[b, cell] = best
            if change < tolerance * size:
                break


class _FlierPlanner:
    """FlierCatcher by dynamic programming over the visible fliers, followed by the average value of a row.

    Args:
        game: the game.
        reward: the goal.
        gamma: discount.
        samples: number of boards over which the value of each row is averaged.
    """

    def __init__(self, game: FlierCatcher, reward: RewardFn, gamma: float, samples: int = 256) -> None:
        # The same game without new fliers: visible fliers move on.
        self._quiet = FlierCatcher(height=game.height, width=game.width, spawn_rate=0.0, stay=game.stay)
        self._reward, self._gamma = reward, gamma
        self._beyond = np.zeros(game.height)
        keys = derive(0, np.arange(samples))
        boards = game.initial(keys)
        for step in range(game.width):
            boards = game.transition(boards, np.zeros(samples, dtype=np.int64), derive(keys, step + 1))
        for _ in range(5):  # only differences between rows matter, and these converge quickly
            values = self._values(boards).max(axis=2).mean(axis=0)
            self._beyond = values - values.mean()

    def __call__(self, obs: Bits) -> Ints:
        """Return the best action of each row."""
        rows = obs[:, 0, :, 0].argmax(axis=1)
        return _best(self._values(obs)[np.arange(len(obs)), rows])

    def _values(self, obs: Bits) -> Floats:
        """Return the action values for each possible row of the player, float64 ``[B, height, actions]``."""
        game = self._quiet
        height, n_actions = game.height, len(game.action_names)
        states = np.repeat(obs[:, None], height, axis=1)
        states[:, :, 0] = 0
        states[:, np.arange(height), 0, np.arange(height), 0] = 1
        before = np.repeat(states.reshape(-1, *obs.shape[1:]), n_actions, axis=0)
        actions = np.tile(np.arange(n_actions), len(obs) * height)
        keys = np.zeros(len(before), dtype=np.uint64)
        next_row = game.transition(before, actions, keys)[:, 0, :, 0].argmax(axis=1)
        earned = []
        for _ in range(game.width - 1):
            after = game.transition(before, actions, keys)
            earned.append(self._reward(before, actions, after).reshape(len(obs), height, n_actions))
            before[:, 1] = after[:, 1]
        next_row = next_row.reshape(len(obs), height * n_actions)
        best = np.repeat(self._beyond[None], len(obs), axis=0)
        for rewards in reversed(earned):
            values = rewards + self._gamma * np.take_along_axis(best, next_row, axis=1).reshape(rewards.shape)
            best = values.max(axis=2)
        return values
