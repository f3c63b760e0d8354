"""A predictor for planes some steps ahead: the local body, applied once for each action of a string (paper 4.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.networks import RESIDUAL_START, Affine, FactorCodec, uniform
from mbagent.models.planes import Convolution, cells_of, logits_of, maximum
from mbagent.spaces import PlaneLayout


class PlaneStringPredictor(nn.Module):
    """Features of each cell, carried on through one block for each action, and read out once at the end.

    A body that sees two cells around each cannot say what the world looks like many steps on. Here a block (two 3x3
    convolutions and a global maximum, the same weights for every action of the string) is added to the features
    as often as there are actions, so sight grows with the string while the number of weights does not.

    Args:
        codec: the factors, one for each cell; its ``n_steps`` is the length of the string.
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
