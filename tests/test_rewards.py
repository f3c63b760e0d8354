"""Reward functions of users, called with batches in the environment's own form."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.rewards import CallableReward
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.types import Floats

PLAIN = spaces.MultiDiscrete([3, 4], start=[1, -2])
NESTED = spaces.Dict({"a": spaces.MultiBinary(2), "b": spaces.Tuple((spaces.Discrete(3, start=5), spaces.Discrete(4)))})


def total(obs: Any) -> Floats:
    """Sum over a batch's rows, which overwrites the batch."""
    if isinstance(obs, dict):
        return np.asarray(total(obs["a"]) + total(obs["b"]))
    if isinstance(obs, tuple):
        return np.asarray(sum(total(part) for part in obs))
    result = obs.reshape(len(obs), -1).sum(axis=1).astype(np.float64)
    obs[...] = -99
    return np.asarray(result)


def reward(obs: Any, action: Any, next_obs: Any) -> Floats:
    return np.asarray(100.0 * total(obs) + 10.0 * total(action) + total(next_obs))


@pytest.mark.parametrize("space", [PLAIN, NESTED])
@pytest.mark.parametrize("action_space", [spaces.Discrete(3, start=2), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)])
def test_a_reward_function_may_overwrite_its_arguments(space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    factored, actions = FactoredSpace(space), ActionEnumeration(action_space)
    goal, rng = CallableReward(reward, factored, actions), np.random.default_rng(0)
    before, after = rng.integers(factored.cardinalities, size=(2, 9, len(factored)))
    chosen = rng.integers(actions.n, size=9)
    expected = reward(factored.decode_wide(before), actions.decode_wide(chosen), factored.decode_wide(after))
    kept = before.copy(), after.copy()
    for _ in range(2):
        np.testing.assert_array_equal(goal(before, chosen, after), expected)
        np.testing.assert_array_equal([before, after], kept)
    for _ in range(2):
        np.testing.assert_array_equal(goal.of_owned(before.copy(), chosen, after.copy()), expected)
