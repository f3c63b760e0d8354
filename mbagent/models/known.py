"""What models share whose rules are known: there is nothing to learn, and nothing to keep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import NDArray

from mbagent.models.base import BaseTransitionModel, FitReport
from mbagent.transitions import TransitionDataset


class KnownModel(BaseTransitionModel):
    """A model of known rules: ``fit`` does nothing and ``state_dict`` is empty; see BaseTransitionModel for the arguments."""

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Does nothing: the rules are known."""
        if progress is not None:
            progress(1.0)
        return FitReport(n_train=len(data), n_validation=0, epochs=0, seconds=0.0)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Empty."""
        return {}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Takes the empty mapping.

        Raises:
            ValueError: there are weights in it.
        """
        if state:
            raise ValueError(f"A model of known rules has no weights, but was given {sorted(state)[0]!r} and perhaps more.")
