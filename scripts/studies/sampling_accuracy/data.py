"""The paper's generator of observations (section 3.3), with a named option for each ambiguous sentence."""

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
        c: outputs drawn for each input; duplicates are possible.
        correlated: whether the variables of an output depend on each other.
        relates: source of a copied variable (random number r). "previous": the output variable set before it, which makes
            the outputs correlated. "input": the same variable of the input, the literal reading, with which the variables
            of an output are independent given the input. The first is closer to the paper: with it, the predictor alone
            falls from .84 in trial 1a to .77 in 1b (the paper: .80 to .51); with the other it rises to .89.
        shuffle: "output": the order in which variables are set is drawn for every output, the literal reading of step 4b.
            "input": it is drawn once for every input.
        multiplier: the paper's b, "an optional multiplier for reducing large data sets": the share of the d^2 inputs
            that are used. 1 in all trials, since the paper gives no other value.

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
        """Number of inputs in a data set: b d^2, but at most all possible ones."""
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
        """The data as transitions with a single action; every observation counts as an episode."""
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
    """Draws a data set as described in section 3.3."""
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
    outputs = rng.integers(2, size=(n, c, d))  # values of variables that are not copied
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
