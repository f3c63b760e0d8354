"""The networks of the paper's section 3: predictor (3.1), with a variant for planes, and conditioner (3.2).

The paper's variables are bits; here a variable is a *factor* with any number of values (a bit is a factor with two), and
termination is an additional output factor, the last. On planes, weights are shared over positions (paper section 5), so the
effect of a wall is learned once, not for every cell. For strings of actions on planes (paper 4.2), the same block is applied
once per action.
Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, G hidden nodes in a group.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mbagent.spaces import PlaneLayout

Mask: TypeAlias = Literal["causal", "others"]
"""Next factors that are inputs of a conditioner's output i: y_<i ("causal") or all but y_i ("others", the paper's)."""

Activation: TypeAlias = Literal["sigmoid", "relu", "silu", "tanh"]

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "sigmoid": torch.sigmoid,
    "relu": torch.relu,
    "silu": functional.silu,
    "tanh": torch.tanh,
}

MASKED_LOGIT = -1e9
"""The logit of a value that a factor does not have."""

RESIDUAL_START = 2.0
"""Initial logit of "this factor keeps its value", which is the most common case."""


LARGE_GROUP = 2**15
"""Number of hidden values of one group in a batch from which groups are computed separately, each in the processor's cache:
three times as fast as all at once for large groups, but half as fast for small ones."""


class FactorCodec(nn.Module):
    """Converts factors to network inputs, and columns of network outputs to logits.

    A factor with two values is one 0/1 column, as in the paper; a factor with any other number k of values is k one-hot columns.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        n_steps: length of the string of actions that forms one action of the model (paper 4.2: "each action in the string
            occupies an additional group of inputs"). Strings are numbered in base A; the first action is the lowest digit.

    Attributes:
        outputs: cardinalities of the O = F + 1 output factors; the last is ``terminated``.
        width: K, the largest of ``outputs``.
        n_inputs: number of columns of (state, action).
        n_columns: number of columns of the output factors.
    """

    def __init__(self, cardinalities: Sequence[int], n_actions: int, n_steps: int = 1) -> None:
        super().__init__()
        self.cardinalities = tuple(int(c) for c in cardinalities)
        self.outputs = (*self.cardinalities, 2)
        self.n_actions, self.n_steps = int(n_actions), int(n_steps)
        self.width = max(self.outputs)
        factor, value = _columns(self.outputs)
        self.n_columns = len(factor)
        self.n_state_columns = int((factor < len(self.cardinalities)).sum())
        self.n_inputs = self.n_state_columns + self.n_steps * self.n_actions
        self.all_binary = all(c == 2 for c in self.outputs)
        self.column_factor: Tensor
        self.column_value: Tensor
        self.slots: Tensor
        self.floor: Tensor
        self.single_actions: Tensor
        self._constant("column_factor", torch.from_numpy(factor))
        self._constant("column_value", torch.from_numpy(value))
        self._constant("single_actions", torch.eye(self.n_actions))
        self._constant("slots", torch.from_numpy(factor * self.width + value))
        possible = np.arange(self.width) < np.asarray(self.outputs)[:, None]
        self._constant("floor", torch.from_numpy(np.where(possible, 0.0, MASKED_LOGIT).astype(np.float32)))

    def _constant(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Columns of (state, action), float [B, n_inputs], from states int64 [B, F] and actions int64 [B]."""
        n = self.n_state_columns
        state = self._one_hot(states, self.column_factor[:n], self.column_value[:n])
        return torch.cat((state, self.action_columns(actions)), dim=1)

    def action_columns(self, actions: Tensor) -> Tensor:
        """One-hot columns of the actions in each string, in order: float [B, n_steps * A], from strings int64 [B]."""
        return torch.cat([self.single_actions[step] for step in self.action_steps(actions)], dim=1)

    def action_steps(self, actions: Tensor) -> list[Tensor]:
        """The first, second, ... action of each string, each int64 [B]."""
        if self.n_steps == 1:
            return [actions]
        return [actions // self.n_actions**k % self.n_actions for k in range(self.n_steps)]

    def targets(self, factors: Tensor) -> Tensor:
        """Columns of output factors, float [B, n_columns], from int64 [B, O]."""
        return self._one_hot(factors, self.column_factor, self.column_value)

    def _one_hot(self, factors: Tensor, factor: Tensor, value: Tensor) -> Tensor:
        if self.all_binary:
            return factors[:, : len(factor)].to(torch.float32)
        return (factors[:, factor] == value).to(torch.float32)

    def logits(self, columns: Tensor) -> Tensor:
        """Logits [B, O, K] from output columns [B, n_columns]; value 0 of a binary factor has the logit 0."""
        if self.all_binary:
            return torch.stack((torch.zeros_like(columns), columns), dim=2)
        flat = columns.new_zeros(len(columns), len(self.outputs) * self.width)
        flat = flat.index_copy(1, self.slots, columns)
        return flat.view(-1, len(self.outputs), self.width) + self.floor


class Predictor(Protocol):
    """Interface of predictor bodies: an ``nn.Module`` that computes each output factor's logits from a state and an action."""

    def __call__(self, states: Tensor, actions: Tensor) -> Tensor:
        """Logits [B, O, K] from states int64 [B, F] and actions int64 [B]; ``MASKED_LOGIT`` for values a factor does not have."""
        ...


class Affine(nn.Module):
    """``nn.Linear`` whose initial weights are drawn from a given generator instead of the process-wide one.

    Args:
        n_in: inputs.
        n_out: outputs.
        generator: source of the weights.
        mask: bool [n_out, n_in], False for disabled weights, which are zero and get no gradient. None: all weights are enabled.
        fan_in: number of inputs connected to one output, which sets the scale of the initial weights (default: n_in).
    """

    def __init__(
        self,
        n_in: int,
        n_out: int,
        generator: torch.Generator,
        mask: Tensor | None = None,
        fan_in: int | None = None,
    ) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(max(1, fan_in or n_in))
        self.weight = nn.Parameter(uniform((n_out, n_in), bound, generator))
        self.bias = nn.Parameter(uniform((n_out,), bound, generator))
        self.mask: Tensor | None
        self.register_buffer("mask", mask)
        if mask is not None:
            self.weight.data *= mask

    def forward(self, values: Tensor) -> Tensor:
        """Outputs [B, n_out] from inputs [B, n_in]."""
        weight = self.weight if self.mask is None else self.weight * self.mask
        return functional.linear(values, weight, self.bias)


class Dropout(nn.Module):
    """Dropout that is active only while a generator is set.

    ``nn.Dropout`` would draw from the process-wide generator. The trainer sets and removes ``generator``.

    Args:
        share: fraction of inputs zeroed, in [0, 1), rounded to a multiple of 1/256; the others are scaled up to preserve the
            mean.
    """

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share
        self.generator: torch.Generator | None = None

    def forward(self, values: Tensor) -> Tensor:
        """Values after dropout, same shape."""
        if self.generator is None or self.share == 0.0:
            return values
        # The eight bytes of a random word are used for eight values: bernoulli_ would take a third of a training step.
        words = torch.empty(values.numel() // 8 + 1, dtype=torch.int64).random_(-(2**63), None, generator=self.generator)
        kept = words.view(torch.uint8)[: values.numel()].view(values.shape) >= round(256 * self.share)
        return values * kept.to(values.dtype).mul_(1.0 / (1.0 - round(256 * self.share) / 256))


class DensePredictor(nn.Module):
    """The predictor network (paper 3.1): a dense network from state and action to each next factor's logits.

    Args:
        codec: the factors.
        hidden: sizes of the hidden layers (the paper: a single layer of size 2d + 1).
        activation: of the hidden nodes (the paper: sigmoid).
        residual: whether to add a learned path from each s_i to s'_i, with one weight for each (action column, state column).
        dropout: share of hidden nodes zeroed in each training step.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        codec: FactorCodec,
        hidden: Sequence[int] = (128,),
        activation: Activation = "silu",
        residual: bool = True,
        dropout: float = 0.0,
        *,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.codec = codec
        self.activation = activation
        sizes = (codec.n_inputs, *hidden)
        self.layers = nn.ModuleList(Affine(a, b, generator) for a, b in itertools.pairwise(sizes))
        self.dropout = Dropout(dropout)
        self.out = Affine(sizes[-1], codec.n_columns, generator)
        if residual:
            self.out.weight.data *= 0.1  # start near "nothing changes"
        self.stay: nn.Parameter | None = None
        if residual:
            self.stay = nn.Parameter(
                torch.full((codec.n_actions * codec.n_steps, codec.n_state_columns), RESIDUAL_START / codec.n_steps)
            )

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """See Predictor."""
        inputs = values = self.codec.inputs(states, actions)
        for layer in self.layers:
            values = self.dropout(ACTIVATIONS[self.activation](layer(values)))
        columns = self.out(values)
        if self.stay is not None:
            n = self.codec.n_state_columns
            signed = 2.0 * inputs[:, :n] - 1.0
            columns = torch.cat((columns[:, :n] + inputs[:, n:] @ self.stay * signed, columns[:, n:]), dim=1)
        return self.codec.logits(columns)


class Conditioner(nn.Module):
    """The conditioner network (paper 3.2): output i is the distribution of y_i given (s, a) and other next factors.

    The hidden layer consists of groups, one for each output. The inputs of group i are (s, a) and either the next factors y_<i
    (mask "causal") or all next factors except y_i (mask "others"). Output i depends only on group i, hence not on y_i. Outputs
    of which the predictor is certain need no group: the conditioner's logits for them are 0, which leaves the predictor's logits
    unchanged.

    Args:
        codec: the factors.
        mask: the next factors that are inputs of a group.
        group_size: number of hidden nodes G in a group (the paper: 2d, out of 2d^2 + 1 in total).
        activation: of the hidden nodes.
        correction: True: outputs are added to the predictor's logits, and are zero before training; False: outputs are used
            alone (the paper).
        dropout: share of hidden nodes zeroed in each training step.
        grouped: bool [O], which outputs have a group; None: all. Ignored unless ``correction`` is True.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        codec: FactorCodec,
        mask: Mask = "causal",
        group_size: int = 16,
        activation: Activation = "silu",
        correction: bool = True,
        dropout: float = 0.0,
        grouped: Tensor | None = None,
        *,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.codec = codec
        self.group_size = group_size
        self.activation = activation
        self.correction = correction
        self.grouped: Tensor
        everything = torch.ones(len(codec.outputs), dtype=torch.bool)
        self.register_buffer("grouped", everything if grouped is None or not correction else grouped.clone())
        self.members = torch.nonzero(self.grouped)[:, 0]
        visible = group_mask(codec, mask, group_size, self.members)
        fan_in = codec.n_inputs + codec.n_columns // 2
        self.groups = Affine(codec.n_inputs + codec.n_columns, len(visible), generator, visible, fan_in)
        self.dropout = Dropout(dropout)
        n_values = 1 if codec.all_binary else codec.width
        bound = 0.0 if correction else 1.0 / math.sqrt(group_size)
        self.readout = nn.Parameter(uniform((len(self.members), group_size, n_values), bound, generator))
        self.offset = nn.Parameter(uniform((len(self.members), 1, n_values), bound, generator))

    def forward(self, states: Tensor, actions: Tensor, next_factors: Tensor) -> Tensor:
        """Logits [B, O, K] from states int64 [B, F], actions int64 [B], next_factors int64 [B, O] (see ``from_columns``)."""
        return self.from_columns(self.codec.inputs(states, actions), self.codec.targets(next_factors))

    def from_columns(self, inputs: Tensor, targets: Tensor) -> Tensor:
        """Logits [B, O, K] from columns of (s, a) [B, n_inputs] and next factors [B, n_columns] (bits or probabilities)."""
        codec, n_groups = self.codec, len(self.members)
        columns = torch.cat((inputs, targets), dim=1)
        if len(columns) * self.group_size >= LARGE_GROUP:
            values = self._one_by_one(columns)
        else:
            hidden = ACTIVATIONS[self.activation](self.groups(columns))
            grouped = self.dropout(hidden).view(len(columns), n_groups, self.group_size).transpose(0, 1)
            values = (torch.bmm(grouped, self.readout) + self.offset).transpose(0, 1)
        if n_groups < len(codec.outputs):
            spread = values.new_zeros(len(values), len(codec.outputs), values.shape[2])
            values = spread.index_copy(1, self.members, values)
        if codec.all_binary:
            return codec.logits(values[:, :, 0])
        return values + codec.floor

    def _one_by_one(self, columns: Tensor) -> Tensor:
        """The groups' outputs [B, g, n_values], computed group by group."""
        groups, activation = self.groups, ACTIVATIONS[self.activation]
        weights = groups.weight if groups.mask is None else groups.weight * groups.mask
        values = [
            self.dropout(activation(functional.linear(columns, weight, bias))) @ readout + offset
            for weight, bias, readout, offset in zip(
                torch.split(weights, self.group_size),
                torch.split(groups.bias, self.group_size),
                self.readout,
                self.offset,
                strict=True,
            )
        ]
        return torch.stack(values, dim=1)


def group_mask(codec: FactorCodec, mask: Mask, group_size: int, outputs: Tensor) -> Tensor:
    """Input mask of each hidden node in the groups of ``outputs``, bool [groups * group_size, n_inputs + n_columns]."""
    own = outputs[:, None]
    seen = codec.column_factor < own if mask == "causal" else codec.column_factor != own
    everything = torch.ones(len(outputs), codec.n_inputs, dtype=torch.bool)
    return torch.cat((everything, seen), dim=1).repeat_interleave(group_size, dim=0)


def uniform(shape: Sequence[int], bound: float, generator: torch.Generator) -> Tensor:
    """Uniform random numbers in [-bound, bound), drawn from ``generator``."""
    return (torch.rand(tuple(shape), generator=generator) * 2.0 - 1.0) * bound


def _columns(cardinalities: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Factor and value of each column, int64 [n_columns] each."""
    pairs = [(f, v) for f, c in enumerate(cardinalities) for v in (range(c) if c != 2 else (1,))]
    factor, value = np.asarray(pairs, dtype=np.int64).reshape(-1, 2).T
    return np.ascontiguousarray(factor), np.ascontiguousarray(value)


class PlanePredictor(nn.Module):
    """Two 3x3 convolutions; a linear map of each one's global maxima is added to the next layer at every position.

    Borders are represented by zero padding of an additional plane of ones. The action is an input at every position. Each cell
    has a learned residual path to itself. ``terminated`` is computed from the global maxima.

    Args:
        codec: the factors, one for each cell.
        layout: layout of the cells.
        channels: number of features at each position.
        generator: source of the initial weights.
    """

    def __init__(self, codec: FactorCodec, layout: PlaneLayout, channels: int = 16, *, generator: torch.Generator) -> None:
        """See the class."""
        super().__init__()
        self.codec, self.layout = codec, layout
        self.values = 1 if codec.all_binary else codec.width
        n_planes = layout.channels * self.values
        self.first = Convolution(n_planes + 1, channels, 3, generator)
        self.action = nn.Parameter(uniform((codec.n_actions, channels), 1.0, generator))
        self.second = Convolution(channels, channels, 3, generator)
        self.second_top = Affine(channels, channels, generator)
        self.out = Convolution(channels, n_planes, 1, generator)
        self.out_top = Affine(channels, n_planes, generator)
        self.end = Affine(channels, 1, generator)
        self.stay = nn.Parameter(torch.full((layout.channels,), 2.0 * RESIDUAL_START))

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """See networks.Predictor."""
        cells = cells_of(states, self.layout, self.codec)
        ones = torch.ones_like(cells[:, :1])
        action = self.action[actions][:, :, None, None]
        hidden = functional.relu(self.first(torch.cat((cells, ones), dim=1)) + action)
        hidden = functional.relu(self.second(hidden) + self.second_top(maximum(hidden))[:, :, None, None])
        top = maximum(hidden)
        stay = self.stay.repeat_interleave(self.values)[:, None, None]
        planes = self.out(hidden) + self.out_top(top)[:, :, None, None] + stay * (2.0 * cells - 1.0)
        return logits_of(planes, self.end(top), self.layout, self.codec)


def cells_of(states: Tensor, layout: PlaneLayout, codec: FactorCodec) -> Tensor:
    """Planes float [B, C, H, W] of states int64 [B, F]; one-hot [B, C * K, H, W] if cells have more than two values."""
    if layout.channels_last:
        cells = states.view(-1, layout.height, layout.width, layout.channels).permute(0, 3, 1, 2)
    else:
        cells = states.view(-1, layout.channels, layout.height, layout.width)
    if codec.all_binary:
        return cells.to(torch.float32)
    return functional.one_hot(cells, codec.width).to(torch.float32).permute(0, 1, 4, 2, 3).flatten(1, 2)


def logits_of(planes: Tensor, end: Tensor, layout: PlaneLayout, codec: FactorCodec) -> Tensor:
    """Logits [B, O, K] combined from logits of planes [B, C * K, H, W] (bits: [B, C, H, W]) and ``terminated`` [B, 1]."""
    values = planes.shape[1] // layout.channels
    split = planes.view(len(planes), layout.channels, values, layout.height, layout.width)
    order = (0, 3, 4, 1, 2) if layout.channels_last else (0, 1, 3, 4, 2)
    cells = split.permute(order).reshape(len(planes), -1, values)
    if codec.all_binary:
        return codec.logits(torch.cat((cells[:, :, 0], end), dim=1))
    last = torch.cat((torch.zeros_like(end), end, end.new_zeros(len(end), values - 2)), dim=1)
    return torch.cat((cells, last[:, None]), dim=1) + codec.floor


class Convolution(nn.Module):
    """``nn.Conv2d`` that preserves height and width and draws its initial weights from a given generator."""

    def __init__(self, n_in: int, n_out: int, size: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(n_in * size * size)
        self.weight = nn.Parameter(uniform((n_out, n_in, size, size), bound, generator))
        self.bias = nn.Parameter(uniform((n_out,), bound, generator))

    def forward(self, planes: Tensor) -> Tensor:
        """Planes [B, n_out, H, W] from [B, n_in, H, W]."""
        return functional.conv2d(planes, self.weight, self.bias, padding="same")


def maximum(planes: Tensor) -> Tensor:
    """The global maximum [B, C] of each plane [B, C, H, W]."""
    return planes.amax(dim=(2, 3))


class PlaneStringPredictor(nn.Module):
    """Computes features of each cell, updates them by one residual block per action, and applies one output layer at the end.

    A receptive field of two cells in each direction is too small for predictions over many steps. Here, a block of two 3x3
    convolutions and a global maximum is applied once per action of the string, always with the same weights. So the receptive
    field grows with the length of the string, while the number of weights does not.

    Args:
        codec: the factors, one for each cell; its ``n_steps`` is the length of the string.
        layout: layout of the cells.
        channels: number of features at each position.
        generator: source of the initial weights.
    """

    def __init__(self, codec: FactorCodec, layout: PlaneLayout, channels: int = 16, *, generator: torch.Generator) -> None:
        """See the class."""
        super().__init__()
        self.codec, self.layout = codec, layout
        self.values = 1 if codec.all_binary else codec.width
        n_planes = layout.channels * self.values
        self.enter = Convolution(n_planes + 1, channels, 3, generator)
        self.first = Convolution(channels, channels, 3, generator)
        self.action = nn.Parameter(uniform((codec.n_actions, channels), 1.0, generator))
        self.second = Convolution(channels, channels, 3, generator)
        self.top = Affine(channels, channels, generator)
        self.out = Convolution(channels, n_planes, 1, generator)
        self.end = Affine(channels, 1, generator)
        self.stay = nn.Parameter(torch.full((layout.channels,), RESIDUAL_START / codec.n_steps))

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """See networks.Predictor."""
        cells = cells_of(states, self.layout, self.codec)
        features = functional.relu(self.enter(torch.cat((cells, torch.ones_like(cells[:, :1])), dim=1)))
        for step in self.codec.action_steps(actions):
            hidden = functional.relu(self.first(features) + self.action[step][:, :, None, None])
            features = features + self.second(hidden) + self.top(maximum(hidden))[:, :, None, None]
            features = functional.relu(features)
        stay = self.stay.repeat_interleave(self.values)[:, None, None]
        planes = self.out(features) + stay * (2.0 * cells - 1.0)
        return logits_of(planes, self.end(maximum(features)), self.layout, self.codec)
