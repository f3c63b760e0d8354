"""Plays whole episodes with any policy in one batch and scores them, optionally under several goals at once.

Evaluation episodes never coincide with training episodes, because evaluation derives its random keys with a separate salt.
With the same seed, every policy gets the same start states and random numbers, so that differences in returns
are due to the policies.
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

_REPORTING = 0x5EED  # salt that separates evaluation episodes from training episodes


@dataclass(frozen=True)
class Evaluation:
    """Episodes played by one policy.

    Attributes:
        returns: for each goal name, the undiscounted returns of the episodes, float64 [episodes].
        seconds: wall time spent in the policy.
        decisions: number of actions requested from the policy.
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
    """Times a policy; if it is ``repeatable``, calls it only once for each distinct observation."""

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
    """Plays ``episodes`` episodes of a game in parallel.

    Args:
        game: the game; episodes are cut off after ``game.max_episode_steps`` steps.
        policy: chooses the actions.
        episodes: number of episodes.
        seed: seed of start states and random numbers.
        goals: reward functions by name; episodes are scored by each of them. None for only the game's own reward, under the name
            "default".
        repeatable: whether the policy always chooses equal actions for equal observations; if so, it is called only once for
            each distinct observation.
        report: called after every step with the fraction done, from 0 to 1.
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
        # Wide integers, so that sums over planes in a user's reward function do not overflow int8.
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
    """Plays one episode in each of ``episodes`` copies of an environment, with one batch of decisions per step.

    Args:
        make_env: creates one copy; its episodes must end by termination or truncation.
        policy: chooses the actions; observations are batched as in ``gymnasium.vector.utils.batch_space``.
        episodes: number of episodes.
        seed: seed of the environments.
        repeatable: see ``evaluate_game``; requires observations that are plain arrays.
    """
    envs = [make_env() for _ in range(episodes)]
    # np.random.SeedSequence separates the evaluation seeds from the small numbers used for training.
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
    """Stacks observations into one batch."""
    empty: Any = create_empty_array(space, len(observations))
    return concatenate(space, observations, empty)


def random_policy(n_actions: int, seed: int = 0) -> Policy:
    """Policy of uniformly random actions, with its own generator."""
    rng = np.random.default_rng(seed)
    return lambda obs: rng.integers(n_actions, size=len(obs))


def milliseconds_per_decision(policy: Policy, observations: NDArray[Any], *, warm_up: int = 3) -> float:
    """Median wall time of a decision for a single observation, in milliseconds.

    Args:
        policy: the policy to time.
        observations: observations [N, ...], each passed to the policy as a batch of one.
        warm_up: number of untimed decisions made first (compilation, caches).
    """
    for row in range(min(warm_up, len(observations))):
        policy(observations[row : row + 1])
    times = []
    for row in range(len(observations)):
        start = time.perf_counter()
        policy(observations[row : row + 1])
        times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times))
