import numpy as np
import pytest

from studies.sampling_accuracy.measures import (
    Distribution,
    counted,
    full_correlation,
    number,
    observed_correlation,
    total_variation,
    union_correlation,
    valid_mass,
)


def dense(distribution: Distribution, d: int) -> np.ndarray:
    """Full table of probabilities [n, 2^d]."""
    table = np.zeros((distribution.n, 2**d))
    table[distribution.inputs, distribution.outcomes.astype(np.int64)] = distribution.probabilities
    return table


def random_distribution(seed: int, n: int = 7, d: int = 4, draws: int = 30) -> Distribution:
    rng = np.random.default_rng(seed)
    outcomes = (rng.random((n, draws)) ** 3 * 2**d).astype(np.uint64)
    return counted(np.repeat(np.arange(n), draws), outcomes.ravel(), np.ones(n * draws), n)


def test_outcomes_are_numbered_by_their_bits() -> None:
    assert number(np.array([[1, 0, 0], [0, 1, 1]])).tolist() == [1, 6]
    assert number(np.ones((1, 64), dtype=np.int64))[0] == np.uint64(2**64 - 1)


def test_draws_are_counted() -> None:
    found = counted(np.array([1, 0, 1, 1]), np.array([5, 2, 5, 3], dtype=np.uint64), np.ones(4), 2)
    assert found.inputs.tolist() == [0, 1, 1]
    assert found.outcomes.tolist() == [2, 3, 5]
    np.testing.assert_allclose(found.probabilities, [1.0, 1 / 3, 2 / 3])


@pytest.mark.parametrize("seed", range(4))
def test_every_measure_is_what_its_definition_says(seed: int) -> None:
    d = 4
    p, q = random_distribution(seed), random_distribution(seed + 100)
    a, b = dense(p, d), dense(q, d)
    union = (a > 0) | (b > 0)
    assert union_correlation(p, q) == pytest.approx(np.corrcoef(a[union], b[union])[0, 1])
    assert observed_correlation(p, q) == pytest.approx(np.corrcoef(a[a > 0], b[a > 0])[0, 1])
    assert full_correlation(p, q, d) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1])
    assert total_variation(p, q) == pytest.approx(0.5 * np.abs(a - b).sum(axis=1).mean())
    assert valid_mass(p, q) == pytest.approx(np.where(a > 0, b, 0.0).sum(axis=1).mean())


def test_mass_that_was_not_listed_counts_as_wrong() -> None:
    p = Distribution(np.array([0, 0]), np.array([1, 2], dtype=np.uint64), np.array([0.5, 0.5]), 1)
    q = Distribution(np.array([0, 0]), np.array([1, 2], dtype=np.uint64), np.array([0.5, 0.3]), 1, complete=False)
    assert total_variation(p, q) == pytest.approx(0.2)
    assert valid_mass(p, q) == pytest.approx(0.8)


def test_a_correlation_without_variation_is_undefined() -> None:
    even = Distribution(np.zeros(2, dtype=np.int64), np.array([0, 1], dtype=np.uint64), np.array([0.5, 0.5]), 1)
    assert np.isnan(union_correlation(even, even))
    assert total_variation(even, even) == 0.0


def test_the_papers_measure_rewards_stray_mass() -> None:
    # A sampler that spreads 2% over many wrong outcomes scores higher than one that is exact except for sampling noise.
    truth = random_distribution(0, n=20, d=10, draws=4)
    noisy = Distribution(truth.inputs, truth.outcomes, truth.probabilities * 0.98, truth.n)
    stray = (np.arange(400) + 1000).astype(np.uint64)
    spread = Distribution(
        np.r_[noisy.inputs, np.repeat(np.arange(20), 20)],
        np.r_[noisy.outcomes, stray],
        np.r_[noisy.probabilities + np.random.default_rng(0).normal(0, 0.1, len(noisy.outcomes)), np.full(400, 0.001)],
        20,
    )
    without = Distribution(spread.inputs[:-400], spread.outcomes[:-400], spread.probabilities[:-400], 20)
    assert union_correlation(truth, spread) > union_correlation(truth, without)
    assert total_variation(truth, spread) > total_variation(truth, without)
