import numpy as np
import pytest

from mbagent.models import NeuralConfig, NeuralTransitionModel, Successors
from mbagent.models.neural.sampling import independent_successors
from mbagent.models.systematic_sampling import NEGLIGIBLE, start, thin
from mbagent.types import Floats, Ints
from tests.models.helpers import MIXED, distribution, outcome_numbers, outcomes, random_rows, scrambled

CONFIGS = [NeuralConfig(hidden=(8,), group_size=4, conditioner=mask) for mask in ("causal", None)]


def rows_of(found: Successors, cardinalities: tuple[int, ...] = MIXED) -> list[dict[int, float]]:
    """Each row's outcomes, by number, with their probabilities."""
    numbers = outcome_numbers(cardinalities, found.states, found.terminated)
    spans = zip(found.offsets[:-1], found.offsets[1:], strict=True)
    result = [dict(zip(numbers[a:b].tolist(), found.probabilities[a:b].tolist(), strict=True)) for a, b in spans]
    assert sum(map(len, result)) == len(numbers)  # no outcome twice
    return result


def conditionals(model: NeuralTransitionModel, states: Ints, actions: Ints) -> list[Floats]:
    """P(y_i | y_<i) of each row by brute force: [B, *outputs up to i] for each factor i."""
    outputs = (*model.cardinalities, 2)
    joint = np.stack([distribution(model, s, int(a)).reshape(outputs) for s, a in zip(states, actions, strict=True)])
    result = []
    for i in range(len(outputs)):
        prefix = joint.sum(axis=tuple(range(i + 2, len(outputs) + 1)))
        result.append(prefix / prefix.sum(axis=-1, keepdims=True))
    return result


def pruned_distribution(tables: list[Floats], row: int) -> Floats:
    """The joint distribution after negligible conditional probabilities are dropped."""
    joint: Floats = np.ones(())
    for table in tables:
        p = table[row]
        p = np.where(p < NEGLIGIBLE * p.max(axis=-1, keepdims=True), 0.0, p)
        joint = joint[..., None] * (p / p.sum(axis=-1, keepdims=True))
    return joint.ravel()


@pytest.mark.parametrize("config", CONFIGS)
def test_with_many_points_every_outcome_is_listed_with_its_exact_probability(config: NeuralConfig) -> None:
    model = scrambled(config=config)
    states, actions = random_rows(MIXED, 3, 5)
    tables = conditionals(model, states, actions)
    for row, found in enumerate(rows_of(model.successors(states, actions, 100_000, seed=1))):
        exact = pruned_distribution(tables, row)
        assert sum(found.values()) == pytest.approx(1.0, abs=1e-12)
        assert exact[list(found)].sum() > 0.999
        assert found == pytest.approx({k: exact[k] / exact[list(found)].sum() for k in found}, abs=1e-6)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("n", [1, 5, 16])
def test_with_few_points_likely_outcomes_are_never_missed_and_shares_are_right_on_average(config: NeuralConfig, n: int) -> None:
    model = scrambled(config=config)
    states, actions = random_rows(MIXED, 3, 4)
    tables, total = conditionals(model, states, actions), np.zeros((4, 2 * int(np.prod(MIXED))))
    n_seeds = 600
    for seed in range(n_seeds):
        for row, found in enumerate(rows_of(model.successors(states, actions, n, seed))):
            exact = pruned_distribution(tables, row)
            assert len(found) <= 2 * n
            assert sum(found.values()) == pytest.approx(1.0)
            assert set(np.flatnonzero(exact >= 2 / n)) <= set(found)
            if np.isin(np.flatnonzero(exact), list(found)).all():
                assert found == pytest.approx({k: exact[k] for k in found}, abs=1e-5)
            total[row, list(found)] += list(found.values())
    for row in range(4):
        assert np.abs(total[row] / n_seeds - pruned_distribution(tables, row)).sum() < 3.0 / np.sqrt(n_seeds * n) * 4


def product(probs: Floats) -> Floats:
    """The joint distribution of independent variables [O, 2]."""
    joint: Floats = np.ones(())
    for values in probs:
        joint = joint[..., None] * values
    return joint.ravel()


def test_few_outcomes_are_all_listed_with_exact_probabilities() -> None:
    probs = np.array([[0.985, 0.015], [0.5, 0.5], [0.02, 0.98], [1.0, 0.0]])
    for seed in range(20):
        (found,) = rows_of(independent_successors(probs[None], np.full(4, 2), 8, seed), (2, 2, 2))
        exact = product(probs)
        assert found == pytest.approx({k: exact[k] for k in np.flatnonzero(exact)}, abs=1e-12)


@pytest.mark.parametrize("n", [3, 4, 16])
def test_every_rare_value_has_its_exact_probability(n: int) -> None:
    rare = np.array([0.012, 0.03])  # above the threshold for noise of a network
    probs = np.array([[0.5, 0.5]] * 6 + [[1.0 - p, p] for p in rare] + [[0.5, 0.5]] * 2)
    total, n_seeds = np.zeros(2**10), 2000
    for seed in range(n_seeds):
        (found,) = rows_of(independent_successors(probs[None], np.full(10, 2), n, seed), (2,) * 9)
        numbers, weights = np.array(list(found)), np.array(list(found.values()))
        assert weights.sum() == pytest.approx(1.0)
        bits = numbers[:, None] >> np.arange(9, -1, -1) & 1
        assert weights[bits[:, 6] == 1].sum() == pytest.approx(rare[0])
        # the part of the second that coincides with the first is sampled
        assert weights[(bits[:, 7] == 1) & (bits[:, 6] == 0)].sum() == pytest.approx(rare[1] * (1.0 - rare[0]))
        total[numbers] += weights
    exact = product(probs)
    assert np.abs(total / n_seeds - exact).sum() < 4.0 * np.sqrt(2**8 / (n_seeds * n))
    assert total[(np.arange(2**10) >> 2 & 3) == 3].sum() / n_seeds == pytest.approx(rare.prod(), rel=1.0)


def test_excess_strata_are_merged_without_bias_except_termination() -> None:
    rates, end = np.linspace(0.011, 0.02, 40), 0.0105
    probs = np.array([[1.0 - p, p] for p in (*rates, end)])
    total, n_seeds, n = np.zeros(40), 4000, 8
    for seed in range(n_seeds):
        found = independent_successors(probs[None], np.full(41, 2), n, seed)
        assert len(found.probabilities) <= 2 * n
        assert found.probabilities.sum() == pytest.approx(1.0)
        assert found.probabilities[found.terminated].sum() >= end * (1.0 - rates).prod() * 0.999
        total += found.probabilities @ found.states
    # each variable is sampled about n / 40 times as often as required for its exact mean
    assert total / n_seeds == pytest.approx(rates, rel=0.25)


def test_many_equally_unlikely_values_get_no_strata() -> None:
    probs = np.full((1, 1, 100), 0.0099)
    probs[0, 0, 99] = 1.0 - 0.0099 * 99
    found = independent_successors(np.concatenate([probs, np.eye(100)[:1][None]], axis=1), np.array([100, 2]), 16, seed=0)
    assert len(found.probabilities) == 16
    assert found.probabilities == pytest.approx(np.full(16, 1 / 16))


def test_many_fair_bits_do_not_run_out_of_precision() -> None:
    n, n_bits = 16, 200
    found = independent_successors(np.full((3, n_bits, 2), 0.5), np.full(n_bits, 2), n, seed=2)
    assert np.array_equal(np.diff(found.offsets), [n] * 3)
    assert found.probabilities == pytest.approx(np.full(3 * n, 1 / n))
    first, second = found.states[:n], found.states[n : 2 * n]
    assert np.array_equal(first, second)  # random numbers shared by all rows
    assert first[:, :4].sum() == n * 4 / 2  # the first log2(n) bits are stratified
    assert first[:, 4:].mean() == pytest.approx(0.5, abs=0.05)  # the others use new random numbers,
    differing = (first[:, None, 4:] != first[None, :, 4:]).mean(axis=2)[np.triu_indices(n, 1)]
    assert (np.abs(differing - 0.5) < 0.15).all()  # different for each point


def test_settled_factors_and_tiny_probabilities_need_no_samples() -> None:
    probs = np.tile([0.995, 0.005], (1, 300, 1))
    found = independent_successors(probs, np.full(300, 2), 16, seed=0)
    assert len(found.states) == 1
    assert not found.states.any()
    assert found.probabilities == pytest.approx([1.0])


def test_no_rows_no_successors() -> None:
    found = scrambled().successors(*random_rows(MIXED, 3, 0), 16, seed=0)
    assert found.offsets.tolist() == [0]
    assert found.states.shape == (0, len(MIXED))


def test_large_requests_are_processed_in_parts() -> None:
    model = scrambled((2, 2), 2)
    states, actions = random_rows((2, 2), 2, 5000)
    found = model.successors(states, actions, 8, seed=0)
    for part in (slice(0, 1), slice(4999, 5000), slice(2047, 2049)):
        few, span = model.successors(states[part], actions[part], 8, seed=0), slice(*found.offsets[[part.start, part.stop]])
        assert np.array_equal(few.states, found.states[span])
        assert np.array_equal(few.probabilities, found.probabilities[span])


def test_offsets_of_seeds_are_spread_evenly() -> None:
    offsets = np.sort([start(seed)[1] for seed in range(400)])
    assert np.abs(offsets - (np.arange(400) + 0.5) / 400).max() < 0.09


def test_long_lists_are_resampled_and_short_ones_kept() -> None:
    rng = np.random.default_rng(0)
    following, ends = outcomes((5, 5))
    long, short = rng.dirichlet(np.ones(50)), np.array([0.25, 0.75])
    full = Successors(
        np.array([0, 50, 52, 102]),
        np.concatenate([following, following[:2], following]),
        np.concatenate([ends, ends[:2], ends]),
        np.concatenate([long, short, long]),
    )
    total = np.zeros(50)
    for seed in range(300):
        rows = rows_of(thin(full, 24, seed), (5, 5))
        assert rows[1] == {0: 0.25, 1: 0.75}
        assert rows[0] == rows[2]
        assert len(rows[0]) <= 48
        assert sum(rows[0].values()) == pytest.approx(1.0)
        assert set(np.flatnonzero(long >= 2 / 24)) <= set(rows[0])
        total[list(rows[0])] += list(rows[0].values())
    assert np.abs(total / 300 - long).max() < 0.01
    assert thin(full, 50, 0) is full


def test_resampled_lists_keep_rare_outcomes_and_every_termination() -> None:
    rare, n = np.array([0.0007, 0.0003]), 60
    usual = np.full(n, (1.0 - rare.sum()) / n)
    states, probabilities = np.arange(n + 2)[:, None], np.concatenate([usual, rare])
    full = Successors(np.array([0, n + 2]), states, np.arange(n + 2) == n + 1, probabilities)
    for seed in range(50):
        found = thin(full, 4, seed)
        weight = dict(zip(found.states[:, 0].tolist(), found.probabilities.tolist(), strict=True))
        assert weight[n] == pytest.approx(rare[0])
        assert weight[n + 1] == pytest.approx(rare[1])
        assert found.terminated[found.states[:, 0] == n + 1].all()
        assert sum(weight.values()) == pytest.approx(1.0)
