"""Known tables: samples, successors and errors, and planning without learning."""

import gymnasium as gym
import numpy as np
import pytest

from mbagent import ModelLearningAgent
from mbagent.models.mdp import StateGraph
from mbagent.models.tabular import TabularMDP, toy_text_model
from mbagent_envs.random_keys import derive


def test_draws_successors_and_probabilities_are_those_of_the_table() -> None:
    env = gym.make("FrozenLake-v1", map_name="4x4")
    model, reward = toy_text_model(env)
    table = env.unwrapped.P  # type: ignore[attr-defined]
    state, action = 14, 2
    truth: dict[tuple[int, bool], float] = {}
    for p, following, _, over in table[state][action]:
        truth[following, over] = truth.get((following, over), 0.0) + p
    listed = model.successors(np.array([[state]]), np.array([action]), 100, 0)
    found = zip(listed.states[:, 0], listed.terminated, listed.probabilities, strict=True)
    assert {(int(s), bool(t)): pytest.approx(p) for s, t, p in found} == truth
    many = np.full((30_000, 1), state), np.full(30_000, action)
    drawn, ended = model.sample(*many, derive(0, np.arange(30_000)))
    for (following, over), p in truth.items():
        share = ((drawn[:, 0] == following) & (ended == over)).mean()
        assert abs(share - p) < 5 * np.sqrt(p * (1 - p) / 30_000)
        logs = model.log_prob(np.array([[state]]), np.array([action]), np.array([[following]]), np.array([over]))
        assert np.exp(logs[0]) == pytest.approx(p)
    assert model.marginals(np.array([[state]]), np.array([action])).sum() == pytest.approx(1.0)
    assert reward(np.array([14]), np.array([2]), np.array([15])).tolist() == [1.0]


def test_an_agent_plans_on_a_table_without_learning() -> None:
    env = gym.make("CliffWalking-v1", max_episode_steps=200)
    model, reward = toy_text_model(env)
    agent = ModelLearningAgent("MctsPolicy", env, model=model, reward=reward, seed=0)
    obs, _ = env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        action, _ = agent.predict(obs)
        obs, gained, terminated, truncated, _ = env.step(int(action))
        total, done = total + float(gained), terminated or truncated
    assert total == -13.0


def test_a_world_without_a_table_and_a_table_with_holes_are_refused() -> None:
    with pytest.raises(TypeError, match="has no table of its rules"):
        toy_text_model(gym.make("Blackjack-v1"))
    ones = np.ones(2)
    with pytest.raises(ValueError, match="summing to one"):
        TabularMDP(np.array([0, 1, 2]), np.zeros(2, np.int64), ones == 0, ones / 2, 1, np.zeros(1, np.int64))


@pytest.mark.parametrize("draws", [1, 3, 4, 40])
def test_compiled_expansion_equals_the_successors(draws: int) -> None:
    """Of pairs with one to seven outcomes, some of which terminate."""
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 8, size=12 * 3)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    probabilities = np.concatenate([rng.dirichlet(np.full(n, 0.3)) for n in counts])
    following = np.concatenate([rng.choice(12, n, replace=False) for n in counts])
    model = TabularMDP(offsets, following, rng.random(len(following)) < 0.2, probabilities, 3, np.arange(12))
    compiled, plain = StateGraph(model), StateGraph(model)
    plain.kernel = None
    for graph in (compiled, plain):
        nodes = graph.add(np.arange(12)[:, None], np.zeros(12, dtype=np.int64))
        graph.expand(nodes, draws, seed=draws)
    assert compiled.kernel is not None
    for name in ("sources", "actions", "next_nodes", "terminated", "probabilities", "first", "counts"):
        np.testing.assert_array_equal(getattr(compiled, name), getattr(plain, name), err_msg=name)
