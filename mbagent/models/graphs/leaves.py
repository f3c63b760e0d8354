"""Rates of leaves, where some things are random and others certain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from mbagent.models.graphs.evidence import Floats, Ints
from mbagent.models.graphs.search import Search

SURE = 0.02
"""Typical rates are taken to lie this far from 0 and 1 at least."""


class LeafPrior(NamedTuple):
    """What is believed of a leaf's rate before its rows are seen: a spike at 0 and 1, and a slab around the typical rate.

    Attributes:
        certain: probability that nothing about the leaf is random.
        strength: rows that the typical rate counts for otherwise.
    """

    certain: float
    strength: float

    def evidence(self, n: Ints, e: Ints, typical: Floats) -> tuple[Floats, Floats]:
        """Log-probability of ``e`` of ``n`` rows, in their order, and the posterior probability of the slab."""
        up, down = self.strength * typical, self.strength * (1.0 - typical)
        slab = special.betaln(up + e, down + n - e) - special.betaln(up, down) + np.log1p(-self.certain)
        with np.errstate(divide="ignore"):
            spike = np.log(self.certain * ((e == 0) * (1.0 - typical) + ((e == n) & (n > 0)) * typical))
        total = np.logaddexp(slab, spike)
        return total, np.exp(slab - total)

    def rates(self, n: Ints, e: Ints, typical: Floats) -> Floats:
        """Posterior mean rate."""
        typical = typical.clip(SURE, 1.0 - SURE)
        _, slab = self.evidence(n, e, typical)
        spike = np.where(n == 0, typical, (e == n) * 1.0)
        result: Floats = slab * (e + self.strength * typical) / (n + self.strength) + (1.0 - slab) * spike
        return result


def best_prior(searches: Sequence[Search]) -> LeafPrior:
    """The prior under which the leaves found are likeliest."""
    counts = [search.counts() for search in searches]
    if not counts:
        return PRIORS[0]
    n, e = (np.concatenate([pair[i] for pair in counts]) for i in (0, 1))
    typical = np.concatenate([search.typical for search in searches]).clip(SURE, 1.0 - SURE)
    return max(PRIORS, key=lambda prior: float(prior.evidence(n, e, typical)[0].sum()))


PRIORS = tuple(
    LeafPrior(certain, strength) for certain in (0.1, 0.5, 0.8, 0.9, 0.99, 0.999, 0.9999) for strength in (0.3, 1.0, 3.0, 10.0)
)
"""Priors of leaves to choose from."""
