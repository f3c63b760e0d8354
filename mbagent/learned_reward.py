"""A reward model fitted to the rewards met, for environments whose reward function is not at hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.base import Actions, Floats, States, hash_rows
from mbagent.models.networks import Affine, FactorCodec
from mbagent.models.planes import Convolution, cells_of
from mbagent.models.training import one_thread
from mbagent.spaces import PlaneLayout
from mbagent.transitions import TransitionBatch

MAX_CLASSES = 64
"""Up to this many distinct rewards are told apart as classes; more are met by regression."""

STEPS, BATCH, LEARNING_RATE = 1500, 256, 0.01
_CHUNK = 256


class LearnedReward:
    """Predicts the reward of (state, action, next state).

    Args:
        cardinalities: number of values of each state factor.
        n_actions: number of enumerated actions.
        planes: layout of the factors, where they form planes.
        seed: of weights and batches.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int, planes: PlaneLayout | None = None, seed: int = 0) -> None:
        """See the class."""
        self._codec, self._planes, self._seed = FactorCodec(cardinalities, n_actions), planes, seed
        self._values = np.zeros(1)
        self._classes = True
        self._build()

    def _build(self) -> None:
        generator = torch.Generator().manual_seed(self._seed)
        n_out = len(self._values) if self._classes else 1
        self._network: nn.Module
        if self._planes is not None:
            self._network = _PlaneReward(self._codec, self._planes, n_out, generator)
        else:
            self._network = _DenseReward(self._codec, n_out, generator)

    @one_thread()
    def fit(self, rows: TransitionBatch) -> float:
        """Learns from rows; returns the share of them whose reward comes out right (within 0.5% of the range)."""
        values = np.unique(rows.rewards)
        self._classes = len(values) <= MAX_CLASSES
        self._values = values if self._classes else np.array([values.mean(), max(values.std(), 1e-6)])
        self._build()
        distinct, weights = _distinct(rows)
        if len(values) > 1:
            self._train(distinct, torch.from_numpy(weights))
        got = self(distinct.states, distinct.actions, distinct.next_states)
        close = np.abs(got - distinct.rewards) <= 0.005 * max(float(np.ptp(values)), 1e-12)
        return float(np.average(close, weights=weights))

    def _train(self, rows: TransitionBatch, weights: Tensor) -> None:
        states, actions, next_states = (torch.from_numpy(part) for part in (rows.states, rows.actions, rows.next_states))
        if self._classes:
            targets = torch.from_numpy(np.searchsorted(self._values, rows.rewards))
        else:
            targets = torch.from_numpy((rows.rewards - self._values[0]) / self._values[1]).float()
        generator = torch.Generator().manual_seed(self._seed + 1)
        optimizer = torch.optim.Adam(self._network.parameters(), lr=LEARNING_RATE)
        for step in range(STEPS):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * min(1.0, 2.0 * (1.0 - step / STEPS))
            i = torch.randint(len(actions), (min(BATCH, len(actions)),), generator=generator)
            out = self._network(states[i], actions[i], next_states[i])
            if self._classes:
                losses = functional.cross_entropy(out, targets[i], reduction="none")
            else:
                losses = (out[:, 0] - targets[i]) ** 2
            optimizer.zero_grad(set_to_none=True)
            (losses * weights[i]).mean().backward()  # type: ignore[no-untyped-call]
            optimizer.step()

    @one_thread()
    @torch.inference_mode()
    def __call__(self, states: States, actions: Actions, next_states: States) -> Floats:
        """Expected rewards float64 [M]; a row's value does not depend on the rows beside it."""
        if len(self._values) == 1:
            return np.full(len(actions), self._values[0])
        parts = [np.zeros(0)]
        for start in range(0, len(actions), _CHUNK):
            rows = [np.ascontiguousarray(part[start : start + _CHUNK]) for part in (states, actions, next_states)]
            n = len(rows[1])
            # Always the same size: matrix products round differently in other sizes.
            padded = [np.concatenate([part, np.zeros((_CHUNK - n, *part.shape[1:]), part.dtype)]) for part in rows]
            out = self._network(*(torch.from_numpy(part) for part in padded))[:n]
            parts.append(self._expected(out).numpy())
        return np.concatenate(parts)

    def _expected(self, out: Tensor) -> Tensor:
        if not self._classes:
            return out[:, 0].double() * float(self._values[1]) + float(self._values[0])
        p = out.double().softmax(dim=1)
        p = torch.where(p < 0.01, 0.0, p)
        return (p / p.sum(dim=1, keepdim=True)) @ torch.from_numpy(self._values)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All weights, as arrays."""
        weights = {f"network.{name}": value.numpy().copy() for name, value in self._network.state_dict().items()}
        return {"values": self._values.copy(), "classes": np.array(self._classes), **weights}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Takes over what ``state_dict`` returned."""
        self._values, self._classes = np.array(state["values"]), bool(state["classes"])
        self._build()
        prefix = "network."
        weights = {k.removeprefix(prefix): torch.tensor(np.asarray(v)) for k, v in state.items() if k.startswith(prefix)}
        self._network.load_state_dict(weights)


class _DenseReward(nn.Module):
    """One hidden layer over state, action and next state."""

    def __init__(self, codec: FactorCodec, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.codec = codec
        self.first = Affine(codec.n_inputs + codec.n_state_columns, 64, generator)
        self.out = Affine(64, n_out, generator)

    def forward(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Class logits or a normalised reward [B, n_out]."""
        after = self.codec.inputs(next_states, actions)[:, : self.codec.n_state_columns]
        hidden = functional.relu(self.first(torch.cat((self.codec.inputs(states, actions), after), dim=1)))
        result: Tensor = self.out(hidden)
        return result


class _PlaneReward(nn.Module):
    """A convolution over the planes of both states; the maxima and sums of its features decide."""

    def __init__(self, codec: FactorCodec, layout: PlaneLayout, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.codec, self.layout, channels = codec, layout, 16
        n_planes = layout.channels * (1 if codec.all_binary else codec.width)
        self.first = Convolution(2 * n_planes + 1, channels, 3, generator)
        self.action = Affine(codec.n_actions, channels, generator)
        self.second = Affine(2 * channels, 32, generator)
        self.out = Affine(32, n_out, generator)

    def forward(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Class logits or a normalised reward [B, n_out]."""
        before, after = (cells_of(part, self.layout, self.codec) for part in (states, next_states))
        ones = torch.ones_like(before[:, :1])
        action = self.action(functional.one_hot(actions, self.codec.n_actions).to(before.dtype))
        hidden = functional.relu(self.first(torch.cat((before, after, ones), dim=1)) + action[:, :, None, None])
        pooled = torch.cat((hidden.amax(dim=(2, 3)), hidden.mean(dim=(2, 3))), dim=1)
        result: Tensor = self.out(functional.relu(self.second(pooled)))
        return result


def _distinct(rows: TransitionBatch) -> tuple[TransitionBatch, NDArray[np.float32]]:
    """Distinct (s, a, s', r), each weighted by its share among those of the same (s, a, s').

    A rare transition then counts as much as a frequent one, and a random reward keeps its distribution.
    """
    triples = hash_rows(np.concatenate([rows.states, rows.actions[:, None], rows.next_states], axis=1))
    bits = np.ascontiguousarray(rows.rewards).view(np.int64)
    _, first, counts = np.unique(np.stack([triples.view(np.int64), bits], axis=1), axis=0, return_index=True, return_counts=True)
    _, inverse = np.unique(triples[first], return_inverse=True)
    shares = counts / np.bincount(inverse, weights=counts)[inverse]
    return rows.select(first), shares.astype(np.float32)
