"""Spike-and-slab priors for leaf rates (Mitchell and Beauchamp 1988), estimated from all leaves (empirical Bayes)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mbagent.models.dbn.score import Search
from mbagent.types import Floats, Ints

CERTAIN_RATE = 0.02
"""Minimum distance of prior means from 0 and 1."""

WIDTH = 0.25
"""Logits from one component of a mixture to the next, and each one's standard deviation."""

CENTRES: Floats = np.array([1.0 / (1.0 + math.exp(-logit)) for logit in np.arange(-9.5, 9.5 + WIDTH, WIDTH)])
"""Mean rates of the components, which are Beta distributions."""

UP, DOWN = 1.0 / WIDTH**2 / (1.0 - CENTRES), 1.0 / WIDTH**2 / CENTRES
"""Parameters of the components."""

MIXED_STRENGTH = 0.3
"""Rows that the prior mean counts for in addition to a mixture."""

EM_STEPS = 60
"""Rounds of expectation and maximisation."""

LEAST_RATE = 1e-8
"""Minimum weight of a component of a mixture, so that no rate is impossible."""

MOST_LEAVES = 20_000
"""Maximum number of leaves that a mixture is fitted to; of more, an evenly spaced subset is used."""

WORTHWHILE = 40.0
"""Log evidence, in nats, by which a fitted mixture must exceed the best simple prior, since its weights are free parameters."""


@dataclass(frozen=True)
class LeafPrior:
    """Prior of a leaf's rate: point masses at 0 and 1 (the spike), and a Beta distribution around the prior mean (the slab).

    Attributes:
        certain: prior probability that the leaf is deterministic (the spike).
        strength: number of rows that the prior mean counts for in the slab.
    """

    certain: float
    strength: float

    def evidence(self, n: Ints, e: Ints, prior_mean: Floats) -> tuple[Floats, Floats]:
        """Log-probability of a sequence of ``n`` rows with ``e`` positives, and the posterior probability of the slab."""
        return _with_spike(self._slab(n, e, prior_mean)[0], self.certain, n, e, prior_mean)

    def rates(self, n: Ints, e: Ints, prior_mean: Floats) -> Floats:
        """Posterior mean rate."""
        prior_mean = prior_mean.clip(CERTAIN_RATE, 1.0 - CERTAIN_RATE)
        rows, mean = self._slab(n, e, prior_mean)
        _, slab = _with_spike(rows, self.certain, n, e, prior_mean)
        spike = np.where(n == 0, prior_mean, (e == n) * 1.0)
        result: Floats = slab * mean + (1.0 - slab) * spike
        return result

    def _slab(self, n: Ints, e: Ints, prior_mean: Floats) -> tuple[Floats, Floats]:
        """Log-probability of the rows, and posterior mean rate, both under the slab."""
        up, down = self.strength * prior_mean, self.strength * (1.0 - prior_mean)
        return scipy.special.betaln(up + e, down + n - e) - scipy.special.betaln(up, down), (e + up) / (n + self.strength)


@dataclass(frozen=True)
class MixedPrior(LeafPrior):
    """A prior whose slab is fitted to the rates of all leaves, since many environments have only a few distinct rates.

    The slab is the maximum-likelihood mixture of narrow Beta distributions (after Kiefer and Wolfowitz 1956, and Laird 1978); in
    addition, the prior mean counts for ``strength`` rows. With equal weights, it is close to a simple prior.

    Attributes:
        weights: weight of each component, [K]; see CENTRES.
    """

    weights: Floats

    def _slab(self, n: Ints, e: Ints, prior_mean: Floats) -> tuple[Floats, Floats]:
        before = scipy.special.logsumexp(_likelihoods(0 * n, 0 * e, prior_mean, self.strength), axis=1, b=self.weights)
        after = _likelihoods(n, e, prior_mean, self.strength) + np.log(self.weights)
        total = scipy.special.logsumexp(after, axis=1)
        counted = (n + self.strength)[:, None]
        means = (UP + e[:, None] + self.strength * prior_mean[:, None]) / (UP + DOWN + counted)
        return total - before, (np.exp(after - total[:, None]) * means).sum(axis=1)


def best_prior(searches: Sequence[Search]) -> LeafPrior:
    """The prior in ``PRIORS`` under which the leaves have the highest evidence."""
    return _best_of(PRIORS, *_leaves(searches))


def fitted_prior(searches: Sequence[Search]) -> LeafPrior:
    """A mixture fitted to the leaves if its evidence is clearly higher; otherwise the result of ``best_prior``."""
    n, e, prior_mean = _leaves(searches)
    simple, observed = _best_of(PRIORS, n, e, prior_mean), np.flatnonzero(n)
    if len(observed) == 0:
        return simple
    some = observed[np.linspace(0, len(observed) - 1, min(len(observed), MOST_LEAVES)).astype(np.int64)]
    leaves = n[some], e[some], prior_mean[some]
    mixed = _mixture(simple.certain, *leaves)
    gain = float((mixed.evidence(*leaves)[0] - simple.evidence(*leaves)[0]).sum())
    return mixed if gain > WORTHWHILE else simple


def _leaves(searches: Sequence[Search]) -> tuple[Ints, Ints, Floats]:
    """Counts of rows and positives, and prior mean, of each leaf."""
    counts = [search.counts() for search in searches]
    nothing = np.zeros(0, dtype=np.int64)
    n, e = (np.concatenate([nothing, *(pair[i] for pair in counts)]) for i in (0, 1))
    return n, e, np.concatenate([np.zeros(0), *(search.prior_mean for search in searches)]).clip(CERTAIN_RATE, 1.0 - CERTAIN_RATE)


def _best_of(priors: Sequence[LeafPrior], n: Ints, e: Ints, prior_mean: Floats) -> LeafPrior:
    return max(priors, key=lambda prior: float(prior.evidence(n, e, prior_mean)[0].sum()))


def _with_spike(slab: Floats, certain: float, n: Ints, e: Ints, prior_mean: Floats) -> tuple[Floats, Floats]:
    """Evidence of each leaf, and the slab's posterior probability; ``slab`` is the evidence under the slab alone."""
    slab = slab + np.log1p(-certain)
    with np.errstate(divide="ignore"):
        spike = np.log(certain * ((e == 0) * (1.0 - prior_mean) + (e == n) * prior_mean))
    total = np.logaddexp(slab, spike)
    return total, np.exp(slab - total)


def _likelihoods(n: Ints, e: Ints, prior_mean: Floats, strength: float) -> Floats:
    """Log-probability [N, K] of each leaf's rows, plus the pseudo-counts of the prior mean, under each component."""
    up, down = e + strength * prior_mean, n - e + strength * (1.0 - prior_mean)
    result: Floats = scipy.special.betaln(UP + up[:, None], DOWN + down[:, None]) - scipy.special.betaln(UP, DOWN)
    return result


def _mixture(certain: float, n: Ints, e: Ints, prior_mean: Floats) -> MixedPrior:
    """The maximum-likelihood mixture, by EM, starting from equal weights and from the ``certain`` of a simple prior."""
    rows, before = (_likelihoods(k * n, k * e, prior_mean, MIXED_STRENGTH) for k in (1, 0))
    top = rows.max(axis=1)
    rows, before, weights = np.exp(rows - top[:, None]), np.exp(before), np.full(len(CENTRES), 1.0 / len(CENTRES))
    for _ in range(EM_STEPS):
        after, given = rows @ weights, before @ weights
        slab = _with_spike(np.log(after / given) + top, certain, n, e, prior_mean)[1]
        weights *= ((slab / after) @ rows) / np.maximum((slab / given) @ before, LEAST_RATE)
        weights = np.maximum(weights / weights.sum(), LEAST_RATE)
        certain = float(1.0 - slab.mean().clip(LEAST_RATE, 1.0 - LEAST_RATE))
    return MixedPrior(certain, MIXED_STRENGTH, weights / weights.sum())


PRIORS = tuple(
    LeafPrior(certain, strength) for certain in (0.1, 0.5, 0.8, 0.9, 0.99, 0.999, 0.9999) for strength in (0.3, 1.0, 3.0, 10.0)
)
"""Simple priors to choose from."""
