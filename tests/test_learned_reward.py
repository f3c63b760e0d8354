from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mbagent.learned_reward import LearnedReward
from mbagent.models.networks import FactorCodec
from mbagent.models.reward_kernel import DenseReward, pack_reward, reward_outputs
from mbagent.transitions import TransitionBatch


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


def test_rewards_that_hang_on_something_else_are_reported() -> None:
    data = rows(4000)
    hidden = np.random.default_rng(5).random(4000) < 0.3
    kept = np.array([1, 0, 0, 0], dtype=np.int64)
    states: NDArray[np.int64] = data.states * kept  # few distinct transitions, so that the same ones come back
    after: NDArray[np.int64] = data.next_states * kept
    report = LearnedReward((2,) * 4, 3).fit(replace(data, before=states, after=after, rewards=data.rewards + hidden))
    assert report.contrary == pytest.approx(0.3, abs=0.03)
    assert report.advice is not None
    assert "hangs on what is not observed" in report.advice


def test_one_reward_needs_no_learning() -> None:
    model = LearnedReward((2,) * 4, 3)
    report = model.fit(replace(rows(50), rewards=np.full(50, -1.0)))
    assert (report.n_values, report.right, report.contrary) == (1, 1.0, 0.0)
    assert np.isnan(report.held_out)
    assert report.advice is None
    assert model(np.zeros((1, 4), int), np.zeros(1, int), np.zeros((1, 4), int))[0] == -1.0


def test_weights_come_back() -> None:
    model = LearnedReward((2,) * 4, 3)
    data = rows(500)
    model.fit(data)
    other = LearnedReward((2,) * 4, 3, seed=9)
    other.load_state_dict(model.state_dict())
    given = data.states, data.actions, data.next_states
    np.testing.assert_array_equal(model(*given), other(*given))
