"""Rules that changed (paper 3.1): from which step on the past still tells how a variable behaves, one by one.

Something changed where the newest steps surprise a model of all steps as no earlier run of steps did, and where a few of them
foretell the others better than all steps do. What did not change keeps all its data, so that only what is new has to be
learned anew.
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
"""``log_predictive(train, tests) -> float [T, V]``: log-probability of each variable's outcome after learning from ``train``."""

LENGTHS = (50, 100, 200, 400, 800)
"""Runs of so many newest steps are looked at, the shorter ones only if they surprise more than others."""

LONGEST_RUN = 400
"""Runs so long are looked at in any case: what chance decided before may follow a rule now, and surprises nobody."""

UNUSUAL = 0.1
"""Share of earlier runs that may surprise as much as one that is looked at."""

MOST_PATTERNS = 2
"""So many runs are held against all of the past; the second one for variables that did not change with the others."""

FEWEST_RUNS = 6
"""There must be so many runs as long."""

PARTS = 4
"""Each part of a run is foretold from the others."""

MOST_RUN_ROWS = 2500
"""Of all steps, so many evenly chosen ones are learned from."""

DEAREST = 7.0
"""What one step can cost a variable at most, nats: one that nothing foretold says no more than another."""

SURE_CHANGE = 10.0
"""Nats by which a run must surprise more than any early one, and be foretold better; plus the log of the number of variables."""


def last_changes(rows: TransitionBatch, n_variables: int, log_predictive: LogPredictive) -> Ints:
    """First row that tells of each variable as it is now, int64 [V]; 0 where nothing changed.

    Args:
        rows: transitions in the order met.
        n_variables: number of variables V.
        log_predictive: learns from some transitions and foretells others.
    """
    n, since = len(rows), np.zeros(n_variables, dtype=np.int64)
    lengths = [length for length in LENGTHS if FEWEST_RUNS * length <= n]
    if not lengths:
        return since
    limit, known, runs = SURE_CHANGE + math.log(n_variables), _logs(thinned(rows, MOST_RUN_ROWS), rows, log_predictive), []
    for length in lengths:
        surprise = _surprise(known, length)
        suspect = surprise > 0.0
        if surprise[suspect].sum() > limit or length >= LONGEST_RUN:
            anew = _crossed(rows, np.arange(n - length, n), log_predictive)
            gain = anew - known[-length:]
            runs.append(_Run(length, anew, suspect, np.where(_gaining(suspect, gain, limit), gain.sum(axis=0), 0.0)))
    for _ in range(MOST_PATTERNS):
        run = max(runs, key=lambda run: float(run.total[since == 0].sum()), default=None)
        if run is None or run.total[since == 0].sum() == 0.0:
            break
        runs, newest, past = [other for other in runs if other is not run], np.arange(n - run.length, n), n - run.length
        gain = run.anew - _crossed(
            rows, newest, log_predictive, np.arange(past)
        )  # all of the past foretells more than some of it
        found = _gaining(run.suspect, gain, limit) & (since == 0)
        if found.any():
            before = _logs(rows.select(newest), rows.select(np.arange(past)), log_predictive) - known[:past]
            since[found] = _turns(np.concatenate([before, gain])[:, found], limit)
    return since


class _Run(NamedTuple):
    """A run of newest steps that may follow new rules.

    Attributes:
        length: its steps L.
        anew: log-probabilities of its outcomes, foretold from its other parts, [L, V].
        suspect: variables that surprise in it, [V].
        total: what is gained for variables that seem to have changed, 0 for others, [V].
    """

    length: int
    anew: Floats
    suspect: Bools
    total: Floats


def _logs(train: TransitionBatch, tests: TransitionBatch, log_predictive: LogPredictive) -> Floats:
    return np.maximum(log_predictive(train, tests), -DEAREST)


def _surprise(logs: Floats, length: int) -> Floats:
    """By how much each variable's newest ``length`` steps cost more than usual in runs as long of the first half, [V]."""
    runs = logs[len(logs) % length :].reshape(-1, length, logs.shape[1]).sum(axis=1)
    result: Floats = np.quantile(runs[: len(runs) // 2], UNUSUAL, axis=0) - runs[-1]
    return result


def _gaining(suspect: Bools, gain: Floats, limit: float) -> Bools:
    """Which variables gain more than chance, [V], from gains [N, V]: each alone, or suspects all together."""
    total = gain.sum(axis=0)
    together = suspect & (total > 0.0)
    result: Bools = (total > limit) | (together & (total[together].sum() > limit))
    return result


def _crossed(rows: TransitionBatch, newest: Ints, log_predictive: LogPredictive, old: Ints | None = None) -> Floats:
    """Each part of the newest rows foretold from their other parts, and from old rows if given."""
    logs = []
    for part in np.array_split(newest, PARTS):
        others = np.setdiff1d(newest, part)
        known = others if old is None else np.concatenate([old, others])
        logs.append(_logs(rows.select(known), rows.select(part), log_predictive))
    return np.concatenate(logs)


def _turns(gain: Floats, limit: float) -> Ints:
    """First row from which on gains [N, V] are greatest: together, or of one variable alone where it gains much by that."""
    later = np.cumsum(gain[::-1], axis=0)[::-1]
    own, every = later.argmax(axis=0), later.sum(axis=1).argmax()
    result: Ints = np.where(later.max(axis=0) - later[every] > 3.0 * limit, own, every)
    return result
