"""The paper's generator of observations (section 3.3), with a named option for every sentence that can be read in two ways."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset

Bits = NDArray[np.int64]

MAX_VARIABLES = 64
"""Outcomes are numbered in 64-bit words."""


@dataclass(frozen=True)
class DataOptions:
    """Parameters of the generator.

    Attributes:
        d: number of variables of an input, and of an output.
        c: outputs drawn for each input; equal ones may come up.
        correlated: whether the variables of an output depend on each other.
        relates: what a variable copies when r says so. "previous": the output variable set before it, which is what
            makes outputs correlated among themselves. "input": the same variable of the input, the sentence as it stands;
            given the input, the variables of an output are then independent. The first is nearer to the paper: a predictor
            alone falls from .84 in trial 1a to .77 in 1b with it (the paper: .80 to .51), and rises to .89 with the other.
        shuffle: "output": the order in which variables are set is drawn anew for every output, as step 4b reads.
            "input": once for every input.
        multiplier: the paper's b, "an optional multiplier for reducing large data sets": the share of the d^2 inputs
            that is used. 1 everywhere, since the paper names no other value.

    Raises:
        ValueError: a parameter is out of range.
    """

    d: int
    c: int
    correlated: bool = True
    relates: Literal["previous", "input"] = "previous"
    shuffle: Literal["output", "input"] = "output"
    multiplier: float = 1.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        if not 1 <= self.d <= MAX_VARIABLES:
            raise ValueError(f"d must lie between 1 and {MAX_VARIABLES} variables, got {self.d}.")
        if self.c < 1:
            raise ValueError(f"c must be at least 1 output for each input, got {self.c}.")
        if not 0.0 < self.multiplier <= 1.0:
            raise ValueError(f"The multiplier b must lie above 0 and not above 1, got {self.multiplier:g}.")

    @property
    def n_inputs(self) -> int:
        """Inputs in a data set: b d^2, but not more than there are."""
        wanted = max(1, round(self.multiplier * self.d**2))
        return wanted if self.d > 12 else min(wanted, 2**self.d)


@dataclass(frozen=True)
class Observations:
    """A data set.

    Attributes:
        inputs: int64 [N, d], distinct.
        outputs: int64 [N, c, d].
    """

    inputs: Bits
    outputs: Bits

    @property
    def d(self) -> int:
        """Number of variables."""
        return int(self.inputs.shape[1])

    def dataset(self) -> TransitionDataset:
        """The same as transitions with a single action; every observation counts as an episode."""
        n, c, d = self.outputs.shape
        data = TransitionDataset((2,) * d, 1)
        nothing = np.zeros(n * c, dtype=np.int64)
        data.append(
            TransitionBatch(
                before=np.repeat(self.inputs, c, axis=0),
                actions=nothing,
                after=self.outputs.reshape(n * c, d),
                terminated=nothing.astype(np.bool_),
                rewards=nothing.astype(np.float64),
                episodes=np.arange(n * c),
            )
        )
        return data


def generate(options: DataOptions, seed: int) -> Observations:
    """Draws a data set as section 3.3 describes."""
    rng = np.random.default_rng([seed, options.d, options.c, int(options.correlated)])
    inputs = _inputs(options, rng)
    n, d, c = options.n_inputs, options.d, options.c
    if not options.correlated:
        return Observations(inputs, rng.integers(2, size=(n, c, d)))
    matrix = np.triu(rng.uniform(-1.0, 1.0, size=(n, d, d)), 1)
    matrix += matrix.transpose(0, 2, 1)
    per_input = options.shuffle == "input"
    order = rng.permuted(np.tile(np.arange(d), (n, 1 if per_input else c, 1)), axis=2)
    order = np.broadcast_to(order, (n, c, d))
    outputs = rng.integers(2, size=(n, c, d))  # what a variable is when nothing is copied
    row, draw = np.arange(n)[:, None], np.arange(c)[None, :]
    for k in range(1, d):
        here, before = order[:, :, k], order[:, :, k - 1]
        r = matrix[row, here, before]
        source = outputs[row, draw, before] if options.relates == "previous" else inputs[row, here]
        copied = np.where(r > 0.0, source, 1 - source)
        copies = rng.random((n, c)) < np.abs(r)
        outputs[row, draw, here] = np.where(copies, copied, outputs[row, draw, here])
    return Observations(inputs, outputs)


def _inputs(options: DataOptions, rng: np.random.Generator) -> Bits:
    """Distinct random inputs [N, d]."""
    n, d = options.n_inputs, options.d
    if d <= 12:  # few enough to list and shuffle
        chosen = rng.permutation(2**d)[:n]
        return (chosen[:, None] >> np.arange(d)) & 1
    rows: Bits = rng.integers(2, size=(n, d))
    while len(distinct := np.unique(rows, axis=0)) < n:
        rows = np.concatenate([distinct, rng.integers(2, size=(n - len(distinct), d))])
    return distinct[rng.permutation(n)]
