"""A dense network of the reward, and its evaluation in compiled code: a search scores thousands of transitions for a decision."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import Module, functional

from mbagent.models.arithmetic import RELU, Floats32, Ints, activate, add_products, add_rows
from mbagent.models.base import Actions, Floats, States
from mbagent.models.kernels import Layout, active_columns
from mbagent.models.networks import Affine, FactorCodec
from mbagent.models.packing import pack_layout
from mbagent_envs._compiled import compiled

HIDDEN = 64
"""Hidden nodes."""


class DenseReward(Module):
    """One hidden layer over state, action and next state."""

    def __init__(self, codec: FactorCodec, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.codec = codec
        self.first = Affine(codec.n_inputs + codec.n_state_columns, HIDDEN, generator)
        self.out = Affine(HIDDEN, n_out, generator)

    def forward(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Class logits or a normalised reward [B, n_out]."""
        after = self.codec.inputs(next_states, actions)[:, : self.codec.n_state_columns]
        hidden = functional.relu(self.first(torch.cat((self.codec.inputs(states, actions), after), dim=1)))
        result: Tensor = self.out(hidden)
        return result


class RewardWeights(NamedTuple):
    """The weights of a ``DenseReward`` for compiled code.

    Attributes:
        layout: of the columns.
        first: from columns of state, action and next state, [n, H].
        bias: of the hidden nodes, [H].
        last: to the outputs, padded to a multiple of four rows, [4 * m, H].
        last_bias: likewise, [4 * m].
        n_outputs: how many there are.
    """

    layout: Layout
    first: Floats32
    bias: Floats32
    last: Floats32
    last_bias: Floats32
    n_outputs: int


def pack_reward(network: DenseReward) -> RewardWeights:
    """A network's present weights."""
    with torch.no_grad():
        first, bias = network.first.weight.numpy(), network.first.bias.numpy()
        last, last_bias = network.out.weight.numpy(), network.out.bias.numpy()
        more = -len(last) % 4
        return RewardWeights(
            pack_layout(network.codec),
            np.ascontiguousarray(first.T),
            bias.copy(),
            np.pad(last, ((0, more), (0, 0))),
            np.pad(last_bias, (0, more)),
            len(last),
        )


@compiled
def _outputs(weights: RewardWeights, states: Ints, actions: Ints, next_states: Ints, out: Floats32) -> None:
    layout = weights.layout
    room, n_inputs = states.shape[1] + layout.n_steps, layout.n_state_columns + layout.n_steps * layout.n_actions
    columns, following = np.empty(2 * room, dtype=np.int64), np.empty(room, dtype=np.int64)
    hidden = np.empty((1, len(weights.bias)), dtype=np.float32)
    for b in range(len(states)):
        n = active_columns(states, b, actions[b], layout, columns)
        n_next = active_columns(next_states, b, actions[b], layout, following) - layout.n_steps
        for i in range(n_next):
            columns[n + i] = n_inputs + following[i]
        hidden[0] = weights.bias
        add_rows(weights.first, columns, n + n_next, hidden, 0)
        activate(hidden, 0, hidden.shape[1], RELU)
        out[b] = weights.last_bias
        add_products(hidden, 1, hidden.shape[1], weights.last, out[b : b + 1])


def reward_outputs(weights: RewardWeights, states: States, actions: Actions, next_states: States) -> Floats:
    """Outputs of the network, float64 [M, n_outputs]; a row's do not depend on the rows beside it."""
    out = np.empty((len(states), len(weights.last_bias)), dtype=np.float32)
    rows = [np.ascontiguousarray(part, dtype=np.int64) for part in (states, actions, next_states)]
    _outputs(weights, rows[0], rows[1], rows[2], out)
    return out[:, : weights.n_outputs].astype(np.float64)
