"""Visit counts of (state, action) pairs, and value iteration with the exploration bonus of MBIE-EB."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.types import Actions, Floats, Ints, States
from mbagent_envs.jit import compiled

DISCOUNT = 0.99
"""Discount of a step for the values of states under the bonus."""

UNTRIED = 1.0 / (1.0 - DISCOUNT) + 1.0
"""Value of an untried action: larger than any sum of discounted bonuses, which are at most 1."""

TIE = 1e-6
"""Actions whose values differ by less than this are chosen at random."""

WORK = 4096
"""Approximate number of pairs and outcomes that value iteration updates in each step: some tens of microseconds."""

START_NODE = 0
"""The node that represents the start of a new episode."""


class VisitArrays(NamedTuple):
    """Arrays of a VisitTable for compiled code, with spare capacity; N nodes and M outcomes are in use.

    Attributes:
        tried: visit count of each action, int64 [room, A]; of node START_NODE, in column 0, the number of episodes begun.
        first: index of the first outcome of each (node, action), -1 if there is none, int64 [room, A].
        worth: value of each node, the discounted sum of bonuses from it on, float64 [room].
        target: the node to which an outcome leads, int64 [room].
        times: number of times that the outcome was observed, int64 [room].
        following: index of the next outcome of the same (node, action), -1 after the last one, int64 [room].
        sizes: N and M, int64 [2].
    """

    tried: Ints
    first: Ints
    worth: Floats
    target: Ints
    times: Ints
    following: Ints
    sizes: Ints


class VisitTable:
    """Visit counts of all observed states, and the actions that lead to rarely tried pairs. Rewards are not used.

    The empirical MDP of the observed states is solved for a bonus of 1 / sqrt(n) for a (state, action) tried n times (Strehl &
    Littman 2008, here without rewards), by value iteration that continues for a few updates at every step. Untried actions
    have a higher value than all others. The value at the end of an episode is that of the start states: otherwise terminal
    states would appear to have no exploration value. The same applies to truncation, since an agent that is stuck continues
    in a new episode.

    Args:
        n_actions: number of enumerated actions A.
    """

    def __init__(self, n_actions: int) -> None:
        """See the class."""
        self.n_actions = n_actions
        self._nodes: dict[bytes, int] = {}
        self._arrays = _room(n_actions, 64, 256)
        self._arrays.sizes[0] = 1
        self._at, self._upwards = 0, False

    def __len__(self) -> int:
        """Number of distinct observed states."""
        return int(self._arrays.sizes[0]) - 1

    def add(self, states: States) -> Ints:
        """The nodes int64 [B] of states int64 [B, F], added if they are new."""
        nodes, known = np.empty(len(states), dtype=np.int64), self._nodes
        for b, row in enumerate(np.ascontiguousarray(states, dtype=np.int64)):
            nodes[b] = known.setdefault(row.tobytes(), len(known) + 1)
        if len(known) >= len(self._arrays.worth):
            self._grow(2 * len(known), 0)
        self._arrays.sizes[0] = len(known) + 1
        return nodes

    def begin(self, nodes: Ints) -> None:
        """Records starts of episodes at these nodes [B]."""
        self._count(np.full(len(nodes), START_NODE), np.zeros(len(nodes), dtype=np.int64), nodes)

    def record(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        """Records that actions [B] taken at nodes [B] led to ``targets`` [B], which are START_NODE if the episode ended."""
        self._count(nodes, actions, targets)

    def _count(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        if self._arrays.sizes[1] + len(nodes) > len(self._arrays.target):
            self._grow(0, 2 * (int(self._arrays.sizes[1]) + len(nodes)))
        _record(self._arrays, nodes, actions, targets)

    def _grow(self, n_nodes: int, n_outcomes: int) -> None:
        """Reserves memory for at least ``n_nodes`` nodes and ``n_outcomes`` outcomes."""
        old = self._arrays
        self._arrays = _room(self.n_actions, max(n_nodes, len(old.worth)), max(n_outcomes, len(old.target)))
        for before, after in zip(old, self._arrays, strict=True):
            after[: len(before)] = before

    def counts(self, states: States) -> Ints:
        """Visit count of each action in states [B, F], int64 [B, A]."""
        keys = [row.tobytes() for row in np.ascontiguousarray(states, dtype=np.int64)]
        found = np.array([self._nodes.get(key, -1) for key in keys], dtype=np.int64)
        return np.where(found[:, None] >= 0, self._arrays.tried[found], 0)

    def pairs(self) -> int:
        """Number of distinct (state, action) pairs that were tried."""
        return int((self._arrays.tried[1 : len(self) + 1] > 0).sum())

    def choose(self, nodes: Ints, noise: Floats) -> Actions:
        """Actions int64 [B] of the highest value, after some updates of value iteration.

        Rows at the same node distribute over its actions, since an action chosen for one row counts as tried for later rows.

        Args:
            nodes: int64 [B].
            noise: float64 [B, A], uniform in [0, 1), for breaking ties.
        """
        actions = np.empty(len(nodes), dtype=np.int64)
        self._at, self._upwards = _choose(self._arrays, nodes, noise, self._at, self._upwards, actions)
        return actions


def _room(n_actions: int, n_nodes: int, n_outcomes: int) -> VisitArrays:
    ints = np.int64
    return VisitArrays(
        np.zeros((n_nodes, n_actions), ints),
        np.full((n_nodes, n_actions), -1, ints),
        np.full(n_nodes, UNTRIED),
        np.zeros(n_outcomes, ints),
        np.zeros(n_outcomes, ints),
        np.full(n_outcomes, -1, ints),
        np.zeros(2, ints),
    )


@compiled
def _record(table: VisitArrays, nodes: Ints, actions: Actions, targets: Ints) -> None:
    """Counts an outcome of each row; the arrays must have spare capacity."""
    for b in range(len(nodes)):
        node, a = nodes[b], actions[b]
        table.tried[node, a] += 1
        last, outcome = -1, table.first[node, a]
        while outcome >= 0 and table.target[outcome] != targets[b]:
            last, outcome = outcome, table.following[outcome]
        if outcome < 0:
            outcome = table.sizes[1]
            table.sizes[1] += 1
            table.target[outcome] = targets[b]
            if last < 0:
                table.first[node, a] = outcome
            else:
                table.following[last] = outcome
        table.times[outcome] += 1


@compiled
def _mean(table: VisitArrays, node: int, action: int) -> tuple[float, int]:
    """Mean value of the observed outcomes of an action that was tried, and the number of distinct ones."""
    total, counted, outcome = 0.0, 0, table.first[node, action]
    while outcome >= 0:
        total += table.times[outcome] * table.worth[table.target[outcome]]
        counted += 1
        outcome = table.following[outcome]
    return total / table.tried[node, action], counted


@compiled
def _improve(table: VisitArrays, work: int, at: int, upwards: bool) -> tuple[int, bool]:
    """Sweeps up and down over the nodes in turn, in place, from node ``at`` on; returns node and direction to continue with."""
    n = table.sizes[0]
    for _ in range(2 * n):
        if at == START_NODE:
            if table.tried[START_NODE, 0] > 0:
                table.worth[START_NODE], counted = _mean(table, START_NODE, 0)
                work -= counted
        else:
            best = 0.0
            for a in range(table.tried.shape[1]):
                if table.tried[at, a] == 0:
                    best = UNTRIED
                    break
                mean, counted = _mean(table, at, a)
                best = max(best, 1.0 / np.sqrt(table.tried[at, a]) + DISCOUNT * mean)
                work -= counted
            table.worth[at] = best
            work -= table.tried.shape[1]
        at += 1 if upwards else -1
        if at < 0 or at >= n:
            upwards = at < 0
            at = 0 if upwards else n - 1
        if work <= 0:
            break
    return at, upwards


@compiled
def _choose(table: VisitArrays, nodes: Ints, noise: Floats, at: int, upwards: bool, actions: Actions) -> tuple[int, bool]:
    """Fills ``actions`` [B], see VisitTable.choose; each counts as tried for later rows. Returns as _improve does."""
    at, upwards = _improve(table, WORK, at, upwards)
    for b in range(len(nodes)):
        best = -np.inf
        for a in range(table.tried.shape[1]):
            n, taken = table.tried[nodes[b], a], 0
            for earlier in range(b):
                taken += nodes[earlier] == nodes[b] and actions[earlier] == a
            score = UNTRIED / (1.0 + taken)
            if n > 0:
                score = 1.0 / np.sqrt(n + taken) + DISCOUNT * _mean(table, nodes[b], a)[0]
            score += TIE * noise[b, a]
            if score > best:
                best, actions[b] = score, a
    return at, upwards
