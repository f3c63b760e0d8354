import numpy as np
import pytest
from scipy.special import comb

from mbagent.models.dbn.leaf_prior import CENTRES, MIXED_STRENGTH, LeafPrior, MixedPrior, best_prior, fitted_prior
from mbagent.models.dbn.score import Search, Target
from mbagent.types import Floats, Ints

EQUAL = MixedPrior(0.1, MIXED_STRENGTH, np.full(len(CENTRES), 1.0 / len(CENTRES)))
UNEQUAL = MixedPrior(0.5, MIXED_STRENGTH, np.arange(1.0, len(CENTRES) + 1) / np.arange(1.0, len(CENTRES) + 1).sum())


def leaves(n: Ints, e: Ints) -> list[Search]:
    """One target whose leaves have these counts."""
    each = np.arange(len(n))
    return [Search(Target(each, n, e, each, each, np.zeros_like(each)))]


def drawn(rates: Floats, n: int, seed: int) -> tuple[Ints, Ints]:
    rows = np.full(len(rates), n)
    return rows, np.random.default_rng([seed, 1]).binomial(rows, rates)


@pytest.mark.parametrize("prior", [LeafPrior(0.3, 1.0), EQUAL, UNEQUAL])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_outcomes_have_probabilities_that_sum_to_one(prior: LeafPrior, n: int) -> None:
    e = np.arange(n + 1)
    total, slab = prior.evidence(np.full(n + 1, n), e, np.full(n + 1, 0.3))
    assert (comb(n, e) * np.exp(total)).sum() == pytest.approx(1.0)
    assert ((slab >= 0.0) & (slab <= 1.0)).all()


def test_rate_is_the_predictive_probability_of_the_next_outcome() -> None:
    """A posterior mean is a ratio of evidences."""
    n, e, prior_mean = np.array([0, 5, 40]), np.array([0, 2, 39]), np.array([0.5, 0.2, 0.9])
    for prior in (LeafPrior(0.3, 1.0), UNEQUAL):
        ratio = np.exp(prior.evidence(n + 1, e + 1, prior_mean)[0] - prior.evidence(n, e, prior_mean)[0])
        np.testing.assert_allclose(prior.rates(n, e, prior_mean), ratio, rtol=1e-6)


def test_equal_weights_are_the_simple_prior() -> None:
    n, e, prior_mean = np.array([3, 10, 200]), np.array([1, 9, 11]), np.array([0.4, 0.8, 0.1])
    simple = LeafPrior(EQUAL.certain, EQUAL.strength)
    np.testing.assert_allclose(EQUAL.rates(n, e, prior_mean), simple.rates(n, e, prior_mean), atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_few_different_rates_are_separated_from_sampling_noise(seed: int) -> None:
    """Leaves of 35 rows whose rates are 0.02 or 0.97; the squared error is at most a quarter of that with the simple prior."""
    rates = np.where(np.random.default_rng(seed).random(500) < 0.5, 0.02, 0.97)
    n, e = drawn(rates, 35, seed)
    found = leaves(n, e)
    prior_mean = found[0].prior_mean
    errors = [np.square(prior.rates(n, e, prior_mean) - rates).mean() for prior in (best_prior(found), fitted_prior(found))]
    assert errors[1] < 0.25 * errors[0]


def test_uniform_rates_are_not_distorted() -> None:
    rates = np.random.default_rng(0).random(500)
    for rows in (5, 50, 5000):
        n, e = drawn(rates, rows, 0)
        found = leaves(n, e)
        simple, fitted = (prior.rates(n, e, found[0].prior_mean) for prior in (best_prior(found), fitted_prior(found)))
        assert np.square(fitted - rates).mean() < 1.05 * np.square(simple - rates).mean()


def test_simple_prior_is_kept_without_clear_evidence() -> None:
    certain = np.arange(200) % 2
    for n, e in (drawn(np.full(8, 0.1), 10, 0), (np.full(200, 30), 30 * certain), (np.zeros(3, int), np.zeros(3, int))):
        assert not isinstance(fitted_prior(leaves(n, e)), MixedPrior)
    assert fitted_prior([]) == best_prior([])
