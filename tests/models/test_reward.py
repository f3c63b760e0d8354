from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.data import TransitionBatch
from mbagent.models.neural.networks import FactorCodec
from mbagent.models.reward import DenseReward, LearnedReward, pack_reward, reward_outputs
from mbagent.spaces import FactoredSpace


def rows(n: int, seed: int = 0) -> TransitionBatch:
    rng = np.random.default_rng(seed)
    states, actions = rng.integers(0, 2, size=(n, 4)), rng.integers(0, 3, size=n)
    after = rng.integers(0, 2, size=(n, 4))
    rewards = after[:, 0] * 1.0 - 0.5 * (actions == 2)
    return TransitionBatch(states, actions, after, np.zeros(n, dtype=np.bool_), rewards, np.arange(n) // 10)


@pytest.mark.parametrize("cardinalities", [(2, 2, 2), (3, 2, 5)])
@pytest.mark.parametrize("n_out", [1, 4, 6])
def test_compiled_evaluation_is_the_network(cardinalities: tuple[int, ...], n_out: int) -> None:
    rng = np.random.default_rng(0)
    network = DenseReward(FactorCodec(cardinalities, 3), n_out, torch.Generator().manual_seed(0))
    states, after = (np.column_stack([rng.integers(c, size=50) for c in cardinalities]) for _ in range(2))
    actions = rng.integers(3, size=50)
    with torch.inference_mode():
        expected = network(*(torch.from_numpy(part) for part in (states, actions, after))).numpy()
    packed = pack_reward(network)
    found = reward_outputs(packed, states, actions, after)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(reward_outputs(packed, states[7:8], actions[7:8], after[7:8])[0], found[7])


def test_a_function_of_the_transition_is_learned_and_found_right_in_held_out_episodes() -> None:
    model = LearnedReward((2,) * 4, 3)
    report = model.fit(rows(3000))
    assert report.n_values == 4
    assert report.right > 0.99
    assert report.held_out > 0.98
    assert report.contrary == 0.0
    assert report.advice is None
    tests = rows(200, 1)
    np.testing.assert_allclose(model(tests.states, tests.actions, tests.next_states), tests.rewards, atol=0.01)


def test_rewards_that_depend_on_something_unobserved_are_reported() -> None:
    data = rows(4000)
    hidden = np.random.default_rng(5).random(4000) < 0.3
    kept = np.array([1, 0, 0, 0], dtype=np.int64)
    states: NDArray[np.int64] = data.states * kept  # few distinct transitions, so that they recur
    after: NDArray[np.int64] = data.next_states * kept
    report = LearnedReward((2,) * 4, 3).fit(replace(data, before=states, after=after, rewards=data.rewards + hidden))
    assert report.contrary == pytest.approx(0.3, abs=0.03)
    assert report.advice is not None
    assert "depends on something unobserved" in report.advice


def test_both_zeros_are_one_reward() -> None:
    report = LearnedReward((2,) * 4, 3).fit(replace(rows(500), rewards=np.where(np.arange(500) % 2, 0.0, -0.0)))
    assert (report.n_values, report.contrary) == (1, 0.0)


def test_one_reward_needs_no_learning() -> None:
    model = LearnedReward((2,) * 4, 3)
    report = model.fit(replace(rows(50), rewards=np.full(50, -1.0)))
    assert (report.n_values, report.right, report.contrary) == (1, 1.0, 0.0)
    assert np.isnan(report.held_out)
    assert report.advice is None
    assert model(np.zeros((1, 4), int), np.zeros(1, int), np.zeros((1, 4), int))[0] == -1.0


def test_one_cause_is_found_among_very_many_bits_from_few_steps() -> None:
    rng, n = np.random.default_rng(0), 300
    states, after, actions = *rng.integers(2, size=(2, n, 62)), rng.integers(4, size=n)
    ends = np.zeros(n, dtype=np.bool_)
    model = LearnedReward((2,) * 62, 4)
    report = model.fit(TransitionBatch(states, actions, after, ends, (actions == 0) * 1.0, np.arange(n) // 20))
    assert report.right == report.held_out == 1.0
    others = rng.integers(2, size=(2, 40, 62))
    np.testing.assert_array_equal(model(others[0], np.arange(40) % 4, others[1]), np.arange(40) % 4 == 0)


def pictures(n: int, seed: int = 0) -> TransitionBatch:
    """A coin (channel 0) and a player (channel 1) on a 5 by 5 board; the reward in the same cell is 1, or -2 under action 1."""
    rng = np.random.default_rng(seed)
    boards = np.zeros((2, n, 2, 25), dtype=np.int64)
    for board in boards:
        for channel in range(2):
            board[np.arange(n), channel, rng.integers(25, size=n)] = 1
    before, after = boards.reshape(2, n, 50)
    actions = rng.integers(2, size=n)
    together = (after.reshape(n, 2, 25).sum(axis=1) == 2).any(axis=1)
    return TransitionBatch(
        before, actions, after, np.zeros(n, dtype=np.bool_), together * (1.0 - 3.0 * actions), np.arange(n) // 20
    )


def test_on_planes_rewards_for_a_shared_cell_are_found_everywhere() -> None:
    planes = FactoredSpace(spaces.MultiBinary((2, 5, 5))).planes
    model = LearnedReward((2,) * 50, 2, planes)
    assert model.fit(pictures(3000)).right == 1.0
    tests = pictures(500, 1)
    found = model(tests.states, tests.actions, tests.next_states)
    np.testing.assert_array_equal(found, tests.rewards)
    assert model(tests.states[7:8], tests.actions[7:8], tests.next_states[7:8])[0] == found[7]
    other = LearnedReward((2,) * 50, 2, planes)
    weights = model.state_dict()
    other.load_state_dict(weights)
    np.testing.assert_array_equal(other(tests.states, tests.actions, tests.next_states), found)
    far = weights["graphs.columns"].copy()
    far[:, 1] = 99
    for name, array in (
        ("graphs.columns", far),
        ("graphs.first", weights["graphs.first"] + 10_000),
        ("graphs.node", weights["graphs.node"] + 1),
        ("graphs.ways", weights["graphs.ways"][:1]),
        ("graphs.rate", weights["graphs.rate"] + 2.0),
        ("graphs.cells", weights["graphs.cells"][:, :4]),
    ):
        with pytest.raises(ValueError, match="not those of a learned reward"):
            other.load_state_dict({**weights, name: array})


def test_a_reward_that_was_observed_once_is_predicted() -> None:
    data = rows(600)
    once = np.arange(600) == 300
    model = LearnedReward((2,) * 4, 3)
    # the fourth bit is on in that row only
    states, after = data.states.copy(), data.next_states.copy()
    states[:, 3], after[:, 3] = 0, once
    model.fit(replace(data, before=states, after=after, rewards=once * 1.0))
    np.testing.assert_array_equal(model(states, data.actions, after), once)


def test_sums_of_many_factors_are_predicted_by_a_network() -> None:
    rng, n = np.random.default_rng(0), 2000
    states, after = rng.integers(2, size=(2, n, 12))
    ends, actions = np.zeros(n, dtype=np.bool_), rng.integers(2, size=n)
    model = LearnedReward((2,) * 12, 2)
    report = model.fit(TransitionBatch(states, actions, after, ends, after.sum(axis=1) * 1.0, np.arange(n) // 20))
    assert report.held_out > 0.9
    assert not any(name.startswith("graphs.") for name in model.state_dict())


def test_weights_are_restored() -> None:
    model = LearnedReward((2,) * 4, 3)
    data = rows(500)
    model.fit(data)
    other = LearnedReward((2,) * 4, 3, seed=9)
    other.load_state_dict(model.state_dict())
    given = data.states, data.actions, data.next_states
    np.testing.assert_array_equal(model(*given), other(*given))


@pytest.mark.parametrize(("chance", "n_noise"), [(0.08, 0), (0.08, 4), (0.02, 6)])
def test_random_rewards_are_predicted_by_their_mean_whatever_else_varies(chance: float, n_noise: int) -> None:
    rng, n = np.random.default_rng(3), 8000
    position, actions = np.arange(n) % 6, rng.integers(2, size=n)
    before, after = (np.column_stack([p, rng.integers(2, size=(n, n_noise))]) for p in (position, (position + 1) % 6))
    mine = (position == 3) & (actions == 1)
    hit = mine & (rng.random(n) < chance)
    rewards = np.where(hit, -20.0, np.where(mine, 1.0, 0.1))
    data = TransitionBatch(before, actions, after, hit, rewards, np.arange(n) // 50)
    model = LearnedReward((6,) + (2,) * n_noise, 2)
    model.fit(data)
    predicted = model(before, actions, after)
    np.testing.assert_allclose(predicted[mine], rewards[mine].mean(), atol=1e-9)
    np.testing.assert_allclose(predicted[~mine], 0.1, atol=1e-9)


def test_insurance_is_priced_by_the_mean_of_rare_losses_whatever_else_varies() -> None:
    rng, n = np.random.default_rng(0), 12_000
    position, actions, noise = np.arange(n) % 4, rng.integers(2, size=n), rng.integers(2, size=(n + 1, 8))
    before, after = np.column_stack([position, noise[:-1]]), np.column_stack([(position + 1) % 4, noise[1:]])
    u = rng.random(n)
    losses = np.select([u < 0.005, u < 0.009, u < 0.012], [-100.0, -60.0, -40.0], 0.0)
    rewards = np.where(actions == 0, -0.5, losses)
    model = LearnedReward((4,) + (2,) * 8, 2)
    report = model.fit(TransitionBatch(before, actions, after, np.zeros(n, dtype=np.bool_), rewards, np.arange(n) // 50))
    predicted = model(before, actions, after)
    for a in range(2):
        np.testing.assert_allclose(predicted[actions == a], rewards[actions == a].mean(), atol=1e-9)
    assert report.held_out > 0.98
    assert report.advice is None


def test_random_rewards_of_transitions_that_hardly_recur_are_reported() -> None:
    data = rows(4000)
    wide = [
        np.column_stack([part, np.random.default_rng(i).integers(2, size=(4000, 12))])
        for i, part in enumerate((data.before, data.after))
    ]
    lost = np.random.default_rng(5).random(4000) < 0.2
    rewards = np.where(lost, 5.0, data.rewards)
    report = LearnedReward((2,) * 16, 3).fit(replace(data, before=wide[0], after=wide[1], rewards=rewards))
    assert report.contrary == pytest.approx(0.2, abs=0.03)
    assert report.advice is not None
    assert "random" in report.advice
