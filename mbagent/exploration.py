"""How to act while learning. Nothing here ever sees a reward."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Actions, Bools, States
from mbagent.transitions import TransitionBatch, TransitionDataset
from mbagent.visits import START, VisitTable

FEW_STATES, STEPS_PER_STATE = 64, 8
"""States are few enough for a table where there are so many at most, and one more for each so many steps."""

MANY_STATES = 50_000
"""More than this are not kept in a table."""

TOGETHER = 256
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
    """To what was tried least, by counts over all states met; where there are too many states, every action equally often.

    Where random steps seldom get far (holes, cliffs, long corridors, things that take several steps in the right order), it is
    far ahead of them. It needs states that are met again: a table of visits says nothing about a state never seen.

    Args:
        n_actions: number of enumerated actions.
        few: True to be directed only while states are few: no more than FEW_STATES + steps / STEPS_PER_STATE different ones
            met; False to be directed up to MANY_STATES. Otherwise actions are drawn as RandomExploration draws them.

    Attributes:
        table: what was tried; None once there were more than MANY_STATES.
        n_steps: steps observed.
    """

    def __init__(self, n_actions: int, few: bool = False) -> None:
        """See the class."""
        self.table: VisitTable | None = VisitTable(n_actions)
        self.n_steps = 0
        self._few, self._random = few, RandomExploration(n_actions)
        self._waiting: list[tuple[NDArray[Any], ...]] = []
        self._n_counted = 0
        self._ended = np.ones(0, dtype=np.bool_)

    @property
    def directed(self) -> bool:
        """Whether it looks for what was tried least at present."""
        if self.table is None:
            return False
        return not self._few or len(self.table) <= FEW_STATES + self.n_steps / STEPS_PER_STATE

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        if self.table is None or not self.directed:  # the first for the type checker
            return self._random.act(states, rng)
        return self.table.choose(self.table.add(states), rng.random((len(states), self._random.n_actions)))

    def observe(self, states: States, actions: Actions, next_states: States, ended: Bools) -> None:
        """See Watching."""
        began = self._ended if len(self._ended) == len(ended) else np.ones(len(ended), dtype=np.bool_)
        self._ended = np.array(ended, dtype=np.bool_)
        self._take(states, actions, next_states, self._ended, began)

    def recall(self, rows: TransitionBatch) -> None:
        """Takes steps that were made without it; all their episodes are over."""
        rows = rows.select(np.argsort(rows.episodes, kind="stable"))
        change = rows.episodes[1:] != rows.episodes[:-1]
        self._take(rows.states, rows.actions, rows.next_states, np.append(change, True), np.append(True, change))

    def _take(self, states: States, actions: Actions, next_states: States, ended: Bools, began: Bools) -> None:
        self.n_steps += len(actions)
        if self.table is None:
            return
        self._waiting.append((states, actions, next_states, ended, began))
        if self.directed or self.n_steps - self._n_counted >= TOGETHER:  # counting many steps at once costs less for each
            self._count(self.table)

    def _count(self, table: VisitTable) -> None:
        """Enters what waits into the table."""
        states, actions, next_states, ended, began = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        self._waiting, self._n_counted = [], self.n_steps
        nodes, targets = table.add(states), np.full(len(states), START)
        targets[~ended] = table.add(next_states[~ended])
        table.begin(nodes[began])
        table.record(nodes, actions, targets)
        if len(table) > MANY_STATES:
            self.table = None


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
