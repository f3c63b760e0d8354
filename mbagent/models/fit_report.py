"""What a fit did, and how far it can be trusted: held-out figures for each variable, and what it was found to hang on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch
from mbagent.types import Floats

BINS = 10
"""Bins of predicted probabilities that are held against frequencies."""


@dataclass(frozen=True)
class VariableReport:
    """How well one variable is predicted: a factor, a group of bits of which one is on, or a channel of planes.

    Attributes:
        name: what it is called.
        factors: its factors.
        log_likelihood: mean held-out log-probability of its factors' next values, each for itself, nats a transition.
        calibration: mean distance of predicted probabilities from frequencies, 0 ... 1 (expected calibration error).
        parents: what its next value was found to hang on besides itself.
    """

    name: str
    factors: tuple[int, ...]
    log_likelihood: float
    calibration: float
    parents: tuple[str, ...]


@dataclass(frozen=True)
class FitReport:
    """What a fit did.

    Attributes:
        n_train: rows fitted to.
        n_validation: rows held out, by whole episodes.
        epochs: passes over the data before early stopping.
        seconds: wall time.
        predictor_loss: held-out cross-entropy of the predictor, nats a transition (None: the model has no predictor).
        conditioner_loss: the same of the conditioner given the true other variables (None: none).
        exact_match: share of held-out transitions whose most likely next state is the one met.
        log: further figures, for the logger.
        variables: of each variable that ever changed; empty where the model does not tell.
        calibration: mean distance of all predicted probabilities from frequencies; None likewise.
        memory: what the step before tells beyond the present state and action, nats a transition; 0 where no more than chance
            would, None where it was not looked at.
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
        """What to do about the environment, in one sentence; None where there is nothing to say."""
        if not self.memory:
            return None
        return (
            f"The step before tells the model {self.memory:.2g} nats a transition more than the observation and the action do: "
            "the next state seems to hang on more than these; wrap the environment in mbagent.wrappers.History(env, k)."
        )

    def table(self, most: int = 20) -> str:
        """The variables that are predicted worst, as text."""
        worst = sorted(self.variables, key=lambda variable: variable.log_likelihood)[:most]
        lines = [f"{'variable':24} {'log-likelihood':>14} {'calibration':>11}  hangs on"]
        for variable in worst:
            parents = ", ".join(variable.parents[:8]) + (", …" if len(variable.parents) > 8 else "")
            figures = f"{variable.log_likelihood:14.4f} {variable.calibration:11.4f}"
            lines.append(f"{variable.name:24} {figures}  {parents or 'nothing else'}")
        return "\n".join(lines)


def calibration_error(probabilities: Floats, came: NDArray[np.bool_]) -> float:
    """Mean distance of predicted probabilities from the frequencies of their bins (Naeini et al. 2015); both of any shape."""
    bins = np.minimum((probabilities.ravel() * BINS).astype(np.int64), BINS - 1)
    predicted = np.bincount(bins, weights=probabilities.ravel(), minlength=BINS)
    met = np.bincount(bins, weights=came.ravel().astype(np.float64), minlength=BINS)
    return float(np.abs(predicted - met).sum() / max(probabilities.size, 1))


@dataclass(frozen=True)
class Variable:
    """A variable that is to be reported: its name, its factors, and what it hangs on."""

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
        variables: what to report.
    """
    if len(rows) == 0:
        return (), None
    start = np.concatenate([[0], np.cumsum(cardinalities)]).astype(np.int64)
    at = start[:-1] + rows.after
    logs = np.log(np.take_along_axis(probabilities, at, axis=1).clip(1e-12)).mean(axis=0)
    came = np.zeros(probabilities.shape, dtype=np.bool_)
    np.put_along_axis(came, at, True, axis=1)
    reports = []
    for variable in variables:
        columns = np.concatenate([np.arange(start[f], start[f + 1]) for f in variable.factors])
        error = calibration_error(probabilities[:, columns], came[:, columns])
        total = float(logs[list(variable.factors)].sum())
        reports.append(VariableReport(variable.name, variable.factors, total, error, variable.parents))
    return tuple(reports), calibration_error(probabilities, came)
