"""Plays whole episodes of any policy in one batch and scores them, for every goal at once if asked.

Episodes for reporting are numbered apart from everything an agent trained on: they start from keys of their
own. The same seed gives every policy the same start states and the same luck, so that differences are the
policies'.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from mbagent_envs.game import Game
from mbagent_envs.random_keys import derive

Policy = Callable[[Any], NDArray[np.int64]]
"""Batch of observations [B, ...] -> actions int [B]."""

Goal = Callable[[Any, Any, Any], NDArray[Any]]
"""Reward function (obs, action, next_obs) -> floats [B]."""

_REPORTING = 0x5EED  # salt that keeps the episodes for reporting apart from training


@dataclass(frozen=True)
class Evaluation:
    """Episodes played by one policy.

    Attributes:
        returns: undiscounted return of each episode, float64 [episodes], by name of the goal.
        seconds: wall time spent inside the policy.
        decisions: number of decisions the policy took.
    """

    returns: Mapping[str, NDArray[np.float64]]
    seconds: float
    decisions: int

    @property
    def default(self) -> NDArray[np.float64]:
        """Returns under the environment's own reward, float64 [episodes]."""
        return self.returns["default"]


@dataclass
class _Stopwatch:
    """A policy that is timed, and is asked only once about equal observations if it is ``repeatable``."""

    policy: Policy
    repeatable: bool
    seconds: float = 0.0
    decisions: int = 0
    _known: dict[bytes, int] = field(default_factory=dict)

    def __call__(self, obs: NDArray[Any]) -> NDArray[np.int64]:
        if not self.repeatable:
            return self._decide(obs)
        keys = [row.tobytes() for row in obs]
        new = {key: row for row, key in enumerate(keys) if key not in self._known}
        if new:
            actions = self._decide(obs[list(new.values())])
            self._known.update(zip(new, actions.tolist(), strict=True))
        return np.array([self._known[key] for key in keys], dtype=np.int64)

    def _decide(self, obs: NDArray[Any]) -> NDArray[np.int64]:
        start = time.perf_counter()
        actions = np.asarray(self.policy(obs)).astype(np.int64).reshape(len(obs))
        self.seconds += time.perf_counter() - start
        self.decisions += len(obs)
        return actions


def evaluate_game(
    game: Game,
    policy: Policy,
    *,
    episodes: int,
    seed: int = 0,
    goals: Mapping[str, Goal] | None = None,
    repeatable: bool = False,
    report: Callable[[float], None] | None = None,
) -> Evaluation:
    """Plays ``episodes`` episodes of a game side by side.

    Args:
        game: the game; its ``max_episode_steps`` ends an episode.
        policy: what acts.
        episodes: how many.
        seed: which episodes.
        goals: reward functions to score the episodes with, by name; None for the game's own, called
            "default".
        repeatable: whether equal observations always get equal actions, so that the policy is asked only
            once.
        report: told the share done, 0 ... 1, after every step.
    """
    goals = {"default": game.reward} if goals is None else goals
    keys = derive(derive(seed, _REPORTING), np.arange(episodes))
    watch = _Stopwatch(policy, repeatable)
    obs = game.initial(derive(keys, 0))
    returns = {name: np.zeros(episodes) for name in goals}
    running = np.ones(episodes, dtype=np.bool_)
    for step in range(game.max_episode_steps):
        actions = watch(obs)
        next_obs = game.transition(obs, actions, derive(keys, step + 1))
        # Integers wide enough that a user's sums over planes do not overflow int8.
        wide, wide_next = obs.astype(np.int64), next_obs.astype(np.int64)
        for name, goal in goals.items():
            returns[name] += np.where(running, np.asarray(goal(wide, actions, wide_next), dtype=np.float64), 0.0)
        running &= ~game.terminated(obs, actions, next_obs)
        obs = next_obs
        if report is not None:
            report((step + 1) / game.max_episode_steps)
        if not running.any():
            break
    return Evaluation(returns, watch.seconds, watch.decisions)


def evaluate_env(
    make_env: Callable[[], gym.Env[Any, Any]],
    policy: Policy,
    *,
    episodes: int,
    seed: int = 0,
    repeatable: bool = False,
) -> Evaluation:
    """Plays one episode in each of ``episodes`` copies of an environment, deciding for all at once.

    Args:
        make_env: makes a copy; it has to end its episodes by itself.
        policy: what acts; observations come laid out as ``gymnasium.vector.utils.batch_space`` does.
        episodes: how many.
        seed: which episodes.
        repeatable: see ``evaluate_game``; observations have to be plain arrays for it.
    """
    envs = [make_env() for _ in range(episodes)]
    # np.random.SeedSequence keeps the seeds of reporting away from the small numbers used for training.
    seeds = np.random.SeedSequence([seed, _REPORTING]).generate_state(episodes)
    watch = _Stopwatch(policy, repeatable)
    returns = np.zeros(episodes)
    live = list(range(episodes))
    current = {i: envs[i].reset(seed=int(seeds[i]))[0] for i in live}
    while live:
        actions = watch(_stack(envs[0].observation_space, [current[i] for i in live]))
        still = []
        for i, action in zip(live, actions, strict=True):
            current[i], reward, terminated, truncated, _ = envs[i].step(int(action))
            returns[i] += float(reward)
            if not (terminated or truncated):
                still.append(i)
        live = still
    for env in envs:
        env.close()
    return Evaluation({"default": returns}, watch.seconds, watch.decisions)


def _stack(space: gym.Space[Any], observations: Sequence[Any]) -> Any:
    """One batch of many observations."""
    empty: Any = create_empty_array(space, len(observations))
    return concatenate(space, observations, empty)


def random_policy(n_actions: int, seed: int = 0) -> Policy:
    """Uniformly random actions from a generator of its own."""
    rng = np.random.default_rng(seed)
    return lambda obs: rng.integers(n_actions, size=len(obs))


def milliseconds_per_decision(policy: Policy, observations: NDArray[Any], *, warm_up: int = 3) -> float:
    """Median wall time of a decision about a single observation, in milliseconds.

    Args:
        policy: what is timed.
        observations: observations [N, ...], each decided on its own.
        warm_up: decisions made before the clock starts (compilation, caches).
    """
    for row in range(min(warm_up, len(observations))):
        policy(observations[row : row + 1])
    times = []
    for row in range(len(observations)):
        start = time.perf_counter()
        policy(observations[row : row + 1])
        times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times))
