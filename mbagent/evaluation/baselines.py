"""PPO, DQN and A2C of Stable-Baselines3, with settings for short runs on small games."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformReward
from numpy.typing import NDArray
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from mbagent.evaluation.evaluate import Policy

BaselineName = Literal["PPO", "DQN", "A2C"]

BASELINE_SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "PPO": {"n_envs": 8, "n_steps": 125, "batch_size": 250, "learning_rate": 1e-3, "ent_coef": 0.01},
    "DQN": {
        "n_envs": 8,
        "reward_scale": 0.1,
        "learning_rate": 1e-3,
        "learning_starts": 1000,
        "train_freq": 1,
        "gradient_steps": 1,
        "batch_size": 64,
        "target_update_interval": 500,
        "exploration_fraction": 0.3,
        "exploration_final_eps": 0.05,
    },
    "A2C": {"n_envs": 8, "n_steps": 5, "learning_rate": 1e-3, "ent_coef": 0.01, "use_rms_prop": False},
}
"""Settings that differ from SB3's defaults, and the number of environment copies; all use "MlpPolicy" (two
layers of 64).

DQN's Huber loss is linear for large errors, so rare high costs have too little effect: it estimates medians
rather than means. Scaled-down rewards keep the errors in the quadratic range of the loss.
The number of copies times the length of their rollouts divides 10,000, so exactly the requested steps are used.
"""

_CLASSES: dict[str, type[BaseAlgorithm]] = {"PPO": PPO, "DQN": DQN, "A2C": A2C}
Curve = list[tuple[int, float]]
Evaluate = Callable[[Policy, bool], float]
"""(policy, whether it is deterministic) -> mean return."""


def as_policy(algorithm: Any, *, deterministic: bool = True) -> Policy:
    """Turns an object with SB3's ``predict`` into a policy.

    Args:
        algorithm: an SB3 algorithm, or the agent of this package.
        deterministic: whether to take the most likely action; if not, actions are sampled as in training.
    """

    def policy(obs: Any) -> NDArray[np.int64]:
        actions, _ = algorithm.predict(obs, deterministic=deterministic)
        return np.asarray(actions).astype(np.int64)

    return policy


def best_mode(algorithm: Any, evaluate: Evaluate) -> tuple[bool, float]:
    """(whether an algorithm's most likely actions score at least as well as sampled ones, the better score).

    Each baseline is scored in its better mode: a policy whose most likely action runs into a wall forever, for example, does
    better with sampled actions.
    """
    likely = evaluate(as_policy(algorithm, deterministic=True), True)
    sampled = evaluate(as_policy(algorithm, deterministic=False), False)
    return likely >= sampled, max(likely, sampled)


class _Checkpoints(BaseCallback):
    """Evaluates the policy before training and then at equal intervals of environment steps."""

    def __init__(self, total: int, points: int, evaluate: Evaluate, report: Callable[[float], None] | None) -> None:
        super().__init__()
        self._due = [round(total * (i + 1) / points) for i in range(points)]
        self._total = total
        self._evaluate = evaluate
        self._report = report
        self.curve: Curve = []

    def _on_training_start(self) -> None:
        self.curve.append((0, best_mode(self.model, self._evaluate)[1]))

    def _on_step(self) -> bool:
        if self._report is not None and self.n_calls % 64 == 0:
            self._report(min(1.0, self.num_timesteps / self._total))
        if self._due and self.num_timesteps >= self._due[0]:
            self._due.pop(0)
            self.curve.append((self.num_timesteps, best_mode(self.model, self._evaluate)[1]))
        return True


def train_baseline(
    name: BaselineName,
    make_env: Callable[[], gym.Env[Any, Any]],
    *,
    steps: int,
    seed: int,
    evaluate: Evaluate,
    points: int = 10,
    reward_scale: float | None = None,
    report: Callable[[float], None] | None = None,
) -> tuple[BaseAlgorithm, Curve]:
    """Trains one baseline.

    Args:
        name: the algorithm.
        make_env: creates one environment.
        steps: total number of environment steps over all copies.
        seed: seed of networks, exploration and environments.
        evaluate: (policy, whether it is deterministic) -> mean return; used for the learning curve.
        points: number of evaluations on the learning curve, not counting the one before training.
        reward_scale: factor by which rewards are multiplied in training; None for the one in BASELINE_SETTINGS.
        report: called with the fraction of steps done, from 0 to 1.

    Returns:
        (trained algorithm, learning curve as a list of (environment steps, mean return)).
    """
    settings = dict(BASELINE_SETTINGS[name])
    usual = settings.pop("reward_scale", 1.0)
    scale = usual if reward_scale is None else reward_scale

    def make_scaled() -> gym.Env[Any, Any]:
        return TransformReward(make_env(), lambda reward: scale * float(reward))

    vec_env = make_vec_env(make_scaled, n_envs=settings.pop("n_envs"), seed=seed)
    # The learning rates were chosen for 50,000 steps; they are not adapted to longer runs.
    algorithm = _CLASSES[name]("MlpPolicy", vec_env, seed=seed, device="cpu", verbose=0, **settings)
    callback = _Checkpoints(steps, points, evaluate, report)
    algorithm.learn(total_timesteps=steps, callback=callback)
    vec_env.close()
    return algorithm, callback.curve
