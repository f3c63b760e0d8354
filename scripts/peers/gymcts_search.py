"""Searches in a tabular MDP with gymcts. Run with a Python that has gymcts: gymcts_search.py world.npz.

The value of a leaf is the discounted reward on its path plus its discounted leaf value, instead of gymcts's random play.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

from peers.common import Array, read_task, run, stay_on_one_core

stay_on_one_core()

import gymnasium as gym
import numpy as np
from gymcts.gymcts_agent import GymctsAgent
from gymcts.gymcts_env_abc import GymctsABC


class TableEnv(GymctsABC):  # type: ignore[misc]
    """The MDP with the interface of gymcts: it can be set to any state, and returns leaf values as rollouts."""

    def __init__(self, arrays: dict[str, Array]) -> None:
        self.successors = arrays["successors"].tolist()
        self.cumulated = arrays["probabilities"].cumsum(axis=2).tolist()
        self.gamma, self.ends = float(arrays["gamma"]), arrays["ends"].tolist()
        self.rewards, self.leaf_values = arrays["rewards"].tolist(), arrays["leaf_values"].tolist()
        self.valid = list(range(arrays["successors"].shape[1]))
        # gymcts needs returns between -1 and 1: its exploration does not adapt to their range
        low, high = arrays["leaf_values"].min(), arrays["leaf_values"].max()
        self.middle, self.scale = float(low + high) / 2.0, 2.0 / max(float(high - low), 1e-9)
        self.action_space = gym.spaces.Discrete(len(self.valid))
        self.observation_space = gym.spaces.Discrete(len(self.rewards))
        self.samples = 0
        self.begin(0)

    def begin(self, state: int) -> None:
        """Sets the state to a root."""
        self.at, self.earned, self.discount, self.done = state, 0.0, 1.0, False

    def get_state(self) -> Any:
        """See GymctsABC."""
        return self.at, self.earned, self.discount, self.done

    def load_state(self, state: Any) -> None:
        """See GymctsABC."""
        self.at, self.earned, self.discount, self.done = state

    def is_terminal(self) -> bool:
        """See GymctsABC."""
        return self.done

    def get_valid_actions(self) -> list[int]:
        """See GymctsABC."""
        return self.valid

    def action_masks(self) -> Array | None:
        """See GymctsABC."""
        return None

    def rollout(self) -> float:
        """Rewards on the path to the current leaf plus its leaf value, discounted to the root and scaled."""
        value = 0.0 if self.done else self.leaf_values[self.at]
        return float((self.earned + self.discount * value - self.middle) * self.scale)

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """See gym.Env."""
        noise, chosen = random.random(), 0
        cumulated = self.cumulated[self.at][action]
        while chosen < len(cumulated) - 1 and noise >= cumulated[chosen]:
            chosen += 1
        self.at = self.successors[self.at][action][chosen]
        self.earned += self.discount * self.rewards[self.at]
        self.discount *= self.gamma
        self.done = self.ends[self.at]
        self.samples += 1
        return self.at, self.rewards[self.at], self.done, False, {}


def main(path: Path) -> None:
    """Runs gymcts with its own settings, one root after another."""
    task = read_task(path)
    env = TableEnv(task.arrays)

    def search(roots: Array, simulations: int, seed: int) -> tuple[Array, int]:
        random.seed(seed)
        env.samples, actions = 0, []
        for root in roots:
            env.begin(int(root))
            actions.append(GymctsAgent(env).vanilla_mcts_search(num_simulations=simulations))
        return np.array(actions), env.samples

    run(task, {"gymcts": search})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
