"""Planes on which rules may hang on the place: graphs for all positions, or for each cell, whichever foretells better."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.models.base import FitReport
from mbagent.models.graphs.evidence import Ints
from mbagent.models.graphs.fitting import fit_graphs
from mbagent.models.graphs.local import LocalGraphModel
from mbagent.models.graphs.model import IMPOSSIBLE, DecisionGraphModel
from mbagent.models.memory import FORETOLD, SOME_ROWS, SOME_TESTS, better, thinned
from mbagent.spaces import FactoredSpace
from mbagent.transitions import TransitionBatch, TransitionDataset

MOST_CELLS = 2000
"""Cells of planes of which each is looked at for itself; with more, no rows would be enough."""


class PlaneGraphModel(LocalGraphModel):
    """A LocalGraphModel that learns each cell for itself where that foretells held-out transitions clearly better.

    So it is where planes only write down a place, and what an action does there is another thing at each.

    Attributes:
        flat: the model of each cell for itself, whose graphs are this one's then; else None.
    """

    flat: DecisionGraphModel | None = None

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began, self.flat = time.perf_counter(), None
        report = super().fit(data, seed=seed, progress=progress)
        train, held_out = self._parts
        del self._parts
        recent = _later_half(train), _later_half(held_out)  # what hung on the place may have changed unseen by one rule for all
        if any(self._hangs_on_place(*parts, report.predictor_loss) for parts in ((train, held_out), recent)):
            flat = DecisionGraphModel(self.cardinalities, self.n_actions, self.validation, self.parts)
            other = flat.fit(data, seed=seed)
            if _loss(other) < _loss(report):
                report = other
                self._take(flat)
        return replace(report, seconds=time.perf_counter() - began)

    def _take(self, flat: DecisionGraphModel) -> None:
        self.flat, self.fitted = flat, flat.fitted

    def _split(self, data: TransitionDataset, seed: int, since: Ints) -> tuple[TransitionBatch, TransitionBatch, Ints]:
        """As always; the parts are kept until the fit ends, so that either model is judged by the same transitions."""
        train, held_out, train_since = super()._split(data, seed, since)
        self._parts = train.select(np.arange(train_since.max(), len(train))), held_out  # as the rules are now
        return train, held_out, train_since

    def _hangs_on_place(self, train: TransitionBatch, held_out: TransitionBatch, loss: float | None) -> bool:
        """Whether a quick look at each cell for itself foretells held-out transitions better than what was learned of all.

        Args:
            train: transitions to learn from.
            held_out: those held out.
            loss: what held-out transitions cost the model of all positions, nats each; None where none was held out.
        """
        some, tests = thinned(train, SOME_ROWS), thinned(held_out, SOME_TESTS)
        if loss is None or loss < -FORETOLD or len(self.cardinalities) > MOST_CELLS or min(len(some), len(tests)) < 2:
            return False
        flat = DecisionGraphModel(self.cardinalities, self.n_actions, parts=self.parts)
        flat.fitted = fit_graphs(self.cardinalities, self.acts, some, np.zeros(len(some), dtype=np.bool_), False, False)
        logs = flat.log_prob(tests.states, tests.actions, tests.next_states, tests.terminated)
        return better(np.maximum(logs, IMPOSSIBLE), np.full(len(logs), -loss))

    def for_space(self, space: FactoredSpace | spaces.Space[Any]) -> LocalGraphModel:
        """See LocalGraphModel.

        Raises:
            ValueError: also where rules hang on the place.
        """
        if self.flat is not None:
            raise ValueError(
                "What this model learned hangs on the place on the planes, so planes of another size are unknown to it."
            )
        return super().for_space(space)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        return super().state_dict() if self.flat is None else self.flat.state_dict()

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of these planes and actions; nothing is changed then.
        """
        if "groups" not in state:
            super().load_state_dict(state)
            self.flat = None
            return
        flat = DecisionGraphModel(self.cardinalities, self.n_actions, self.validation, self.parts)
        flat.load_state_dict(state)
        self._take(flat)


def _later_half(rows: TransitionBatch) -> TransitionBatch:
    return rows.select(slice(len(rows) // 2, None))


def _loss(report: FitReport) -> float:
    """What held-out transitions cost, nats each; of none, infinitely much."""
    return float("inf") if report.predictor_loss is None else report.predictor_loss
