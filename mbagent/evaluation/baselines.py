"""PPO, DQN and A2C of Stable-Baselines3, with settings that suit short runs on small games."""

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
"""What differs from SB3's defaults, and the number of environment copies; "MlpPolicy" (two layers of 64)
everywhere.

DQN's loss grows only linearly with large errors, so that rare high costs count too little: it seeks medians
rather than means. Rewards scaled down keep the errors where the loss is quadratic.
The copies and the lengths of their roll-outs divide 10,000, so that exactly the steps asked for are used.
"""

_CLASSES: dict[str, type[BaseAlgorithm]] = {"PPO": PPO, "DQN": DQN, "A2C": A2C}
Curve = list[tuple[int, float]]
Evaluate = Callable[[Policy, bool], float]
"""(policy, whether equal observations always get equal actions) -> mean return."""


def as_policy(algorithm: Any, *, deterministic: bool = True) -> Policy:
    """The policy of anything with SB3's ``predict``.

    Args:
        algorithm: an SB3 algorithm, or the agent of this package.
        deterministic: the most likely action; else sampled as in training.
    """

    def policy(obs: Any) -> NDArray[np.int64]:
        actions, _ = algorithm.predict(obs, deterministic=deterministic)
        return np.asarray(actions).astype(np.int64)

    return policy


def best_mode(algorithm: Any, evaluate: Evaluate) -> tuple[bool, float]:
    """Whether an algorithm scores better with its most likely actions or with sampled ones, and that score.

    A policy whose most likely action runs against a wall forever does better when it samples; the baselines
    are given the benefit of either.
    """
    likely = evaluate(as_policy(algorithm, deterministic=True), True)
    sampled = evaluate(as_policy(algorithm, deterministic=False), False)
    return likely >= sampled, max(likely, sampled)


class _Checkpoints(BaseCallback):
    """Evaluates the policy at evenly spaced numbers of environment steps."""

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
        name: which algorithm.
        make_env: makes one environment.
        steps: environment steps over all copies together.
        seed: seed of networks, exploration and environments.
        evaluate: mean return of a policy (and whether it is deterministic), for the learning curve.
        points: evaluations on the learning curve, besides the one before training.
        reward_scale: what rewards are multiplied with for training; None for what BASELINE_SETTINGS say.
        report: told the share of steps done, 0 ... 1.

    Returns:
        (the trained algorithm, learning curve as (environment steps, mean return)).
    """
    settings = dict(BASELINE_SETTINGS[name])
    usual = settings.pop("reward_scale", 1.0)
    scale = usual if reward_scale is None else reward_scale

    def make_scaled() -> gym.Env[Any, Any]:
        return TransformReward(make_env(), lambda reward: scale * float(reward))

    vec_env = make_vec_env(make_scaled, n_envs=settings.pop("n_envs"), seed=seed)
    # The learning rates were chosen for 50,000 steps; much longer runs keep them.
    algorithm = _CLASSES[name]("MlpPolicy", vec_env, seed=seed, device="cpu", verbose=0, **settings)
    callback = _Checkpoints(steps, points, evaluate, report)
    algorithm.learn(total_timesteps=steps, callback=callback)
    vec_env.close()
    return algorithm, callback.curve
