"""Dependencies between variables according to the remaining connections: influences and variable groups (paper section 5).

"If we can find that some sets of variables are conditionally independent of one another, we can separate them into different
modules" (figures 11 and 12). Shapes: F state factors, O = F + 1 output factors (``terminated`` last), A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from mbagent.models.neural.network_pair import NetworkPair
from mbagent.models.neural.networks import Affine, Conditioner, DensePredictor
from mbagent.models.neural.truth_tables import PARENT
from mbagent.types import Floats, Ints


@dataclass(frozen=True)
class Influence:
    """Sums of absolute weights over all paths to each output factor; 0 if there is no path.

    Attributes:
        states: from each state factor, in the predictor, [O, F].
        actions: from each action, in the predictor, [O, A].
        others: from each other output factor, in the conditioner, [O, O].
        conditions: from each state factor, in the conditioner, [O, F].
    """

    states: Floats
    actions: Floats
    others: Floats
    conditions: Floats


@dataclass(frozen=True)
class VariableGroup:
    """A connected component of the dependency graph.

    Attributes:
        outputs: output factors, int64.
        inputs: state factors with a path to them, int64.
        action: whether the action has a path to them.
    """

    outputs: Ints
    inputs: Ints
    action: bool

    def text(self, names: Sequence[str]) -> str:
        """The group as one line of text, with the names of the state factors."""
        names = [*names, "terminated"]
        given = [names[i] for i in self.inputs] + ["action"] * self.action
        return f"{', '.join(names[i] for i in self.outputs)} <- {', '.join(given) or 'nothing'}"


def influence(model: NetworkPair, *, effective: bool = False) -> Influence:
    """The sums over paths of both networks.

    Args:
        model: the networks.
        effective: whether to omit, in a pruned model of bits, dependencies without effect, such as paths that cancel each other
            (see ``truth_tables.find_parents``).

    Raises:
        ValueError: the predictor is not a dense one: weights shared over positions have no variables of their own.
    """
    if not isinstance(model.predictor, DensePredictor):
        raise ValueError("Sums over paths need networks on flat variables; this model shares its weights over positions.")
    codec, predictor = model.codec, model.predictor
    layers = [_absolute(layer) for layer in (*predictor.layers, predictor.out) if isinstance(layer, Affine)]
    columns = layers[0]
    for layer in layers[1:]:
        columns = layer @ columns
    if predictor.stay is not None:
        n = codec.n_state_columns
        columns[np.arange(n), np.arange(n)] += np.abs(predictor.stay.detach().numpy()).max(axis=0)
    factor = codec.column_factor.numpy()
    n_outputs, n_state = len(codec.outputs), codec.n_state_columns
    of_outputs = (factor == np.arange(n_outputs)[:, None]).astype(np.float64)
    of_states = of_outputs[:-1, :n_state].T
    rows = of_outputs @ columns
    others, conditions = np.zeros((n_outputs, n_outputs)), np.zeros((n_outputs, n_outputs - 1))
    if model.conditioner is not None and len(model.conditioner.members):
        seen = _conditioner_sums(model.conditioner)
        members = model.conditioner.members.numpy()
        others[members] = seen[:, codec.n_inputs :] @ of_outputs.T
        conditions[members] = seen[:, :n_state] @ of_states
    states = rows[:, :n_state] @ of_states
    if effective and len(model.parents):
        matters, n = model.parents == PARENT, states.shape[1]
        states, conditions, others = states * matters[:, :n], conditions * matters[:, :n], others * matters[:, n:]
    return Influence(states, rows[:, n_state:], others, conditions)


def _absolute(layer: Affine) -> Floats:
    absolute: Floats = np.abs(layer.weight.detach().numpy()).astype(np.float64)
    return absolute


def _conditioner_sums(conditioner: Conditioner) -> Floats:
    """Sums from columns of (s, a) and of the next factors to each group's output, [g, n_inputs + n_columns]."""
    groups = _absolute(conditioner.groups)
    if conditioner.groups.mask is not None:
        groups *= conditioner.groups.mask.numpy()
    readout = np.abs(conditioner.readout.detach().numpy()).max(axis=2)
    grouped = groups.reshape(len(readout), conditioner.group_size, -1)
    sums: Floats = np.einsum("gh,ghc->gc", readout, grouped)
    return sums


def modules(found: Influence) -> list[VariableGroup]:
    """Independent groups of variables, linked by one-step dependencies; largest first, without isolated variables."""
    n = len(found.states)
    links = np.zeros((n, n), dtype=np.bool_)
    links[:, : n - 1] = found.states > 0.0
    return _modules(found, links)


def dependent_groups(found: Influence) -> list[VariableGroup]:
    """Groups of variables that depend on each other given state and action, by the conditioner; largest first."""
    return _modules(found, found.others > 0.0)


def _modules(found: Influence, links: NDArray[np.bool_]) -> list[VariableGroup]:
    """The connected components of more than one variable, or of one that depends on itself."""
    _, label = connected_components(csr_matrix(links.astype(np.int64)), directed=False)
    result = []
    for component in range(label.max() + 1):
        members = np.flatnonzero(label == component)
        if not links[np.ix_(members, members)].any():
            continue
        leads = (found.states[members] > 0.0).any(axis=0) | (found.conditions[members] > 0.0).any(axis=0)
        result.append(VariableGroup(members, np.flatnonzero(leads), bool((found.actions[members] > 0.0).any())))
    return sorted(result, key=lambda module: -len(module.outputs))
