import numpy as np
import pytest
import torch

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.protocol import TransitionModel
from mbagent_envs.random_keys import derive
from studies.sampling_accuracy.boltzmann import BoltzmannConfig, ConditionalBoltzmannMachine

SMALL = BoltzmannConfig(hidden=6, min_steps=400, max_steps=400)


def coupled(n: int = 400, seed: int = 0) -> TransitionDataset:
    """Two bits, equal if the state's first bit is 1, else different, and a factor of three values, which is their sum."""
    rng = np.random.default_rng(seed)
    data = TransitionDataset((2, 2, 3), 2)
    states = np.stack([rng.integers(2, size=n), rng.integers(2, size=n), rng.integers(3, size=n)], axis=1)
    first = rng.integers(2, size=n)
    second = np.where(states[:, 0] == 1, first, 1 - first)
    following = np.stack([first, second, first + second], axis=1)
    nothing = np.zeros(n)
    ended = (first + second == 2) & (states[:, 0] == 1)
    data.append(TransitionBatch(states, rng.integers(2, size=n), following, ended, nothing, np.arange(n)))
    return data


@pytest.fixture(scope="module")
def fitted() -> ConditionalBoltzmannMachine:
    model = ConditionalBoltzmannMachine((2, 2, 3), 2, BoltzmannConfig(hidden=16, min_steps=1500, max_steps=1500))
    model.fit(coupled())
    return model


def test_it_is_a_transition_model(fitted: ConditionalBoltzmannMachine) -> None:
    assert isinstance(fitted, TransitionModel)


def test_probabilities_sum_to_one_over_all_outcomes() -> None:
    model = ConditionalBoltzmannMachine((2, 2, 3), 2, SMALL, seed=3)
    grid = np.array(list(np.ndindex(2, 2, 3, 2)))
    states, actions = np.tile([[1, 0, 2]], (len(grid), 1)), np.ones(len(grid), dtype=np.int64)
    logs = model.log_prob(states, actions, grid[:, :3], grid[:, 3] == 1)
    assert np.exp(logs).sum() == pytest.approx(1.0)


def test_draws_follow_the_exact_probabilities(fitted: ConditionalBoltzmannMachine) -> None:
    n = 20_000
    state, action = np.array([[1, 0, 2]]), np.array([1])
    drawn, ended = fitted.sample(np.repeat(state, n, axis=0), np.repeat(action, n), derive(7, np.arange(n)))
    grid = np.array(list(np.ndindex(2, 2, 3, 2)))
    logs = fitted.log_prob(np.repeat(state, 24, axis=0), np.repeat(action, 24), grid[:, :3], grid[:, 3] == 1)
    place = np.ravel_multi_index((*drawn.T, ended.astype(np.int64)), (2, 2, 3, 2))
    frequencies = np.bincount(place, minlength=24) / n
    assert 0.5 * np.abs(frequencies - np.exp(logs)).sum() < 0.03


def test_it_learns_dependencies_between_variables(fitted: ConditionalBoltzmannMachine) -> None:
    rows = coupled(seed=1).rows()
    logs = fitted.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated)
    assert -logs.mean() == pytest.approx(np.log(2.0), abs=0.05)  # the entropy of one fair coin
    marginals = fitted.marginals(rows.states, rows.actions)
    assert marginals.shape == (len(rows), 7)
    np.testing.assert_allclose(marginals[:, :2].mean(axis=0), 0.5, atol=0.05)


def test_no_row_depends_on_its_batch(fitted: ConditionalBoltzmannMachine) -> None:
    rows, keys = coupled(seed=2).rows().select(np.arange(30)), derive(1, np.arange(30))
    together, ended = fitted.sample(rows.states, rows.actions, keys)
    for i in (0, 13, 29):
        alone, end = fitted.sample(rows.states[i : i + 1], rows.actions[i : i + 1], keys[i : i + 1])
        assert (alone[0].tolist(), bool(end[0])) == (together[i].tolist(), bool(ended[i]))


def test_contrastive_divergence_learns_too() -> None:
    model = ConditionalBoltzmannMachine((2, 2, 3), 2, BoltzmannConfig(hidden=16, exact=False, min_steps=1500, max_steps=1500))
    model.fit(coupled())
    rows = coupled(seed=1).rows()
    assert -model.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated).mean() < 1.2


def test_weights_can_be_copied_and_wrong_ones_are_refused() -> None:
    model, other = (ConditionalBoltzmannMachine((2, 2, 3), 2, SMALL, seed=seed) for seed in (0, 1))
    other.load_state_dict(model.state_dict())
    for name, value in model.state_dict().items():
        np.testing.assert_array_equal(value, other.state_dict()[name])
    with pytest.raises(ValueError, match="build it with the same size"):
        other.load_state_dict({**model.state_dict(), "b": np.zeros(3, dtype=np.float32)})


def test_too_many_outcomes_have_no_exact_probabilities() -> None:
    model = ConditionalBoltzmannMachine((2,) * 20, 1, SMALL)
    nothing = np.zeros((1, 20), dtype=np.int64)
    with pytest.raises(NotImplementedError, match="no exact probabilities"):
        model.log_prob(nothing, np.zeros(1, dtype=np.int64), nothing, np.zeros(1, dtype=np.bool_))


def test_the_process_wide_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    ConditionalBoltzmannMachine((2, 2, 3), 2, SMALL).fit(coupled(50))
    assert torch.equal(before, torch.get_rng_state())
