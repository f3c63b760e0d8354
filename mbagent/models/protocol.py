"""The protocol of transition models (paper section 2), and the report of a fit.

"A sufficient condition to say an agent has learned an approximate model of its environment is when it can sample from
a distribution approximately similar to the real transition probability distribution. With this ability it can make
predictions and inferences, calculate statistical moments, and generate an arbitrarily large finite state machine
representation of the reachable state space."
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.types import Actions, Bools, Floats, Keys, Randomness, States
from mbagent_envs.random_keys import derive, hash_rows

BINS = 10
"""Number of bins of predicted probabilities for the calibration error."""


@dataclass(frozen=True)
class VariableReport:
    """Quality of the predictions of one variable: a factor, a mutex group of bits, or a channel of planes.

    Attributes:
        name: of the variable.
        factors: indices of its factors.
        log_likelihood: sum over its factors of the mean held-out log-probability of the next value, nats per transition.
        calibration: mean distance of predicted probabilities from frequencies, 0 ... 1 (expected calibration error).
        parents: variables other than itself, and the action, on which its next value depends in the model.
    """

    name: str
    factors: tuple[int, ...]
    log_likelihood: float
    calibration: float
    parents: tuple[str, ...]


@dataclass(frozen=True)
class FitReport:
    """Report of a fit.

    Attributes:
        n_train: number of rows used for the fit.
        n_validation: number of held-out rows, in whole episodes.
        epochs: passes over the data before early stopping.
        seconds: wall time.
        predictor_loss: held-out cross-entropy of the predictor, nats per transition (None: the model has no predictor).
        conditioner_loss: the same of the conditioner given the true other variables (None: no conditioner).
        exact_match: share of held-out transitions whose most likely next state is the observed one.
        log: further figures, for the logger.
        variables: reports of the variables that changed in the data; empty if the model has no such reports.
        calibration: mean distance of all predicted probabilities from frequencies; None likewise.
        memory: improvement of predictions given the previous step in addition to current state and action, nats per transition;
            0 if it is not significant, None if it was not tested.
    """

    n_train: int
    n_validation: int
    epochs: int
    seconds: float
    predictor_loss: float | None = None
    conditioner_loss: float | None = None
    exact_match: float | None = None
    log: Mapping[str, float] = field(default_factory=dict)
    variables: tuple[VariableReport, ...] = ()
    calibration: float | None = None
    memory: float | None = None

    @property
    def advice(self) -> str | None:
        """Advice on the environment, in one sentence; None if there is none."""
        if not self.memory:
            return None
        return (
            f"The previous step improves predictions by {self.memory:.2g} nats per transition, so the next state seems to depend "
            "on more than the observation and the action; wrap the environment in mbagent.wrappers.History(env, k)."
        )

    def table(self, most: int = 20) -> str:
        """The variables with the lowest log-likelihood, as text."""
        worst = sorted(self.variables, key=lambda variable: variable.log_likelihood)[:most]
        lines = [f"{'variable':24} {'log-likelihood':>14} {'calibration':>11}  depends on"]
        for variable in worst:
            parents = ", ".join(variable.parents[:8]) + (", …" if len(variable.parents) > 8 else "")
            figures = f"{variable.log_likelihood:14.4f} {variable.calibration:11.4f}"
            lines.append(f"{variable.name:24} {figures}  {parents or 'nothing else'}")
        return "\n".join(lines)


def calibration_error(probabilities: Floats, came: NDArray[np.bool_]) -> float:
    """Expected calibration error (Naeini et al. 2015) of probabilities, given outcomes of the same shape.

    Distance of the mean probability from the observed frequency, averaged over bins weighted by their numbers of predictions.
    """
    bins = np.minimum((probabilities.ravel() * BINS).astype(np.int64), BINS - 1)
    predicted = np.bincount(bins, weights=probabilities.ravel(), minlength=BINS)
    observed = np.bincount(bins, weights=came.ravel().astype(np.float64), minlength=BINS)
    return float(np.abs(predicted - observed).sum() / max(probabilities.size, 1))


@dataclass(frozen=True)
class Variable:
    """A variable to report: its name, factors and parents."""

    name: str
    factors: tuple[int, ...]
    parents: tuple[str, ...]


def describe(
    cardinalities: Sequence[int], probabilities: Floats, rows: TransitionBatch, variables: Sequence[Variable]
) -> tuple[tuple[VariableReport, ...], float | None]:
    """Held-out figures of each variable, and the calibration of all.

    Args:
        cardinalities: number of values of each factor, length F.
        probabilities: each factor's distribution, [N, sum of cardinalities].
        rows: the N held-out transitions.
        variables: the variables to report.
    """
    if len(rows) == 0:
        return (), None
    start = np.concatenate([[0], np.cumsum(cardinalities)]).astype(np.int64)
    at = start[:-1] + rows.after
    logs = np.log(np.take_along_axis(probabilities, at, axis=1).clip(1e-12)).mean(axis=0)
    observed = np.zeros(probabilities.shape, dtype=np.bool_)
    np.put_along_axis(observed, at, True, axis=1)
    reports = []
    for variable in variables:
        columns = np.concatenate([np.arange(start[f], start[f + 1]) for f in variable.factors])
        error = calibration_error(probabilities[:, columns], observed[:, columns])
        total = float(logs[list(variable.factors)].sum())
        reports.append(VariableReport(variable.name, variable.factors, total, error, variable.parents))
    return tuple(reports), calibration_error(probabilities, observed)


LARGEST_NUMBER = 2**62
"""Upper bound of the numbers of actions, and of action sequences that are one action of a model."""


@dataclass(frozen=True)
class Successors:
    """Possible next states of each row, in compressed rows: those of row b are ``offsets[b]:offsets[b + 1]``.

    Attributes:
        offsets: int64 [B + 1].
        states: int64 [M, F].
        terminated: bool [M].
        probabilities: float64 [M], summing to one over each row.
    """

    offsets: NDArray[np.int64]
    states: States
    terminated: Bools
    probabilities: Floats

    @property
    def rows(self) -> NDArray[np.int64]:
        """Row to which each successor belongs, int64 [M]."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


@runtime_checkable
class TransitionModel(Protocol):
    """A model of P(next state, terminated | state, action) for factored states.

    Shapes: B batch, F factors. Actions are numbers of the enumerated actions.
    """

    cardinalities: tuple[int, ...]
    n_actions: int

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Fits the model to transitions, without rewards. ``progress`` is called with the share that is done, 0 ... 1."""
        ...

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """Samples next_states int64 [B, F] and terminated bool [B]."""
        ...

    def marginals(self, states: States, actions: Actions) -> Floats:
        """The predictor's output: probabilities [B, sum of cardinalities], factor after factor."""
        ...

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """Exact log-probability [B]; models without exact probabilities raise NotImplementedError."""
        ...

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """Successors for planning: all if they are few, else ``n_samples`` samples."""
        ...

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All weights, as arrays only."""
        ...

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restores the weights that ``state_dict`` returned."""
        ...


def as_keys(rng: Randomness, n: int) -> Keys:
    """Keys uint64 [n] from a generator or from keys.

    Raises:
        ValueError: the number of keys is not n.
    """
    if isinstance(rng, np.random.Generator):
        return rng.integers(0, 2**64, size=n, dtype=np.uint64)
    if len(rng) != n:
        raise ValueError(f"{len(rng)} random keys were given for {n} rows; give one key for each row.")
    return rng


def merge_draws(rows: NDArray[np.int64], n_rows: int, states: States, terminated: Bools, weights: Floats) -> Successors:
    """Adds up the weights of equal (row, state, terminated); within each row, outcomes keep the order of their first sample.

    Args:
        rows: int64 [M], ascending: the row of each sample.
        n_rows: number of rows B; each must have a sample.
        states: int64 [M, F].
        terminated: bool [M].
        weights: float [M] above zero, normalised here.
    """
    tags = derive(hash_rows(states), rows, terminated.astype(np.int64))
    _, first, inverse = np.unique(tags, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    kept = first[order]
    mass = np.bincount(rank[inverse], weights=weights, minlength=len(kept))
    counts = np.bincount(rows[kept], minlength=n_rows)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    totals = np.bincount(rows[kept], weights=mass, minlength=n_rows)
    return Successors(offsets, states[kept], terminated[kept], mass / totals[rows[kept]])
