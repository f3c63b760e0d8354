"""Wrappers that change observations, such as adding previous ones."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from mbagent import ModelLearningAgent, wrappers
from mbagent.models import FitReport
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.wrappers import History

ON_WRAPPERS = pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")


class Echo(gym.Env[Any, Any]):
    """Observes the action before the last one, so predictions need one previous step in addition to the observation."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces.Discrete(3), spaces.Discrete(3)
        self.before = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.before, self.steps = 0, 0
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        shown, self.before, self.steps = self.before, int(action), self.steps + 1
        return shown, float(shown == 2), False, self.steps >= 20, {}


@ON_WRAPPERS
def test_a_row_holds_the_past_newest_first() -> None:
    env = History(Echo(), 2)
    obs, _ = env.reset(seed=0)
    assert obs.tolist() == [0, 0, 0, 0, 0, 0, 0, 0, 0]
    env.step(2)
    obs, *_ = env.step(1)
    assert obs.tolist() == [2, 0, 0, 1, 0, 0, 0, 0, 1]  # now 2; previously 0 and action 1; before that 0 and action 2
    obs, _ = env.reset(seed=0)
    assert not obs.any()  # nothing remains of the previous episode
    check_env(env, skip_render_check=True)


@ON_WRAPPERS
def test_planes_remain_planes() -> None:
    env = History(gym.make("mbagent/Maneuverer-v0", size=4), 1)
    assert env.observation_space == spaces.MultiBinary((3 + 3 + 4, 4, 4))
    first, _ = env.reset(seed=1)
    np.testing.assert_array_equal(first[:3], first[3:6])
    assert not first[6:].any()
    assert FactoredSpace(env.observation_space).planes == PlaneLayout(10, 4, 4)  # models see them as planes, too
    second, *_ = env.step(2)
    np.testing.assert_array_equal(second[3:6], first[:3])
    np.testing.assert_array_equal(second[6:].reshape(4, -1).all(axis=1), [False, False, True, False])
    check_env(env, skip_render_check=True)


def test_planes_that_would_be_misread_become_a_row() -> None:
    def shape(k: int) -> tuple[int, ...] | None:
        return History(gym.make("mbagent/FlierCatcher-v0", height=4, width=6), k).observation_space.shape

    assert shape(1) == (48 + 48 + 3,)  # with seven channels of four rows and six columns, columns would be mistaken for channels
    assert shape(3) == (48 + 3 * (48 + 3),)


def test_spaces_with_parts_and_wrong_numbers() -> None:
    class Parts(Echo):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Tuple((spaces.Discrete(3, start=1),))})

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return {"a": 1, "b": (3,)}, {}

    obs, _ = History(Parts(), 1).reset()
    assert obs.tolist() == [1, 2, 1, 2, 0, 0, 0]
    for wrong in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="1 or more"):
            History(Echo(), wrong)  # type: ignore[arg-type]


def test_a_model_with_one_more_step_predicts_exactly() -> None:
    def goal(obs: np.ndarray, action: np.ndarray, following: np.ndarray) -> np.ndarray:
        return np.zeros(len(obs))

    def report(env: gym.Env[Any, Any]) -> FitReport | None:
        return ModelLearningAgent("MctsPolicy", env, model="graphs", reward=goal, seed=0).learn(1500).fit_report

    with pytest.warns(UserWarning, match="History"):
        blind = report(Echo())
    seeing = report(History(Echo(), 1))
    assert blind is not None
    assert blind.exact_match is not None
    assert seeing is not None
    assert blind.exact_match < 0.6
    assert seeing.exact_match == 1.0


def test_wrappers_come_with_the_package() -> None:
    """Messages and documentation use these names."""
    assert wrappers.History is History
