"""Exploration strategies: action selection while learning, without rewards.

The directed strategy counts visits of (state, action) pairs and runs value iteration with the exploration bonus of MBIE-EB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.exploration.controllability import StateAbstraction, find_controllable, find_reached
from mbagent.types import Actions, Bools, Floats, Ints, States
from mbagent_envs.jit import compiled
from mbagent_envs.structs import Struct

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


class VisitArrays(Struct):
    """Arrays of a VisitTable for compiled code. Each ``room`` is a capacity, of which N nodes or M outcomes are in use.

    Attributes:
        tried: visit count of each (node, action), int64 [room, A]; in row START_NODE, column 0 is the number of episodes begun.
        first: index of the first outcome of each (node, action), -1 if there is none, int64 [room, A].
        worth: value of each node: the expected discounted sum of bonuses from that node on, float64 [room].
        target: the node to which each outcome leads, int64 [room].
        times: number of times that each outcome was observed, int64 [room].
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
    """Visit counts of observed states, and actions that lead to rarely tried (state, action) pairs; uses no rewards.

    The empirical MDP of the observed states is solved with a bonus of 1 / sqrt(n) for each (state, action) tried n times (Strehl
    & Littman 2008, here without rewards). Value iteration solves it incrementally, with a few updates at every step. Untried
    actions have a higher value than all others. The value at the end of an episode is that of the start states: otherwise
    terminal states would appear to have no exploration value. Truncated episodes are treated in the same way, since an agent
    that is stuck continues in a new episode.

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
        """The nodes, int64 [B], of states int64 [B, F]; new states are added first."""
        nodes, known = np.empty(len(states), dtype=np.int64), self._nodes
        for b, row in enumerate(np.ascontiguousarray(states, dtype=np.int64)):
            nodes[b] = known.setdefault(row.tobytes(), len(known) + 1)
        if len(known) >= len(self._arrays.worth):
            self._grow(2 * len(known), 0)
        self._arrays.sizes[0] = len(known) + 1
        return nodes

    def begin(self, nodes: Ints) -> None:
        """Records that one episode started at each of ``nodes`` [B]."""
        self._count(np.full(len(nodes), START_NODE), np.zeros(len(nodes), dtype=np.int64), nodes)

    def record(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        """Records that ``actions`` [B] at ``nodes`` [B] led to ``targets`` [B] (START_NODE where an episode ended)."""
        self._count(nodes, actions, targets)

    def _count(self, nodes: Ints, actions: Actions, targets: Ints) -> None:
        if self._arrays.sizes[1] + len(nodes) > len(self._arrays.target):
            self._grow(0, 2 * (int(self._arrays.sizes[1]) + len(nodes)))
        _record(self._arrays, nodes, actions, targets)

    def _grow(self, n_nodes: int, n_outcomes: int) -> None:
        """Reserves memory for at least ``n_nodes`` nodes and ``n_outcomes`` outcomes."""
        old = self._arrays
        self._arrays = _room(self.n_actions, max(n_nodes, len(old.worth)), max(n_outcomes, len(old.target)))
        for field in fields(old):
            before: Ints = getattr(old, field.name)
            getattr(self._arrays, field.name)[: len(before)] = before

    def counts(self, states: States) -> Ints:
        """Visit counts int64 [B, A] of each action in ``states`` [B, F]."""
        keys = [row.tobytes() for row in np.ascontiguousarray(states, dtype=np.int64)]
        found = np.array([self._nodes.get(key, -1) for key in keys], dtype=np.int64)
        return np.where(found[:, None] >= 0, self._arrays.tried[found], 0)

    def pairs(self) -> int:
        """Number of distinct (state, action) pairs that were tried."""
        return int((self._arrays.tried[1 : len(self) + 1] > 0).sum())

    def choose(self, nodes: Ints, noise: Floats) -> Actions:
        """The action with the highest value at each node, int64 [B], after some updates of value iteration.

        Rows at the same node tend to get different actions, since an action chosen for one row counts as tried for later rows.

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
    """Counts one outcome for each row; the arrays must have enough spare capacity."""
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
    """(mean value of a tried action's observed outcomes, number of distinct outcomes)."""
    total, counted, outcome = 0.0, 0, table.first[node, action]
    while outcome >= 0:
        total += table.times[outcome] * table.worth[table.target[outcome]]
        counted += 1
        outcome = table.following[outcome]
    return total / table.tried[node, action], counted


@compiled
def _improve(table: VisitArrays, work: int, at: int, upwards: bool) -> tuple[int, bool]:
    """Updates values in place, sweeping up and down the nodes from ``at``; returns (next node, whether upwards)."""
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
    """Fills ``actions`` [B] as described in VisitTable.choose; returns the result of ``_improve``."""
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


FEW_STATES, STEPS_PER_STATE = 64, 8
"""States are few if their number is at most FEW_STATES + steps / STEPS_PER_STATE."""

MANY_STATES = 50_000
"""Maximum number of states in a table."""

MANY_VALUES = 40_000_000
"""Maximum number of values of factors, mostly of a byte each, that are kept for the test of controllability."""

FIRST_COUNT = 256
"""Number of steps before the first test of controllability, if there are too many states by then."""

STEPS_TOGETHER = 256
"""Number of steps that are counted together while exploration is not directed."""


class Exploration(Protocol):
    """Chooses the actions of the learning phase."""

    def act(self, states: States, rng: np.random.Generator) -> Actions:
        """Action numbers int64 [B] for states int64 [B, F] in declared numbers (see FactoredSpace)."""
        ...


@runtime_checkable
class Watching(Protocol):
    """An exploration strategy that observes the transitions, but not the rewards."""

    def observe(self, states: States, actions: Actions, next_states: States, ended: Bools) -> None:
        """Records one step of each environment.

        Args:
            states: int64 [B, F], in declared numbers (FactoredSpace).
            actions: int64 [B].
            next_states: int64 [B, F]; if an episode ended, its last state.
            ended: whether the episode was terminated or truncated, bool [B].
        """
        ...


class RandomExploration:
    """Uniformly random actions, as in the paper (section 4.4).

    Args:
        n_actions: number of enumerated actions.
    """

    def __init__(self, n_actions: int) -> None:
        """See the class."""
        self.n_actions = n_actions

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        return rng.integers(self.n_actions, size=len(states))


class PersistentExploration:
    """Random actions, each of which is repeated with probability ``keep`` at every step.

    For environments in which single actions have little effect, such as discretised continuous ones, where pushes in alternating
    directions cancel out.

    Args:
        n_actions: number of enumerated actions.
        keep: probability of repeating the last action, in [0, 1).

    Raises:
        ValueError: ``keep`` is out of range.
    """

    def __init__(self, n_actions: int, keep: float = 0.95) -> None:
        """See the class."""
        if not 0.0 <= keep < 1.0:
            raise ValueError(f"keep must be a probability below 1, got {keep}.")
        self.n_actions, self.keep = n_actions, keep
        self._last = np.zeros(0, dtype=np.int64)

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        new = rng.integers(self.n_actions, size=len(states))
        again = rng.random(len(states)) < self.keep
        if len(self._last) == len(states):
            new = np.where(again, self._last, new)
        self._last = new
        return new.copy()


class DirectedExploration:
    """Count-based exploration of the least-tried state-action pairs; uniformly random if there are too many states.

    It is far better than random actions where these seldom get far (holes, cliffs, long corridors, tasks of several steps in the
    right order). It needs states that recur, since a table of visits has no information on unobserved states. If there are too
    many, then whenever the number of steps has doubled, it tests whether controllable factors form few abstract states (see
    ``controllability.py``); if so, it counts only these: uncontrollable distractors make almost every state novel, but are
    irrelevant for exploration.

    Args:
        n_actions: number of enumerated actions.
        few: True to be directed only up to FEW_STATES + steps / STEPS_PER_STATE distinct states; False to be directed up to
            MANY_STATES. Otherwise actions are those of RandomExploration.

    Attributes:
        table: visit counts; None after more than MANY_STATES states, until an abstraction with fewer states is found.
        view: state abstraction in use; None if states are counted unchanged.
        n_steps: number of observed steps.
    """

    def __init__(self, n_actions: int, few: bool = False) -> None:
        """See the class."""
        self.table: VisitTable | None = VisitTable(n_actions)
        self.view: StateAbstraction | None = None
        self.n_steps = 0
        self._few, self._random = few, RandomExploration(n_actions)
        self._uncounted: list[_Steps] = []
        self._unkept: list[_Steps] = []
        self._kept: list[_Steps] | None = []
        self._n_uncounted, self._n_unkept, self._n_kept = 0, 0, 0
        self._reconsider_at = FIRST_COUNT
        self._ended = np.ones(0, dtype=np.bool_)

    @property
    def directed(self) -> bool:
        """Whether exploration is currently directed by visit counts."""
        return self.table is not None and len(self.table) <= self._most

    @property
    def _most(self) -> float:
        """Maximum number of states for directed exploration."""
        return min(MANY_STATES, FEW_STATES + self.n_steps / STEPS_PER_STATE) if self._few else MANY_STATES

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        if self.table is None or not self.directed:  # the first for the type checker
            return self._random.act(states, rng)
        return self.table.choose(self._nodes(self.table, states), rng.random((len(states), self._random.n_actions)))

    def observe(self, states: States, actions: Actions, next_states: States, ended: Bools) -> None:
        """See Watching."""
        began = self._ended if len(self._ended) == len(ended) else np.ones(len(ended), dtype=np.bool_)
        self._ended = np.array(ended, dtype=np.bool_)
        self._add_steps(_Steps(states, actions, next_states, self._ended, began))

    def recall(self, rows: TransitionBatch) -> None:
        """Records transitions observed elsewhere; all their episodes must have ended."""
        rows = rows.select(np.argsort(rows.episodes, kind="stable"))
        change = rows.episodes[1:] != rows.episodes[:-1]
        self._add_steps(_Steps(rows.before, rows.actions, rows.after, np.append(change, True), np.append(True, change)))

    def _add_steps(self, steps: _Steps) -> None:
        self.n_steps += len(steps.actions)
        due = self.n_steps >= self._reconsider_at
        if self._kept is not None:
            self._unkept.append(steps)
            self._n_unkept += len(steps.actions)
            if due or self._n_unkept >= STEPS_TOGETHER:
                self._keep(self._kept)
        if self.table is not None:
            self._uncounted.append(steps)
            self._n_uncounted += len(steps.actions)
            if due or self.directed or self._n_uncounted >= STEPS_TOGETHER:  # counting many steps at once is faster
                self._count(self.table, _joined(self._uncounted))
                self._uncounted, self._n_uncounted = [], 0
        if due:
            self._reconsider_at = 2 * self.n_steps
            self._reconsider()

    def _nodes(self, table: VisitTable, states: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        return table.add(states.astype(np.int64, copy=False) if self.view is None else self.view(states))

    def _count(self, table: VisitTable, steps: _Steps) -> None:
        """Adds steps to the table."""
        nodes, targets = self._nodes(table, steps.states), np.full(len(steps.states), START_NODE)
        targets[~steps.ended] = self._nodes(table, steps.next_states[~steps.ended])
        table.begin(nodes[steps.began])
        table.record(nodes, steps.actions, targets)
        if len(table) > MANY_STATES:
            self.table = None

    def _keep(self, kept: list[_Steps]) -> None:
        """Keeps steps for later tests; if they hold more than MANY_VALUES values, runs a last test and discards all steps."""
        kept.append(_joined(self._unkept).narrowed())
        self._unkept, self._n_unkept = [], 0
        self._n_kept += 2 * kept[-1].states.size
        if self._n_kept > MANY_VALUES:
            self._reconsider()
            self._kept = None

    def _reconsider(self) -> None:
        """Chooses the finest of three state representations with few distinct states.

        Finest first: all factors; those that actions affect, directly or through others; those that actions affect directly.
        """
        if self._kept is None or (self.view is None and self.directed):
            return
        steps = _joined(self._kept)
        self._kept = [steps]
        if _distinct(steps.states) <= self._most:
            view = None
        else:
            data = steps.states, steps.actions, steps.next_states
            found = find_controllable(*data, self._random.n_actions)
            view = StateAbstraction(found, np.zeros_like(found.directly))
            if not found.directly.any() or _distinct(view(steps.states)) > self._most:
                return
            finer = StateAbstraction(found, find_reached(found, *data))
            view = finer if _distinct(finer(steps.states)) <= self._most else view
        if self.table is None or not (view.same_as(self.view) if view is not None else self.view is None):
            self.view, self.table = view, VisitTable(self._random.n_actions)
            self._uncounted, self._n_uncounted = [], 0
            self._count(self.table, steps)


class _Steps(NamedTuple):
    """Steps [N]: states int [N, F], actions, next states, whether each step ended an episode, whether it began one."""

    states: NDArray[np.integer[Any]]
    actions: Actions
    next_states: NDArray[np.integer[Any]]
    ended: Bools
    began: Bools

    def narrowed(self) -> _Steps:
        """The same steps with states of the smallest sufficient integer type."""
        kind = np.min_scalar_type(max(int(self.states.max(initial=0)), int(self.next_states.max(initial=0))))
        return self._replace(states=self.states.astype(kind), next_states=self.next_states.astype(kind))


def _joined(parts: list[_Steps]) -> _Steps:
    return parts[0] if len(parts) == 1 else _Steps(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _distinct(states: NDArray[np.integer[Any]]) -> int:
    """Number of distinct rows."""
    rows = np.ascontiguousarray(states)
    return len(np.unique(rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1])))))


def catch_up(exploration: Exploration, data: TransitionDataset) -> None:
    """Passes directed exploration transitions that it did not observe, such as those from a file."""
    if isinstance(exploration, DirectedExploration) and exploration.n_steps < len(data):
        exploration.recall(data.rows().select(slice(exploration.n_steps, None)))


EXPLORATIONS: dict[str, Callable[[int], Exploration]] = {
    "auto": partial(DirectedExploration, few=True),
    "directed": DirectedExploration,
    "random": RandomExploration,
    "persistent": PersistentExploration,
}
"""Strategies by their names for the ``exploration`` argument of the agent."""
