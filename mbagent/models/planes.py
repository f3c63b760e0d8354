"""A predictor for planes: weights shared over positions, and events felt everywhere at once (paper section 5).

Parts of the world that are alike share their parameters, which is the paper's modular, object-oriented knowledge: what
a wall does is learned once, not once for every cell.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.networks import RESIDUAL_START, Affine, FactorCodec, uniform
from mbagent.spaces import PlaneLayout


class PlanePredictor(nn.Module):
    """Two 3x3 convolutions over the planes, each followed by a global maximum fed back to every position.

    The border is seen through zero padding beside a plane of ones. The action enters every position. A learned residual
    path leads from each cell to itself. ``terminated`` is read from the global maxima.

    Args:
        codec: the factors, one for each cell.
        layout: where the cells lie.
        channels: features at each position.
        generator: source of the first weights.
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
    """Planes float [B, C, H, W] of states int64 [B, F]; [B, C * K, H, W], one-hot, where cells have more than two values."""
    if layout.channels_last:
        cells = states.view(-1, layout.height, layout.width, layout.channels).permute(0, 3, 1, 2)
    else:
        cells = states.view(-1, layout.channels, layout.height, layout.width)
    if codec.all_binary:
        return cells.to(torch.float32)
    return functional.one_hot(cells, codec.width).to(torch.float32).permute(0, 1, 4, 2, 3).flatten(1, 2)


def logits_of(planes: Tensor, end: Tensor, layout: PlaneLayout, codec: FactorCodec) -> Tensor:
    """Logits [B, O, K] from those of the planes [B, C * K, H, W] (bits: [B, C, H, W]) and of ``terminated`` [B, 1]."""
    values = planes.shape[1] // layout.channels
    split = planes.view(len(planes), layout.channels, values, layout.height, layout.width)
    order = (0, 3, 4, 1, 2) if layout.channels_last else (0, 1, 3, 4, 2)
    cells = split.permute(order).reshape(len(planes), -1, values)
    if codec.all_binary:
        return codec.logits(torch.cat((cells[:, :, 0], end), dim=1))
    last = torch.cat((torch.zeros_like(end), end, end.new_zeros(len(end), values - 2)), dim=1)
    return torch.cat((cells, last[:, None]), dim=1) + codec.floor


class Convolution(nn.Module):
    """``nn.Conv2d`` that keeps the size and takes its first weights from a generator of its own."""

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
