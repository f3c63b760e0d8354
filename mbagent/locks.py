"""Locks that may be part of objects that are copied or pickled, which those of the standard library may not."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self


class Lock:
    """A re-entrant lock; a copied or unpickled one is new and free."""

    def __init__(self) -> None:
        """See the class."""
        self._lock = threading.RLock()

    def __enter__(self) -> Self:
        """Waits until no other thread holds the lock."""
        self._lock.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        """Releases the lock."""
        self._lock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        """Neither the holder nor those who wait belong to a copy."""
        return type(self), ()


class PlanningLock(Lock):
    """The lock of everything that a plan depends on: while one thread plans, no other plans or changes anything.

    Neither may the thread itself, which the lock would let in: the reward function that the planner calls could otherwise
    replace the search that it is called from.

    Raises (when entered):
        RuntimeError: this thread is planning.
    """

    def __init__(self) -> None:
        """See the class."""
        super().__init__()
        self._planning = False

    def __enter__(self) -> Self:
        """Waits until no other thread holds the lock."""
        super().__enter__()
        if self._planning:  # only the thread that plans gets here
            super().__exit__()
            raise RuntimeError(
                "A reward function must not use the agent that is planning with it (predict, explain, set_reward, learn ...); "
                "let it use another agent, such as copy.deepcopy(agent)"
            )
        return self

    @contextmanager
    def planning(self) -> Iterator[None]:
        """Holds the lock for a plan."""
        with self:
            self._planning = True
            try:
                yield
            finally:
                self._planning = False
