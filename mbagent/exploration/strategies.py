"""How to act while learning. Nothing here ever sees a reward."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.exploration.controllability import StateAbstraction, find_controllable, find_reached
from mbagent.exploration.visit_counts import START_NODE, VisitTable
from mbagent.types import Actions, Bools, States

FEW_STATES, STEPS_PER_STATE = 64, 8
"""States are few enough for a table where there are so many at most, and one more for each so many steps."""

MANY_STATES = 50_000
"""More than this are not kept in a table."""

MANY_VALUES = 40_000_000
"""Values of factors, mostly of a byte each, that are kept to look at which of them actions reach."""

FIRST_COUNT = 256
"""Steps before the first look, if there are too many states by then."""

STEPS_TOGETHER = 256
"""Steps that are counted at once while they direct nothing."""


class Exploration(Protocol):
    """Chooses the actions of the learning phase."""

    def act(self, states: States, rng: np.random.Generator) -> Actions:
        """Action numbers int64 [B] for states int64 [B, F], numbered as declared (see FactoredSpace)."""
        ...


@runtime_checkable
class Watching(Protocol):
    """An exploration that is told what its actions led to; never a reward."""

    def observe(self, states: States, actions: Actions, next_states: States, ended: Bools) -> None:
        """A step of each environment.

        Args:
            states: int64 [B, F], numbered as declared.
            actions: int64 [B].
            next_states: int64 [B, F], where an episode ended its last.
            ended: whether the episode ended there, by the world's rules or by a limit of steps, bool [B].
        """
        ...


class RandomExploration:
    """Every action equally often, as the paper's agents explore (section 4.4).

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
    """Random actions that are kept for a while, each step with probability ``keep``.

    For worlds in which single steps lead nowhere, as those made from continuous ones: what pushes now this way, now that, stays
    where it is.

    Args:
        n_actions: number of enumerated actions.
        keep: probability that the last action goes on, at least 0 and below 1.

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
    """To what was tried least, by counts over the states met; where there are too many states, every action equally often.

    Where random steps seldom get far (holes, cliffs, long corridors, things that take several steps in the right order), it is
    far ahead of them. It needs states that are met again: a table of visits says nothing about a state never seen. Where there
    are too many of them, it looks again each time the steps have doubled whether they are few in what actions have a say in
    (see ``controllability.py``), and counts in that alone: lights that flicker whatever is done make every state a new one, and
    do not matter for where to go.

    Args:
        n_actions: number of enumerated actions.
        few: True to be directed only while states are few: no more than FEW_STATES + steps / STEPS_PER_STATE different ones
            met; False to be directed up to MANY_STATES. Otherwise actions are drawn as RandomExploration draws them.

    Attributes:
        table: what was tried; None where there were more than MANY_STATES, until fewer factors are found to tell them apart by.
        view: what states are told apart by; None for all that they are.
        n_steps: steps observed.
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
        """Whether it looks for what was tried least at present."""
        return self.table is not None and len(self.table) <= self._most

    @property
    def _most(self) -> float:
        """The number of states up to which it is directed."""
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
        self._take(_Steps(states, actions, next_states, self._ended, began))

    def recall(self, rows: TransitionBatch) -> None:
        """Takes steps that were made without it; all their episodes are over."""
        rows = rows.select(np.argsort(rows.episodes, kind="stable"))
        change = rows.episodes[1:] != rows.episodes[:-1]
        self._take(_Steps(rows.before, rows.actions, rows.after, np.append(change, True), np.append(True, change)))

    def _take(self, steps: _Steps) -> None:
        self.n_steps += len(steps.actions)
        look = self.n_steps >= self._reconsider_at
        if self._kept is not None:
            self._unkept.append(steps)
            self._n_unkept += len(steps.actions)
            if look or self._n_unkept >= STEPS_TOGETHER:
                self._keep(self._kept)
        if self.table is not None:
            self._uncounted.append(steps)
            self._n_uncounted += len(steps.actions)
            if look or self.directed or self._n_uncounted >= STEPS_TOGETHER:  # many steps at once cost less for each
                self._count(self.table, _joined(self._uncounted))
                self._uncounted, self._n_uncounted = [], 0
        if look:
            self._reconsider_at = 2 * self.n_steps
            self._reconsider()

    def _nodes(self, table: VisitTable, states: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        return table.add(states.astype(np.int64, copy=False) if self.view is None else self.view(states))

    def _count(self, table: VisitTable, steps: _Steps) -> None:
        """Enters steps into the table."""
        nodes, targets = self._nodes(table, steps.states), np.full(len(steps.states), START_NODE)
        targets[~steps.ended] = self._nodes(table, steps.next_states[~steps.ended])
        table.begin(nodes[steps.began])
        table.record(nodes, steps.actions, targets)
        if len(table) > MANY_STATES:
            self.table = None

    def _keep(self, kept: list[_Steps]) -> None:
        """Keeps steps for later looks; as soon as that is too much, a last look is taken, and all is let go."""
        kept.append(_joined(self._unkept).narrowed())
        self._unkept, self._n_unkept = [], 0
        self._n_kept += 2 * kept[-1].states.size
        if self._n_kept > MANY_VALUES:
            self._reconsider()
            self._kept = None

    def _reconsider(self) -> None:
        """Settles how states are told apart: by all, if they are few then; else by what actions reach; else by what they do."""
        if self._kept is None or (self.view is None and self.directed):
            return
        steps = _joined(self._kept)
        self._kept = [steps]
        if _distinct(steps.states) <= self._most:
            view = None
        else:
            met = steps.states, steps.actions, steps.next_states
            found = find_controllable(*met, self._random.n_actions)
            view = StateAbstraction(found, np.zeros_like(found.directly))
            if not found.directly.any() or _distinct(view(steps.states)) > self._most:
                return
            finer = StateAbstraction(found, find_reached(found, *met))
            view = finer if _distinct(finer(steps.states)) <= self._most else view
        if self.table is None or not (view.same_as(self.view) if view is not None else self.view is None):
            self.view, self.table = view, VisitTable(self._random.n_actions)
            self._uncounted, self._n_uncounted = [], 0
            self._count(self.table, steps)


class _Steps(NamedTuple):
    """Steps [N]: states int [N, F], actions, next states, whether an episode ended with it, and began with it."""

    states: NDArray[np.integer[Any]]
    actions: Actions
    next_states: NDArray[np.integer[Any]]
    ended: Bools
    began: Bools

    def narrowed(self) -> _Steps:
        """The same with states in the smallest integers that hold them."""
        kind = np.min_scalar_type(max(int(self.states.max(initial=0)), int(self.next_states.max(initial=0))))
        return self._replace(states=self.states.astype(kind), next_states=self.next_states.astype(kind))


def _joined(parts: list[_Steps]) -> _Steps:
    return parts[0] if len(parts) == 1 else _Steps(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _distinct(states: NDArray[np.integer[Any]]) -> int:
    """Number of distinct rows."""
    rows = np.ascontiguousarray(states)
    return len(np.unique(rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1])))))


def catch_up(exploration: Exploration, data: TransitionDataset) -> None:
    """Tells directed exploration of the transitions that it did not see, such as those from a file."""
    if isinstance(exploration, DirectedExploration) and exploration.n_steps < len(data):
        exploration.recall(data.rows().select(slice(exploration.n_steps, None)))


EXPLORATIONS: dict[str, Callable[[int], Exploration]] = {
    "auto": partial(DirectedExploration, few=True),
    "directed": DirectedExploration,
    "random": RandomExploration,
    "persistent": PersistentExploration,
}
"""What the ``exploration`` argument of the agent may name."""
