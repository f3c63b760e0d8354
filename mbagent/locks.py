"""Locks that can be members of copied or pickled objects, unlike those of the standard library."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self


class Lock:
    """A re-entrant lock; a copied or unpickled one is new and unlocked."""

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
        """A copy is a new lock, without holder or waiting threads."""
        return type(self), ()


class PlanningLock(Lock):
    """The lock of all data that a plan depends on: while one thread plans, no other thread plans or changes these data.

    Unlike a re-entrant lock, it also excludes the planning thread itself: otherwise, a reward function called by the planner
    could replace the search that called it.

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
        if self._planning:  # only the planning thread can get here
            super().__exit__()
            raise RuntimeError(
                "A reward function must not use the agent that is planning with it (predict, explain, set_reward, learn ...); "
                "let it use another agent, such as copy.deepcopy(agent)"
            )
        return self

    @contextmanager
    def planning(self) -> Iterator[None]:
        """Holds the lock during a plan."""
        with self:
            self._planning = True
            try:
                yield
            finally:
                self._planning = False
