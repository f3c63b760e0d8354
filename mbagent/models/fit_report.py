"""Fit reports: data sizes, held-out metrics of each variable, and calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch
from mbagent.types import Floats

BINS = 10
"""Number of bins of predicted probabilities for the calibration error."""


@dataclass(frozen=True)
class VariableReport:
    """Prediction quality for one variable: a factor, a mutex group of bits, or a channel of planes.

    Attributes:
        name: name of the variable.
        factors: indices of its factors.
        log_likelihood: mean held-out log-probability of the next value, summed over the variable's factors, in nats per
            transition.
        calibration: expected calibration error, the mean absolute difference between predicted probabilities and observed
            frequencies, 0 ... 1.
        parents: the other variables, and possibly the action, on which the model's prediction of the next value depends.
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
        n_validation: number of held-out rows, from whole episodes if there are enough.
        epochs: passes over the data before early stopping.
        seconds: wall time.
        predictor_loss: held-out cross-entropy of the predictor, nats per transition (None: the model has no predictor).
        conditioner_loss: the same for the conditioner, given the observed next values of the other variables (None: no
            conditioner).
        exact_match: share of held-out transitions for which the model's most likely next state is the observed one.
        log: further metrics, for the logger.
        variables: reports on the variables that changed in the data; empty if the model does not provide them.
        calibration: expected calibration error of all predicted probabilities; None if it was not computed.
        memory: gain in held-out log-likelihood from using the previous step in addition to the current state and action, in nats
            per transition; 0 if the gain is small or not significant, None if it was not tested.
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
        """Text table of the ``most`` variables with the lowest log-likelihood."""
        worst = sorted(self.variables, key=lambda variable: variable.log_likelihood)[:most]
        lines = [f"{'variable':24} {'log-likelihood':>14} {'calibration':>11}  depends on"]
        for variable in worst:
            parents = ", ".join(variable.parents[:8]) + (", …" if len(variable.parents) > 8 else "")
            figures = f"{variable.log_likelihood:14.4f} {variable.calibration:11.4f}"
            lines.append(f"{variable.name:24} {figures}  {parents or 'nothing else'}")
        return "\n".join(lines)


def calibration_error(probabilities: Floats, came: NDArray[np.bool_]) -> float:
    """Expected calibration error (Naeini et al. 2015) of predicted probabilities, given which outcomes came true (same shape).

    The absolute difference between the mean probability and the observed frequency in each bin is averaged over bins, weighted
    by their number of predictions.
    """
    bins = np.minimum((probabilities.ravel() * BINS).astype(np.int64), BINS - 1)
    predicted = np.bincount(bins, weights=probabilities.ravel(), minlength=BINS)
    observed = np.bincount(bins, weights=came.ravel().astype(np.float64), minlength=BINS)
    return float(np.abs(predicted - observed).sum() / max(probabilities.size, 1))


@dataclass(frozen=True)
class Variable:
    """A variable to report on: its name, factors and parents."""

    name: str
    factors: tuple[int, ...]
    parents: tuple[str, ...]


def describe(
    cardinalities: Sequence[int], probabilities: Floats, rows: TransitionBatch, variables: Sequence[Variable]
) -> tuple[tuple[VariableReport, ...], float | None]:
    """Held-out metrics of each variable, and the calibration of all predictions.

    Args:
        cardinalities: number of values of each factor, length F.
        probabilities: each factor's predicted distribution, concatenated, [N, sum of cardinalities].
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
