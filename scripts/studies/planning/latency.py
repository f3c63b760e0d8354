"""Cost of a decision compared with a forward pass of PPO on the same observations, and returns at the same setting."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO

from harness import Row
from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.baselines import as_policy
from mbagent.evaluation.statistics import interquartile_mean, normalised
from worlds.games import find_case, play
from worlds.known_rules import Scale


@dataclass(frozen=True)
class Setting:
    """Settings with which a game is played.

    Attributes:
        key: key of the case.
        num_simulations: simulations of the search.
        settings: further PlannerSettings.
    """

    key: str
    num_simulations: int = 64
    settings: Mapping[str, Any] = field(default_factory=dict)


SETTINGS = (
    Setting("geyser_deterministic"),
    Setting("geyser_low_cost"),
    Setting("geyser_high_cost"),
    Setting("flier_catcher", 8, {"lookahead_states": 24, "lookahead_samples": 1}),
    Setting("maneuverer", 16, {"lookahead_states": 80}),
)
"""Small budgets that suffice for a normalised return of 0.95 (Maneuverer: 0.90)."""

LEARNED_FROM, OBSERVATIONS = 20_000, 300


def measure(setting: Setting, seed: int, scale: Scale, episodes: int) -> list[Row]:
    """Rows of a game: with its own reward, and with an equivalent plain Python function.

    Observations are distinct and from new episodes; the first decisions, which include compilation, and the work done once
    per goal are timed separately.
    """
    case, game = find_case(setting.key), find_case(setting.key).game
    assert game is not None
    env = case.make_env()
    learner = ModelLearningAgent("MctsPolicy", env, seed=seed).learn(LEARNED_FROM, log_interval=None)
    agent = ModelLearningAgent(
        "MctsPolicy", env, seed=seed, num_simulations=setting.num_simulations, policy_kwargs=dict(setting.settings)
    )
    agent.policy.start_states = learner.policy.start_states
    agent.set_parameters(learner.get_parameters())
    ppo = PPO("MlpPolicy", env, seed=seed, device="cpu")
    observations = distinct_observations(case.make_env(), OBSERVATIONS, seed + 777)

    def plain(obs: Any, action: Any, next_obs: Any) -> Any:
        return game.reward(obs, action, next_obs)

    rows = []
    for name, reward in (("own", None), ("Python", plain)):
        agent.predict(observations[0])  # includes compilation
        began = time.process_time()
        agent.set_reward(reward)
        agent.predict(observations[0])
        once = time.process_time() - began
        ours, theirs = milliseconds(agent.predict, observations[1:]), milliseconds(ppo.predict, observations[1:])
        returns = play(case, as_policy(agent), episodes=episodes, seed=seed, repeatable=True).default
        score = float(interquartile_mean(normalised(returns, scale.random, scale.reference)))
        rows.append(
            {"game": setting.key, "reward": name, "simulations": setting.num_simulations,
             "lookahead states": setting.settings.get("lookahead_states", 160), "ms a decision": ours, "PPO, ms": theirs,
             "times PPO": ours / theirs, "once for a goal, ms": 1e3 * once, "normalised": score}
        )  # fmt: skip
    return rows


def steady(setting: Setting, seed: int, decisions: int) -> Row:
    """Memory of this process (MiB) after a tenth of the decisions and after all, and times of the first and last tenth."""
    case = find_case(setting.key)
    env = case.make_env()
    agent = ModelLearningAgent(
        "MctsPolicy", env, seed=seed, num_simulations=setting.num_simulations, policy_kwargs=dict(setting.settings)
    ).learn(2000, log_interval=None)
    observations, tenth, seconds = distinct_observations(case.make_env(), OBSERVATIONS, seed), decisions // 10, []
    for part in range(10):
        if part == 1:
            before = mebibytes_held()
        began = time.process_time()
        for i in range(tenth):
            agent.predict(observations[i % len(observations)])
        seconds.append(time.process_time() - began)
    return {
        "game": setting.key,
        "decisions": 10 * tenth,
        "MiB after a tenth": before,
        "MiB in the end": mebibytes_held(),
        "ms, first tenth": 1e3 * seconds[0] / tenth,
        "ms, last tenth": 1e3 * seconds[-1] / tenth,
    }


def mebibytes_held() -> float:
    """Current memory of this process, MiB; its peak so far if the system does not report the current value."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="ascii").split()[1]) * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def distinct_observations(env: Any, n: int, seed: int) -> list[Any]:
    """Observations of random play, distinct if there are enough."""
    rng, found, seen = np.random.default_rng(seed), [], set()
    obs, _ = env.reset(seed=seed)
    for step in range(20 * n):
        if obs.tobytes() not in seen or step > 10 * n:
            seen.add(obs.tobytes())
            found.append(obs)
            if len(found) == n:
                break
        obs, _, terminated, truncated, _ = env.step(int(rng.integers(env.action_space.n)))
        if terminated or truncated:
            obs, _ = env.reset()
    return found


def milliseconds(predict: Callable[[Any], Any], observations: Sequence[Any]) -> float:
    """Median processor time of a decision for one observation, in milliseconds."""
    times = []
    for obs in observations:
        began = time.process_time()
        predict(obs)
        times.append(time.process_time() - began)
    return 1e3 * float(np.median(times))
