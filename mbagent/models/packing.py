"""From torch modules to the plain arrays that the compiled kernels read."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from mbagent.models.base import Actions, States
from mbagent.models.kernels import (
    ACTIVATION_CODES,
    DenseWeights,
    Floats32,
    GroupWeights,
    Layout,
    dense_logits,
)
from mbagent.models.networks import Affine, Conditioner, DensePredictor, FactorCodec
from mbagent.models.plane_kernels import pack_planes, plane_logits
from mbagent.models.planes import PlanePredictor

CompiledBody: TypeAlias = Callable[[States, Actions], Floats32]
"""(states int64 [B, F], actions int64 [B]) -> logits float32 [B, O, K]; a row's result does not depend on its batch."""

CHUNK = 64
"""Rows that other torch bodies are evaluated on at once, always this many: matrix products round differently in
other sizes."""


def compiled_body(predictor: nn.Module, layout: Layout) -> CompiledBody:
    """A predictor with its present weights, for inference: compiled where there is a kernel for it, else by torch."""
    if isinstance(predictor, DensePredictor):
        dense = pack_dense(predictor)
        return lambda states, actions: dense_logits(states, actions, layout, dense)
    if isinstance(predictor, PlanePredictor):
        planes, width = pack_planes(predictor), predictor.codec.width
        return lambda states, actions: plane_logits(states, actions, planes, width)
    return lambda states, actions: in_chunks(predictor, states, actions)


@torch.inference_mode()
def in_chunks(predictor: nn.Module, states: States, actions: Actions) -> Floats32:
    """Logits float32 [B, O, K] of a torch body, evaluated ``CHUNK`` rows at a time, the last rows filled up with zeros."""
    parts = []
    for start in range(0, max(len(states), 1), CHUNK):
        rows = slice(start, min(start + CHUNK, len(states)))
        n = rows.stop - rows.start
        chunk_states = np.zeros((CHUNK, states.shape[1]), dtype=np.int64)
        chunk_actions = np.zeros(CHUNK, dtype=np.int64)
        chunk_states[:n], chunk_actions[:n] = states[rows], actions[rows]
        parts.append(predictor(torch.from_numpy(chunk_states), torch.from_numpy(chunk_actions)).numpy()[:n])
    return np.concatenate(parts).astype(np.float32, copy=False)


def pack_layout(codec: FactorCodec) -> Layout:
    """Where the codec's factors lie among its columns."""
    factor = codec.column_factor.numpy()
    start = np.searchsorted(factor, np.arange(len(codec.outputs))).astype(np.int64)
    return Layout(np.asarray(codec.outputs, dtype=np.int64), start, codec.n_state_columns, codec.n_actions, codec.n_steps)


def pack_dense(predictor: DensePredictor) -> DenseWeights:
    """A dense predictor's weights, padded to its widest hidden layer."""
    codec = predictor.codec
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    sizes = np.asarray([len(layer.bias) for layer in layers], dtype=np.int64)
    depth, width = len(sizes), int(sizes.max(initial=1))
    inner = np.zeros((max(depth - 1, 0), width, width), dtype=np.float32)
    bias = np.zeros((depth, width), dtype=np.float32)
    for level, layer in enumerate(layers):
        bias[level, : sizes[level]] = _array(layer.bias)
        if level:
            inner[level - 1, : sizes[level - 1], : sizes[level]] = _array(layer.weight).T
    out = _array(predictor.out.weight).T
    first, last = out, np.zeros((width, out.shape[1]), dtype=np.float32)
    if depth:
        first = np.zeros((codec.n_inputs, width), dtype=np.float32)
        first[:, : sizes[0]] = _array(layers[0].weight).T
        last[: sizes[-1]] = out
    stay = np.zeros((codec.n_actions * codec.n_steps, codec.n_state_columns), dtype=np.float32)
    if predictor.stay is not None:
        stay += _array(predictor.stay)
    return DenseWeights(
        np.ascontiguousarray(first),
        inner,
        bias,
        sizes,
        last,
        _array(predictor.out.bias),
        stay,
        ACTIVATION_CODES[predictor.activation],
    )


def pack_groups(conditioner: Conditioner) -> GroupWeights:
    """A conditioner's weights, group by group."""
    codec, size = conditioner.codec, conditioner.group_size
    n_groups, mask = len(conditioner.members), conditioner.groups.mask
    index = np.full(len(codec.outputs), -1, dtype=np.int64)
    index[conditioner.members.numpy()] = np.arange(n_groups)
    weight = conditioner.groups.weight if mask is None else conditioner.groups.weight * mask
    n_columns = codec.n_inputs + codec.n_columns
    columns = np.ascontiguousarray(_array(weight).reshape(n_groups, size, n_columns).transpose(0, 2, 1))
    readout = np.zeros((n_groups, size, codec.width), dtype=np.float32)
    offset = np.zeros((n_groups, codec.width), dtype=np.float32)
    used = slice(1, 2) if codec.all_binary else slice(None)  # the logit of a bit's value 0 is 0
    readout[:, :, used] = _array(conditioner.readout)
    offset[:, used] = _array(conditioner.offset)[:, 0]
    return GroupWeights(
        index,
        np.ascontiguousarray(columns[:, : codec.n_inputs]),
        np.ascontiguousarray(columns[:, codec.n_inputs :]),
        np.ascontiguousarray(_array(conditioner.groups.bias).reshape(n_groups, size)),
        readout,
        offset,
        ACTIVATION_CODES[conditioner.activation],
        conditioner.correction,
    )


def _array(tensor: Tensor) -> Floats32:
    with torch.no_grad():
        array: Floats32 = np.array(tensor.detach().numpy(), dtype=np.float32)
    return array
