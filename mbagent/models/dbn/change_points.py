"""Change points (paper section 3.1): for each variable, the step from which the present rules hold.

A variable's rules are taken to have changed if a model of all steps predicts the newest steps worse than almost any earlier run
of steps, and if parts of this run predict each other better than all steps do. Unchanged variables keep all their data, so that
only the changed ones are learned again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.data import TransitionBatch
from mbagent.models.held_out import thinned
from mbagent.types import Bools, Floats, Ints

LogPredictive: TypeAlias = Callable[[TransitionBatch, TransitionBatch], Floats]
"""``log_predictive(train, tests) -> float [T, V]``: log-probability of each variable's outcome under a fit to ``train``."""

LENGTHS = (50, 100, 200, 400, 800)
"""Numbers of newest steps that are tested as a run; shorter runs only if their loss is unusually high."""

LONGEST_RUN = 400
"""Runs of at least this length are always tested: a previously random variable that became deterministic does not raise the loss
and would be missed."""

UNUSUAL = 0.1
"""Share of earlier runs whose loss may be as high as that of a suspicious run."""

MOST_PATTERNS = 2
"""Maximum number of runs that are compared with all of the past; the second one is for variables that changed at another time."""

FEWEST_RUNS = 6
"""Minimum number of runs of a length, for that length to be tested."""

PARTS = 4
"""Folds of the cross-validation within a run: each part is predicted from the others."""

MOST_RUN_ROWS = 2500
"""Maximum number of steps, evenly chosen from all, that the model of all steps is fitted to."""

DEAREST = 7.0
"""Upper bound on the loss of one step, in nats, so that single outliers do not dominate."""

SURE_CHANGE = 10.0
"""Nats by which a run's loss must exceed that of earlier runs, and by which its own model must reduce the loss; plus the log of
the number of variables."""


def last_changes(rows: TransitionBatch, n_variables: int, log_predictive: LogPredictive) -> Ints:
    """First row from which each variable's present rules hold, int64 [V]; 0 if nothing changed.

    Args:
        rows: transitions in the order of their observation.
        n_variables: number of variables V.
        log_predictive: fits a model to some transitions and predicts others.
    """
    n, since = len(rows), np.zeros(n_variables, dtype=np.int64)
    lengths = [length for length in LENGTHS if FEWEST_RUNS * length <= n]
    if not lengths:
        return since
    limit, known, runs = SURE_CHANGE + math.log(n_variables), _log_probs(thinned(rows, MOST_RUN_ROWS), rows, log_predictive), []
    for length in lengths:
        excess = _excess_loss(known, length)
        suspect = excess > 0.0
        if excess[suspect].sum() > limit or length >= LONGEST_RUN:
            log_probs = _cross_validated(rows, np.arange(n - length, n), log_predictive)
            gain = log_probs - known[-length:]
            runs.append(_Run(length, log_probs, suspect, np.where(_significant(suspect, gain, limit), gain.sum(axis=0), 0.0)))
    for _ in range(MOST_PATTERNS):
        run = max(runs, key=lambda run: float(run.total[since == 0].sum()), default=None)
        if run is None or run.total[since == 0].sum() == 0.0:
            break
        runs, newest, past = [other for other in runs if other is not run], np.arange(n - run.length, n), n - run.length
        # compared with a fit to all of the past, which predicts better than one to some of it
        gain = run.log_probs - _cross_validated(rows, newest, log_predictive, np.arange(past))
        found = _significant(run.suspect, gain, limit) & (since == 0)
        if found.any():
            before = _log_probs(rows.select(newest), rows.select(np.arange(past)), log_predictive) - known[:past]
            since[found] = _change_points(np.concatenate([before, gain])[:, found], limit)
    return since


class _Run(NamedTuple):
    """The newest steps, which may follow new rules.

    Attributes:
        length: number of its steps L.
        log_probs: log-probabilities of its outcomes, each predicted from the other parts of the run, [L, V].
        suspect: variables with an unusually high loss in it, [V].
        total: gain in log-likelihood of variables that seem to have changed, 0 for others, [V].
    """

    length: int
    log_probs: Floats
    suspect: Bools
    total: Floats


def _log_probs(train: TransitionBatch, tests: TransitionBatch, log_predictive: LogPredictive) -> Floats:
    return np.maximum(log_predictive(train, tests), -DEAREST)


def _excess_loss(logs: Floats, length: int) -> Floats:
    """Loss of each variable's newest ``length`` steps beyond the usual loss of such runs in the first half, [V]."""
    runs = logs[len(logs) % length :].reshape(-1, length, logs.shape[1]).sum(axis=1)
    result: Floats = np.quantile(runs[: len(runs) // 2], UNUSUAL, axis=0) - runs[-1]
    return result


def _significant(suspect: Bools, gain: Floats, limit: float) -> Bools:
    """Which variables have a significant sum of gains [N, V], bool [V]: each by itself, or all suspects together."""
    total = gain.sum(axis=0)
    together = suspect & (total > 0.0)
    result: Bools = (total > limit) | (together & (total[together].sum() > limit))
    return result


def _cross_validated(rows: TransitionBatch, newest: Ints, log_predictive: LogPredictive, old: Ints | None = None) -> Floats:
    """Log-probabilities of the newest rows, each part predicted from the other parts, and from old rows if given."""
    logs = []
    for part in np.array_split(newest, PARTS):
        others = np.setdiff1d(newest, part)
        known = others if old is None else np.concatenate([old, others])
        logs.append(_log_probs(rows.select(known), rows.select(part), log_predictive))
    return np.concatenate(logs)


def _change_points(gain: Floats, limit: float) -> Ints:
    """Row from which the summed gains [N, V] are greatest: one for all, or a variable's own if that is much better."""
    later = np.cumsum(gain[::-1], axis=0)[::-1]
    own, common = later.argmax(axis=0), later.sum(axis=1).argmax()
    result: Ints = np.where(later.max(axis=0) - later[common] > 3.0 * limit, own, common)
    return result
