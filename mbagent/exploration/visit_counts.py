"""How often each (state, action) was tried and where it led, and how to get to what was tried least."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.types import Actions, Floats, Ints, States
from mbagent_envs.jit import compiled

DISCOUNT = 0.99
"""Of a step, where the worth of going somewhere is worked out."""

UNTRIED = 1.0 / (1.0 - DISCOUNT) + 1.0
"""Worth of an action never tried: no sum of discounted bonuses, of which the first is 1, is as much."""

TIE = 1e-6
"""Actions that differ by less are chosen between by lot."""

WORK = 4096
"""Pairs and outcomes looked at in each step, at most: some tens of microseconds."""

START_NODE = 0
"""The node that stands for "a new episode begins"."""


class VisitArrays(NamedTuple):
    """What compiled code needs of a VisitTable, with room to grow; N nodes and M outcomes of them are in use.

    Attributes:
        tried: how often each action was taken, int64 [room, A]; of node START_NODE, column 0, how many episodes began.
        first: number of the first outcome of each (node, action), -1 where there is none, int64 [room, A].
        worth: discounted sum of the bonuses that can be had from a node on, float64 [room].
        target: the node that an outcome leads to, int64 [room].
        times: how often it was met, int64 [room].
        following: number of the next outcome of the same (node, action), -1 after the last, int64 [room].
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
    """Counts over all states met, and the way to what was tried least. It has no place for a reward.

    The empirical machine of the states met is solved for a bonus 1 / sqrt(n) for a (state, action) tried n times (Strehl &
    Littman 2008, here with no reward beside it), by value iteration that goes on a little at every step. Actions never
    tried are worth more than any others. Where an episode ended, the worth is that of the states in which episodes begin:
    an end would else look like a place where nothing can be found out any more. That holds for limits of steps, too: who
    is stuck until one comes is not stuck for ever.

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
        """Number of distinct states met."""
        return int(self._arrays.sizes[0]) - 1

    def add(self, states: States) -> Ints:
        """The nodes int64 [B] of states int64 [B, F]; new ones where they were never met."""
        nodes, known = np.empty(len(states), dtype=np.int64), self._nodes
        for b, row in enumerate(np.ascontiguousarray(states, dtype=np.int64)):
            nodes[b] = known.setdefault(row.tobytes(), len(known) + 1)
        if len(known) >= len(self._arrays.worth):
            self._grow(2 * len(known), 0)
        self._arrays.sizes[0] = len(known) + 1
        return nodes

    def begin(self, nodes: Ints) -> None:
        """Episodes began at these nodes [B]."""
        self._count(np.full(len(nodes), START_NODE), np.zeros(len(nodes), dtype=np.int64), nodes)

    def record(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        """Actions [B] taken at nodes [B] led to others [B]; to START_NODE where the episode ended."""
        self._count(nodes, actions, targets)

    def _count(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        if self._arrays.sizes[1] + len(nodes) > len(self._arrays.target):
            self._grow(0, 2 * (int(self._arrays.sizes[1]) + len(nodes)))
        _record(self._arrays, nodes, actions, targets)

    def _grow(self, n_nodes: int, n_outcomes: int) -> None:
        """Makes room for so many nodes and outcomes, at least."""
        old = self._arrays
        self._arrays = _room(self.n_actions, max(n_nodes, len(old.worth)), max(n_outcomes, len(old.target)))
        for before, after in zip(old, self._arrays, strict=True):
            after[: len(before)] = before

    def counts(self, states: States) -> Ints:
        """How often each action was taken in states [B, F], int64 [B, A]."""
        keys = [row.tobytes() for row in np.ascontiguousarray(states, dtype=np.int64)]
        found = np.array([self._nodes.get(key, -1) for key in keys], dtype=np.int64)
        return np.where(found[:, None] >= 0, self._arrays.tried[found], 0)

    def pairs(self) -> int:
        """Number of distinct (state, action) that were tried."""
        return int((self._arrays.tried[1 : len(self) + 1] > 0).sum())

    def choose(self, nodes: Ints, noise: Floats) -> Actions:
        """The actions int64 [B] of most worth, after value iteration went on a little; rows at the same node share them out.

        Args:
            nodes: int64 [B].
            noise: float64 [B, A], uniform in [0, 1), to choose between equals.
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
    """Counts an outcome of each row; there must be room."""
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
    """Mean worth of what an action that was tried led to, and the number of its distinct outcomes."""
    total, counted, outcome = 0.0, 0, table.first[node, action]
    while outcome >= 0:
        total += table.times[outcome] * table.worth[table.target[outcome]]
        counted += 1
        outcome = table.following[outcome]
    return total / table.tried[node, action], counted


@compiled
def _improve(table: VisitArrays, work: int, at: int, upwards: bool) -> tuple[int, bool]:
    """Sweeps to and fro over the nodes, in place, from node ``at`` on; returns where to go on."""
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
    """Fills ``actions`` [B], see VisitTable.choose; each counts as a try for the rows after it. Returns as _improve does."""
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
