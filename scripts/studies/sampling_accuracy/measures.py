"""Distance of a sampler's distribution from the observed one: the paper's correlation, and measures without its flaws.

All measures are over inputs X and outcomes Y. The paper's own measure, Pearson's correlation over the outcomes
that were observed or generated, favours samplers that spread a little mass over many wrong outcomes (which add
points near the origin), and is undefined if all probabilities are equal; total variation has neither flaw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbagent.types import Floats


@dataclass(frozen=True)
class Distribution:
    """Probabilities of outcomes, for several inputs.

    Attributes:
        inputs: number of each entry's input, 0 ... n - 1, int64 [M].
        outcomes: number of each entry's outcome (bit k is variable k), uint64 [M]; pairs (input, outcome) are distinct.
        probabilities: float64 [M], above zero.
        n: number of inputs.
        complete: whether outcomes that are not listed have probability zero; if False, theirs are unknown.
    """

    inputs: NDArray[np.int64]
    outcomes: NDArray[np.uint64]
    probabilities: Floats
    n: int
    complete: bool = True


def number(bits: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Number of each outcome, uint64 [...], from bits [..., d]."""
    weights = np.uint64(1) << np.arange(bits.shape[-1], dtype=np.uint64)
    result: NDArray[np.uint64] = (bits.astype(np.uint64) * weights).sum(axis=-1, dtype=np.uint64)
    return result


def counted(inputs: NDArray[np.int64], outcomes: NDArray[np.uint64], weights: Floats, n: int) -> Distribution:
    """The distribution of samples: weights [M] of equal (input, outcome) are added and normalised for each input."""
    order = np.lexsort((outcomes, inputs))
    inputs, outcomes, weights = inputs[order], outcomes[order], weights[order]
    new = np.r_[True, (inputs[1:] != inputs[:-1]) | (outcomes[1:] != outcomes[:-1])]
    mass = np.bincount(np.cumsum(new) - 1, weights=weights)
    totals = np.bincount(inputs, weights=weights, minlength=n)
    return Distribution(inputs[new], outcomes[new], mass / totals[inputs[new]], n)


def align(observed: Distribution, other: Distribution) -> tuple[Floats, Floats]:
    """Probabilities (p, q) of every (input, outcome) in either distribution; 0 if one does not list it."""
    inputs = np.concatenate([observed.inputs, other.inputs])
    outcomes = np.concatenate([observed.outcomes, other.outcomes])
    first = np.arange(len(inputs)) < len(observed.inputs)
    order = np.lexsort((outcomes, inputs))
    new = np.r_[True, (inputs[order][1:] != inputs[order][:-1]) | (outcomes[order][1:] != outcomes[order][:-1])]
    entry = np.empty(len(order), dtype=np.int64)
    entry[order] = np.cumsum(new) - 1
    p, q = np.zeros((2, int(new.sum())))
    p[entry[first]], q[entry[~first]] = observed.probabilities, other.probabilities
    return p, q


def correlation(p: Floats, q: Floats) -> float:
    """Pearson's correlation; NaN if one side is constant."""
    if len(p) < 2 or np.ptp(p) < 1e-12 or np.ptp(q) < 1e-12:
        return float("nan")
    return float(np.corrcoef(p, q)[0, 1])


def union_correlation(observed: Distribution, generated: Distribution) -> float:
    """The paper's measure: Pearson over the outcomes observed or generated."""
    return correlation(*align(observed, generated))


def observed_correlation(observed: Distribution, generated: Distribution) -> float:
    """Pearson over the outcomes observed only, another reading of the paper's sentence."""
    p, q = align(observed, generated)
    return correlation(p[p > 0.0], q[p > 0.0])


def full_correlation(observed: Distribution, generated: Distribution, d: int) -> float:
    """Pearson over all n 2^d pairs of input and outcome."""
    p, q = align(observed, generated)
    rest = observed.n * 2**d - len(p)
    # Pairs in neither list are (0, 0) and do not need to be enumerated for the sums.
    n = len(p) + rest
    mean_p, mean_q = p.sum() / n, q.sum() / n
    spread_p, spread_q = (p**2).sum() / n - mean_p**2, (q**2).sum() / n - mean_q**2
    if min(spread_p, spread_q) < 1e-15:
        return float("nan")
    return float(((p * q).sum() / n - mean_p * mean_q) / np.sqrt(spread_p * spread_q))


def total_variation(observed: Distribution, generated: Distribution) -> float:
    """Half the summed absolute difference, mean over inputs; mass missing in ``generated`` is on other outcomes."""
    p, q = align(observed, generated)
    unlisted = 0.0 if generated.complete else generated.n - float(q.sum())
    return float((np.abs(p - q).sum() + unlisted) / (2 * observed.n))


def valid_mass(observed: Distribution, generated: Distribution) -> float:
    """Generated mass on outcomes that were observed, mean over inputs."""
    p, q = align(observed, generated)
    return float(q[p > 0.0].sum() / observed.n)
