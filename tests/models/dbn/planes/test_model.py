"""Decision graphs for planes: features by brute force, properties of probabilities, boards of other sizes, files."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import ModelLearningAgent
from mbagent.data import TransitionDataset
from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.dbn.features import BEYOND
from mbagent.models.dbn.planes.features import (
    ACTION,
    BORDER,
    CELL,
    COLUMN,
    NEXT,
    NEXT_ADJACENCY,
    WHOLE,
    WRAP,
    Mutex,
    Reach,
    feature_kinds,
    feature_values,
    relative_features,
)
from mbagent.spaces import FactoredSpace
from mbagent_envs import FlierCatcher, Maneuverer
from mbagent_envs.random_keys import derive
from tests.models.helpers import dataset, outcomes, played


def planes(*shape: int) -> FactoredSpace:
    return FactoredSpace(spaces.MultiBinary(shape))


def test_relative_features_agree_with_brute_force() -> None:
    rng = np.random.default_rng(0)
    board, actions = rng.integers(2, size=(4, 2, 3, 5)), rng.integers(3, size=4)
    features = relative_features((2, 2), (3,), Reach(1, wrap=True))
    after = rng.integers(2, size=board.shape)
    table = feature_values(features, board, actions, after).reshape(4, 3, 5, len(features))

    def cell(n: int, channel: int, y: int, x: int, planes: np.ndarray = board) -> bool:
        return 0 <= y < 3 and 0 <= x < 5 and bool(planes[n, channel, y, x] == 1)

    for d, (kind, *parts) in enumerate(features.tolist()):
        for n, y, x in np.ndindex(4, 3, 5):
            if kind == CELL:
                expected = cell(n, parts[0], y + parts[2], x + parts[3])
            elif kind == NEXT:
                expected = cell(n, parts[0], y + parts[2], x + parts[3], after)
            elif kind == BORDER:
                expected = not (0 <= y + parts[0] < 3 and 0 <= x + parts[1] < 5)
            elif kind == ACTION:
                expected = bool(actions[n] == parts[0])
            elif kind == WRAP:
                i, j = y + parts[2], x + parts[3]
                expected = not (0 <= i < 3 and 0 <= j < 5) and cell(n, parts[0], i % 3, j % 5)
            else:
                first, _, second, _, below, right = parts
                shown = after if kind == NEXT_ADJACENCY else board

                def outside(i: int, j: int) -> bool:
                    return not (0 <= i < 3 and 0 <= j < 5)

                expected = any(
                    cell(n, first, i, j, shown)
                    and (outside(i + below, j + right) if second == BEYOND else cell(n, second, i + below, j + right, shown))
                    for i, j in np.ndindex(3, 5)
                )
            assert table[n, y, x, d] == expected, (kind, parts)
    assert len(np.unique(features, axis=0)) == len(features)
    assert len(feature_kinds(features)) == len(features)


def gliders(n: int, seed: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A glider that moves right, or stays under action 1 and at the border, and lights that go out at random.

    The episode ends after a step from a light.
    """
    rng = np.random.default_rng(seed)
    y, x, actions = rng.integers(height, size=n), rng.integers(width, size=n), rng.integers(2, size=n)
    board = np.zeros((n, 2, height, width), dtype=np.int64)
    rows = np.arange(n)
    board[rows, 0, y, x] = 1
    board[:, 1] = rng.random((n, height, width)) < 0.3
    after = np.zeros_like(board)
    after[rows, 0, y, np.where(actions == 0, np.minimum(x + 1, width - 1), x)] = 1
    after[:, 1] = board[:, 1] ^ (rng.random((n, height, width)) < 0.25 * board[:, 1])
    ends = board[rows, 1, y, x] == 1
    return board.reshape(n, -1), actions, after.reshape(n, -1), ends


@pytest.fixture(scope="module")
def model() -> LocalGraphModel:
    fitted = LocalGraphModel(planes(2, 3, 3), 2)
    fitted.fit(dataset((2,) * 18, 2, *gliders(3000, 0, 3, 3)))
    return fitted


def test_dynamics_of_planes_and_termination_are_learned(model: LocalGraphModel) -> None:
    states, actions, following, ends = gliders(2000, 1, 3, 3)
    drawn, over = model.sample(states, actions, derive(1, np.arange(2000)))
    np.testing.assert_array_equal(drawn[:, :9], following[:, :9])
    np.testing.assert_array_equal(over, ends)
    assert Mutex(0, WHOLE, 0, True) in model.local.mutexes
    on = states[:, 9:] == 1
    assert drawn[:, 9:][on].mean() == pytest.approx(0.75, abs=0.02)
    assert not drawn[:, 9:][~on].any()


def test_probabilities_sum_to_one_and_agree_with_samples_marginals_and_successors() -> None:
    # A plane of three by three cells with a random walk of one bit: nine mutually exclusive outcomes.
    rng, n = np.random.default_rng(3), 3000
    place = rng.integers(9, size=n)
    step = np.array([-3, 1, 3, -1])[rng.integers(4, size=n)]
    legal = (np.abs((place + step) % 3 - place % 3) <= 1) & (place + step >= 0) & (place + step < 9)
    after = np.where(legal, place + step, place)
    wanderer = LocalGraphModel(planes(1, 3, 3), 1)
    bits = np.eye(9, dtype=np.int64)
    wanderer.fit(dataset((2,) * 9, 1, bits[place], np.zeros(n, dtype=np.int64), bits[after]))
    possible, ends = outcomes((2,) * 9)
    start = np.concatenate([[0], np.cumsum((2,) * 9)])[:-1]
    for where in (0, 4):
        state = bits[where]
        many, none = np.tile(state, (len(ends), 1)), np.zeros(len(ends), dtype=np.int64)
        probs = np.exp(wanderer.log_prob(many, none, possible, ends))
        assert probs.sum() == pytest.approx(1.0)
        assert probs[possible.sum(axis=1) != 1].sum() == 0.0
        marginals = wanderer.marginals(state[None], none[:1])[0, start + 1]
        np.testing.assert_allclose(marginals, [probs[possible[:, f] == 1].sum() for f in range(9)])
        drawn, _ = wanderer.sample(np.tile(state, (20_000, 1)), np.zeros(20_000, dtype=np.int64), derive(2, np.arange(20_000)))
        assert abs(drawn.mean(axis=0) - marginals).max() < 0.02
        listed = wanderer.successors(state[None], none[:1], 256, 0)
        large = marginals > 0.02
        np.testing.assert_allclose(
            (listed.states * listed.probabilities[:, None]).sum(axis=0)[large], marginals[large], atol=0.02
        )


def test_mutually_exclusive_cells_are_drawn_jointly() -> None:
    game = FlierCatcher(height=4, width=5)
    space = FactoredSpace(game.observation_space)
    model = LocalGraphModel(space, 3)
    model.fit(played(game, 3000, 100))
    assert Mutex(1, COLUMN, -1, False) in model.local.mutexes
    rows = played(game, 1000, 100, seed=1).rows()
    drawn, _ = model.sample(rows.states, rows.actions, derive(4, np.arange(1000)))
    spawned = drawn.reshape(-1, 2, 4, 5)[:, 1, :, -1].sum(axis=1)
    assert spawned.max() == 1
    assert abs(spawned.mean() - 0.4) < 5 * np.sqrt(0.24 / 1000)


def test_model_of_one_board_applies_to_another() -> None:
    model = LocalGraphModel(FactoredSpace(Maneuverer(size=5).observation_space), 4)
    report = model.fit(played(Maneuverer(size=5), 2000, 100))
    assert report.exact_match is not None
    larger = Maneuverer(size=9)
    other = model.for_space(FactoredSpace(larger.observation_space))
    rows = played(larger, 1000, 100, seed=2).rows()
    usual = (rows.states != rows.next_states).sum(axis=1) <= 2
    drawn, _ = other.sample(rows.states, rows.actions, derive(5, np.arange(1000)))
    assert (drawn == rows.next_states).all(axis=1)[usual].mean() > 0.99
    with pytest.raises(ValueError, match="only the rows and columns"):
        model.for_space(planes(2, 5, 5))


@pytest.mark.parametrize("last", [False, True])
def test_cells_of_many_values_with_channels_first_or_last(last: bool) -> None:
    # Cells of three values count up where the cell above is 2; the second channel never changes.
    rng, n = np.random.default_rng(6), 1500
    board = np.stack([rng.integers(3, size=(n, 4, 4)), rng.integers(2, size=(n, 4, 4))], axis=1)
    above = np.concatenate([np.zeros((n, 1, 4), dtype=np.int64), board[:, 0, :-1]], axis=1) == 2
    after = np.stack([np.where(above, (board[:, 0] + 1) % 3, board[:, 0]), board[:, 1]], axis=1)
    high = np.ones((2, 4, 4), dtype=np.int8)
    high[0] = 2

    def flat(values: np.ndarray) -> np.ndarray:
        return (values.transpose(0, 2, 3, 1) if last else values).reshape(n, -1)

    high = high.transpose(1, 2, 0) if last else high
    space = FactoredSpace(spaces.Box(np.zeros_like(high), high, dtype=np.int8))
    model = LocalGraphModel(space, 1)
    none = np.zeros(n, dtype=np.int64)
    model.fit(dataset(space.cardinalities, 1, flat(board), none, flat(after)))
    np.testing.assert_array_equal(model.likeliest(flat(board), none)[0], flat(after))
    np.testing.assert_allclose(model.marginals(flat(board)[:3], none[:3]).sum(axis=1), 32.0)


def test_weights_are_restored_and_damaged_ones_refused(model: LocalGraphModel) -> None:
    states, actions, _, _ = gliders(200, 4, 3, 3)
    keys = derive(1, np.arange(200))
    other = LocalGraphModel(planes(2, 3, 3), 2)
    other.load_state_dict(model.state_dict())
    np.testing.assert_array_equal(other.sample(states, actions, keys)[0], model.sample(states, actions, keys)[0])
    good = model.state_dict()
    wrong: list[dict[str, Any]] = [
        {name: value for name, value in good.items() if name != "couplings"},
        {**good, "local.column": good["local.column"] + 10_000},
        {**good, "couplings": np.array([[0, 1, 7, 0]])},
        {**good, "couplings": np.array([[9, 0, 0, 1]])},
        dict(DecisionGraphModel((2,) * 18, 2).state_dict()),
        dict(LocalGraphModel(planes(3, 3, 3), 2).state_dict()),
    ]
    for state in wrong:
        with pytest.raises(ValueError, match="These weights"):
            other.load_state_dict(state)
        assert all(np.array_equal(value, good[name]) for name, value in other.state_dict().items())
    with pytest.raises(ValueError, match="use DecisionGraphModel"):
        LocalGraphModel(FactoredSpace(spaces.MultiBinary(9)), 2)


def test_agent_plans_with_local_graphs_and_saves_them(tmp_path: Path) -> None:
    env = gym.make("mbagent/FlierCatcher-v0", height=3, width=4)
    agent = ModelLearningAgent("MctsPolicy", env, model="graphs", num_simulations=16, seed=0)
    agent.learn(1000)
    assert isinstance(agent.model, LocalGraphModel)
    obs = FlierCatcher(height=3, width=4).initial(derive(2, np.arange(4)))
    agent.save(tmp_path / "agent.zip")
    again = ModelLearningAgent.load(tmp_path / "agent.zip", env=env)
    np.testing.assert_array_equal(again.predict(obs)[0], agent.predict(obs)[0])


def test_fit_to_no_transitions_predicts_no_change() -> None:
    fresh = LocalGraphModel(planes(1, 3, 3), 2)
    fresh.fit(TransitionDataset((2,) * 9, 2))
    state = np.eye(9, dtype=np.int64)[:1]
    np.testing.assert_array_equal(fresh.sample(state, np.array([1]), derive(1, np.arange(1)))[0], state)


def test_mutex_groups_of_rows_missing_on_a_smaller_board_are_ignored() -> None:
    rng, n, space = np.random.default_rng(0), 4000, planes(1, 8, 4)
    states = np.zeros((n, 1, 8, 4), dtype=np.int64)
    following = (rng.random((n, 1, 8, 4)) < 0.5).astype(np.int64)
    following[:, 0, 3] = np.eye(5, dtype=np.int64)[rng.integers(5, size=n), :4]  # at most one is on, in row 3 only
    model = LocalGraphModel(space, 2)
    model.fit(dataset(space.cardinalities, 2, states.reshape(n, -1), rng.integers(2, size=n), following.reshape(n, -1)))
    assert any(mutex.line in (3, -5) for mutex in model.local.mutexes)
    smaller = model.for_space(spaces.MultiBinary((1, 3, 4)))
    drawn, _ = smaller.sample(np.zeros((5, 12), dtype=np.int64), np.zeros(5, dtype=np.int64), derive(1, np.arange(5)))
    assert drawn.shape == (5, 12)
    with pytest.raises(ValueError, match="planes of another size"):
        model.for_space(spaces.Discrete(5))
