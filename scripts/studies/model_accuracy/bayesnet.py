"""A dynamic Bayesian network learned by pyAgrum with textbook methods: a baseline with the models' protocol.

Each factor of the next state, and termination, has parents among the state's factors and the action, found by hill climbing on
BIC; probabilities come from full conditional tables with a smoothing prior. Needs ``pip install "mbagent[yardsticks]"``.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionDataset
from mbagent.models.base import BaseTransitionModel
from mbagent.models.fit_report import FitReport
from mbagent.models.protocol import as_keys
from mbagent.models.registry import register_model
from mbagent.spaces import FactoredSpace
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs.random_keys import uniforms

MOST_PARENTS = 8
"""Maximum number of parents of a variable: full tables grow exponentially with it."""

SMOOTHING = 0.2


class BayesNetModel(BaseTransitionModel):
    """A two-slice Bayesian network; next values are independent given state and action.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int) -> None:
        """See the class."""
        super().__init__(cardinalities, n_actions)
        self._sizes = np.array([*self.cardinalities, self.n_actions])
        self._parents: list[NDArray[np.int64]] = []
        self._tables: list[Floats] = []

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel; no transitions are held out."""
        began, rows = time.perf_counter(), data.rows()
        now = [*(f"x{f}" for f in range(len(self.cardinalities))), "a"]
        then = [*(f"y{f}" for f in range(len(self.cardinalities))), "over"]
        table = np.column_stack([rows.states, rows.actions, rows.next_states, rows.terminated])
        net = _learn(table, now, then, [*self.cardinalities, self.n_actions, *self.cardinalities, 2])
        self._parents, self._tables = [], []
        for name in then:
            cpt = net.cpt(name)
            array = np.asarray(cpt.toarray())
            self._tables.append(array)
            self._parents.append(np.array([now.index(axis) for axis in _axes(array, cpt, name)[:-1]], dtype=np.int64))
        return FitReport(n_train=len(rows), n_validation=0, epochs=1, seconds=time.perf_counter() - began)

    def _distributions(self, states: States, actions: Actions) -> list[Floats]:
        given = np.column_stack([states, actions])
        return [
            np.broadcast_to(table, (len(states), table.shape[-1])) if len(parents) == 0 else table[tuple(given[:, parents].T)]
            for parents, table in zip(self._parents, self._tables, strict=True)
        ]

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        noise = uniforms(as_keys(rng, len(states)), len(self._tables))
        drawn = [
            (p.cumsum(axis=1) < u[:, None]).sum(axis=1).clip(0, p.shape[1] - 1)
            for p, u in zip(self._distributions(states, actions), noise.T, strict=True)
        ]
        return np.stack(drawn[:-1], axis=1).astype(np.int64), drawn[-1] == 1

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        return np.concatenate(self._distributions(states, actions)[:-1], axis=1)

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        values, every = np.column_stack([next_states, terminated]).astype(np.int64), np.arange(len(states))
        with np.errstate(divide="ignore"):
            logs = [np.log(p[every, values[:, f]]) for f, p in enumerate(self._distributions(states, actions))]
        result: Floats = np.sum(logs, axis=0)
        return result

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Empty, since this baseline is not saved."""
        return {}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See ``state_dict``."""
        del state


def _learn(table: NDArray[np.int64], now: list[str], then: list[str], sizes: list[int]) -> Any:
    """Learns the network, with parents of ``then`` among ``now``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # if warnings are errors, the import would end the process
        import pyagrum  # noqa: PLC0415 - optional

    template, names = pyagrum.BayesNet(), [*now, *then]
    for name, size in zip(names, sizes, strict=True):
        template.add(pyagrum.RangeVariable(name, name, 0, max(int(size) - 1, 1)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.csv"
        np.savetxt(path, table, fmt="%d", delimiter=",", header=",".join(names), comments="")
        learner = pyagrum.BNLearner(str(path), template)
        learner.setNumberOfThreads(1)
        learner.useScoreBIC()
        learner.useSmoothingPrior(SMOOTHING)
        learner.useGreedyHillClimbing()
        learner.setMaxIndegree(MOST_PARENTS)
        for group in (now, then):
            for first in group:
                for second in group:
                    if first != second:
                        learner.addForbiddenArc(first, second)
        for first in then:
            for second in now:
                learner.addForbiddenArc(first, second)
        return learner.learnBN()


def _axes(array: Floats, cpt: Any, name: str) -> list[str]:
    """Names of the axes of a conditional table: its own variable is the last one, parents come before in reverse order."""
    names = [str(other) for other in cpt.names if other != name]
    axes = [*reversed(names), name]
    sizes = {str(variable.name()): int(variable.domainSize()) for variable in cpt.variablesSequence()}
    assert [sizes[axis] for axis in axes] == list(array.shape)
    return axes


def register() -> None:
    """Registers ``bayesnet`` as a model's name."""
    register_model("bayesnet", _build)


def _build(space: FactoredSpace, n_actions: int, learning_rate: float) -> BayesNetModel:
    del learning_rate
    return BayesNetModel(space.cardinalities, n_actions)
