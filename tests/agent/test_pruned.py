"""A pruned agent continues to plan; an agent that cannot be pruned raises an error of one sentence and is unchanged."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from mbagent import ModelLearningAgent
from mbagent.models.neural.connections import PruningConfig
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from mbagent.models.registry import register_model
from mbagent.spaces import FactoredSpace


def small(space: FactoredSpace, n_actions: int, learning_rate: float) -> NeuralTransitionModel:
    training = TrainingConfig(min_steps=150, max_steps=150, learning_rate=learning_rate)
    return NeuralTransitionModel(space.cardinalities, n_actions, NeuralConfig(hidden=(16,), group_size=4, training=training))


register_model("small networks", small)


def agent(model: str = "small networks") -> ModelLearningAgent:
    env = gym.make("mbagent/GeyserRunner-v0", width=4)
    return ModelLearningAgent("MctsPolicy", env, seed=0, model=model, num_simulations=4, horizon=3)


def test_a_pruned_agent_keeps_its_goal_and_can_be_saved(tmp_path: Path) -> None:
    one = agent().learn(400, log_interval=None)
    one.set_reward(lambda obs, action, next_obs: next_obs[:, 0].astype(float))
    obs = np.stack([one.observation_space.sample() for _ in range(4)])
    assert one.prune(0.6, config=PruningConfig(evidence=False)) is one
    assert one.fit_report is not None
    assert one.fit_report.log["pruned"] == pytest.approx(0.6, abs=0.01)
    actions, _ = one.predict(obs)
    one.save(tmp_path / "pruned.zip", include=["transitions"])
    other = ModelLearningAgent.load(tmp_path / "pruned.zip", reward=lambda obs, action, next_obs: next_obs[:, 0].astype(float))
    assert np.array_equal(other.predict(obs)[0], actions)
    other.prune(0.8)  # possible with transitions
    assert other.fit_report is not None
    assert other.fit_report.log["pruned"] >= 0.79  # at least the requested share


def test_mistakes_raise_an_error_of_one_sentence_and_change_nothing(tmp_path: Path) -> None:
    one = agent()
    with pytest.raises(ValueError, match="call learn"):
        one.prune(0.5)
    one.learn(300, log_interval=None)
    before = one.get_parameters()["policy"]
    for fraction in (1.0, -0.5, 2):
        with pytest.raises(ValueError, match="up to but not including 1"):
            one.prune(fraction)
    after = one.get_parameters()["policy"]
    assert all(np.array_equal(before[name], after[name]) for name in before)
    one.save(tmp_path / "agent.zip")
    with pytest.raises(ValueError, match="load_transitions"):
        ModelLearningAgent.load(tmp_path / "agent.zip", env=one.env).prune(0.5)
    with pytest.raises(TypeError, match="model='networks'"):
        agent("graphs").learn(300, log_interval=None).prune(0.5)
