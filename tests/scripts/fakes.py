"""Fast stand-ins for the agent and for the baselines' training."""

from types import SimpleNamespace
from typing import Any

import numpy as np


class FakeModel:
    def state_dict(self) -> dict[str, Any]:
        return {"a": np.arange(3.0), "b": np.ones((2, 2))}


class FakeAgent:
    def __init__(self, policy: str, env: Any, *, seed: int, model: Any = None) -> None:
        self.n_actions = int(env.action_space.n)
        self.model = model or FakeModel()
        self.seed = seed
        self.num_timesteps = 0
        self.policy = SimpleNamespace(fitted=True)

    def learn(self, total_timesteps: int, callback: Any = None) -> "FakeAgent":
        self.num_timesteps = total_timesteps
        return self

    def set_env(self, env: Any) -> None:
        assert not hasattr(env.unwrapped, "reward_fn")

    def set_reward(self, reward: Any) -> None:
        assert reward is None or callable(reward)

    def predict(self, obs: Any, deterministic: bool = False) -> tuple[Any, None]:
        rows = np.asarray(obs).reshape(len(obs), -1).astype(np.int64)
        return (rows @ np.arange(1, rows.shape[1] + 1) + self.seed) % self.n_actions, None


def fake_baseline(name: str, make_env: Any, *, steps: int, seed: int, evaluate: Any, report: Any) -> Any:
    return FakeAgent("MlpPolicy", make_env(), seed=seed).learn(steps), [(0, 1.0), (steps, 2.0)]
