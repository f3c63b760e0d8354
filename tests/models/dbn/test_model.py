"""Decision graphs as a transition model: properties of its probabilities, environments learned exactly, files."""

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from mbagent import ModelLearningAgent
from mbagent.data import TransitionDataset
from mbagent.models.dbn import DecisionGraphModel
from mbagent_envs import FlierCatcher, GeyserRunner, Maneuverer
from mbagent_envs.random_keys import derive
from tests.models.helpers import dataset, outcomes, played

CARDINALITIES = (2, 3, 2, 2, 2)


def small_world(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A bit that copies another under one action, a wheel of three that turns or slips, and three bits of which one is on."""
    rng = np.random.default_rng(seed)
    actions = rng.integers(2, size=n)
    bit, wheel, place = rng.integers(2, size=n), rng.integers(3, size=n), rng.integers(3, size=n)
    states = np.column_stack([bit, wheel, np.eye(3, dtype=np.int64)[place]])
    next_bit = np.where(actions == 1, place == 2, bit)
    next_wheel = np.where((rng.random(n) < 0.7) & (bit == 1), (wheel + 1) % 3, wheel)
    next_place = np.where(wheel == 0, rng.integers(3, size=n), place)
    following = np.column_stack([next_bit, next_wheel, np.eye(3, dtype=np.int64)[next_place]])
    terminated = (wheel == 2) & (place == 1) & (actions == 0)
    return states, actions, following, terminated


@pytest.fixture(scope="module")
def model() -> DecisionGraphModel:
    fitted = DecisionGraphModel(CARDINALITIES, 2)
    fitted.fit(dataset(CARDINALITIES, 2, *small_world(4000, 0)))
    return fitted


def test_probabilities_sum_to_one_and_agree_with_samples_and_successors(model: DecisionGraphModel) -> None:
    possible, ends = outcomes(CARDINALITIES)
    states, actions, _, _ = small_world(12, 1)
    for state, action in zip(states, actions, strict=True):
        many = np.tile(state, (len(ends), 1))
        probs = np.exp(model.log_prob(many, np.full(len(ends), action), possible, ends))
        assert probs.sum() == pytest.approx(1.0)
        drawn, over = model.sample(np.tile(state, (20_000, 1)), np.full(20_000, action), derive(3, np.arange(20_000)))
        for outcome, end, p in zip(possible, ends, probs, strict=True):
            share = ((drawn == outcome).all(axis=1) & (over == end)).mean()
            assert abs(share - p) < 5 * np.sqrt(p * (1 - p) / 20_000) + 1e-4
        listed = model.successors(state[None], np.array([action]), 64, 0)
        exact = model.log_prob(
            np.tile(state, (len(listed.states), 1)), np.full(len(listed.states), action), listed.states, listed.terminated
        )
        kept = np.exp(exact)
        assert kept.sum() > 0.95
        np.testing.assert_allclose(listed.probabilities, kept / kept.sum(), atol=1e-6)


def test_dependencies_of_a_small_world_are_learned(model: DecisionGraphModel) -> None:
    possible, ends = outcomes(CARDINALITIES)
    state = np.array([1, 1, 0, 0, 1])
    probs = np.exp(model.log_prob(np.tile(state, (len(ends), 1)), np.ones(len(ends), dtype=np.int64), possible, ends))
    turned = (possible == [1, 2, 0, 0, 1]).all(axis=1) & ~ends
    slipped = (possible == [1, 1, 0, 0, 1]).all(axis=1) & ~ends
    assert probs[turned][0] == pytest.approx(0.7, abs=0.04)
    assert probs[turned][0] + probs[slipped][0] > 0.995
    _, over = model.likeliest(np.array([[0, 2, 0, 1, 0], [0, 2, 0, 1, 0]]), np.array([0, 1]))
    assert over.tolist() == [True, False]  # wheel at 2 and place at 1: neither is enough alone


def test_marginals_agree_with_the_joint_distribution(model: DecisionGraphModel) -> None:
    possible, ends = outcomes(CARDINALITIES)
    states, actions, _, _ = small_world(5, 2)
    found = model.marginals(states, actions)
    for row, (state, action) in enumerate(zip(states, actions, strict=True)):
        many = np.tile(state, (len(ends), 1))
        probs = np.exp(model.log_prob(many, np.full(len(ends), action), possible, ends))
        expected = [probs[possible[:, f] == v].sum() for f, c in enumerate(CARDINALITIES) for v in range(c)]
        np.testing.assert_allclose(found[row], expected, atol=1e-9)


def test_a_row_does_not_depend_on_its_batch(model: DecisionGraphModel) -> None:
    states, actions, _, _ = small_world(50, 3)
    keys = derive(5, np.arange(50))
    together, over = model.sample(states, actions, keys)
    for b in range(50):
        alone, end = model.sample(states[b : b + 1], actions[b : b + 1], keys[b : b + 1])
        np.testing.assert_array_equal(alone[0], together[b])
        assert end[0] == over[b]
    with pytest.raises(ValueError, match=r"needs states \[B, 5\]"):
        model.sample(states[:, :4], actions, keys)


def test_a_maze_of_flat_bits_in_any_order_is_learned_in_5000_steps() -> None:
    order = np.random.default_rng(5).permutation(108)

    def mixed(n: int, seed: int) -> TransitionDataset:
        rows = played(Maneuverer(), n, 100, seed).rows()
        data = TransitionDataset((2,) * 108, 4)
        data.append(replace(rows, before=rows.before[:, order], after=rows.after[:, order]))
        return data

    flat = DecisionGraphModel((2,) * 108, 4)
    report = flat.fit(mixed(5000, 1))
    assert report.log["events"] > 10  # new layouts
    rows = mixed(10_000, 2).rows()
    usual = (rows.states != rows.next_states).sum(axis=1) <= 2
    drawn, _ = flat.sample(rows.states, rows.actions, derive(9, np.arange(10_000)))
    assert (flat.likeliest(rows.states, rows.actions)[0] == rows.next_states).all(axis=1)[usual].mean() > 0.995
    assert (drawn == rows.next_states).all(axis=1)[usual].mean() > 0.99
    fewer = flat.successors(rows.states[:200], rows.actions[:200], 32, 0)
    np.testing.assert_allclose(np.bincount(fewer.rows, weights=fewer.probabilities), 1.0)


def test_flat_bits_that_exclude_each_other_are_drawn_together() -> None:
    game = FlierCatcher(height=4, width=4)
    flat = DecisionGraphModel((2,) * 32, 3)
    flat.fit(played(game, 4000, 100))
    rows = played(game, 2000, 100, seed=1).rows()
    states, _ = flat.sample(rows.states, rows.actions, derive(1, np.arange(2000)))
    spawned = states.reshape(-1, 2, 4, 4)[:, 1, :, -1].sum(axis=1)
    assert spawned.max() == 1
    assert abs(spawned.mean() - 0.4) < 5 * np.sqrt(0.24 / 2000)


def test_weights_are_restored_and_damaged_ones_refused(model: DecisionGraphModel) -> None:
    other = DecisionGraphModel(CARDINALITIES, 2)
    other.load_state_dict(model.state_dict())
    states, actions, _, _ = small_world(100, 4)
    keys = derive(1, np.arange(100))
    np.testing.assert_array_equal(other.sample(states, actions, keys)[0], model.sample(states, actions, keys)[0])
    good = model.state_dict()
    endless = {**good, "usual.off": np.arange(len(good["usual.off"])) * (good["usual.column"] >= 0)}
    for wrong in (
        {name: value for name, value in good.items() if name != "usual.rate"},
        endless,
        {**good, "usual.column": good["usual.column"] + 99},
        {**good, "usual.nodes": good["usual.nodes"] - 10**6},
        {**good, "usual.values": good["usual.values"] + 9},
        {**good, "usual.rate": good["usual.rate"] * np.nan},
        {**good, "groups": np.array([[0, 1], [0, 2]])},
        {**good, "couplings": np.zeros_like(good["couplings"])},
        {**good, "couplings": good["couplings"][:-1]},
        DecisionGraphModel((2, 2), 2).state_dict(),
    ):
        with pytest.raises(ValueError, match="These weights"):
            other.load_state_dict(wrong)
        assert all(np.array_equal(value, good[name]) for name, value in other.state_dict().items())


def test_unfitted_model_predicts_no_change() -> None:
    fresh = DecisionGraphModel((2, 3), 2)
    states = np.array([[1, 2], [0, 1]])
    np.testing.assert_array_equal(fresh.sample(states, np.array([0, 1]), derive(1, np.arange(2)))[0], states)


def test_agent_plans_with_decision_graphs_and_saves_them(tmp_path: Path) -> None:
    env = gym.make("mbagent/GeyserRunner-v0", mode="deterministic")
    agent = ModelLearningAgent("MctsPolicy", env, model="graphs", seed=0)
    agent.learn(1500)
    assert agent.fit_report is not None
    assert agent.fit_report.exact_match == 1.0
    obs = GeyserRunner(mode="deterministic").initial(derive(2, np.arange(8)))
    agent.save(tmp_path / "agent.zip")
    again = ModelLearningAgent.load(tmp_path / "agent.zip", env=env)
    np.testing.assert_array_equal(again.predict(obs)[0], agent.predict(obs)[0])
