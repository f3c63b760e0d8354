"""Conversion of torch modules to plain arrays for the compiled kernels, and evaluation of modules that have no kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from mbagent.models.neural.kernels import ACTIVATION_CODES, DenseWeights, Floats32, GroupWeights, Layout, dense_logits
from mbagent.models.neural.networks import Affine, Conditioner, DensePredictor, FactorCodec
from mbagent.types import Actions, States

CompiledBody: TypeAlias = Callable[[States, Actions], Floats32]
"""(states int64 [B, F], actions int64 [B]) -> logits float32 [B, O, K]; a row's result does not depend on its batch."""

ROWS_PER_CHUNK = 64
"""Rows per evaluation of torch bodies without a kernel; always this number, since matrix products round differently in other
sizes."""


LANES = 16
"""Hidden layers are padded with zeros to a multiple of this, for vector instructions."""


def compiled_body(predictor: nn.Module) -> CompiledBody:
    """Inference function for a predictor's current weights: compiled if the predictor has a kernel, else by torch."""
    if isinstance(predictor, DensePredictor):
        dense = pack_dense(predictor)
        return lambda states, actions: dense_logits(states, actions, dense)
    return lambda states, actions: in_chunks(predictor, states, actions)


@torch.inference_mode()
def in_chunks(predictor: nn.Module, states: States, actions: Actions) -> Floats32:
    """Logits float32 [B, O, K] of a torch predictor, in chunks of ``ROWS_PER_CHUNK`` rows; the last is zero-padded."""
    parts = []
    for start in range(0, max(len(states), 1), ROWS_PER_CHUNK):
        rows = slice(start, min(start + ROWS_PER_CHUNK, len(states)))
        n = rows.stop - rows.start
        chunk_states = np.zeros((ROWS_PER_CHUNK, states.shape[1]), dtype=np.int64)
        chunk_actions = np.zeros(ROWS_PER_CHUNK, dtype=np.int64)
        chunk_states[:n], chunk_actions[:n] = states[rows], actions[rows]
        parts.append(predictor(torch.from_numpy(chunk_states), torch.from_numpy(chunk_actions)).numpy()[:n])
    return np.ascontiguousarray(np.concatenate(parts), dtype=np.float32)


def pack_layout(codec: FactorCodec) -> Layout:
    """Layout of the factors among the columns of ``codec``."""
    factor = codec.column_factor.numpy()
    start = np.searchsorted(factor, np.arange(len(codec.outputs))).astype(np.int64)
    return Layout(np.asarray(codec.outputs, dtype=np.int64), start, codec.n_state_columns, codec.n_actions, codec.n_steps)


def pack_dense(predictor: DensePredictor) -> DenseWeights:
    """A dense predictor's weights, padded to the widest hidden layer, rounded up to a multiple of ``LANES``."""
    codec = predictor.codec
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    sizes = [len(layer.bias) for layer in layers]
    depth, width, n_columns = len(sizes), _padded(max(sizes, default=1), LANES), _padded(codec.n_columns, 4)
    inner = np.zeros((max(depth - 1, 0), width, width), dtype=np.float32)
    bias = np.zeros((depth, width), dtype=np.float32)
    for level, layer in enumerate(layers):
        bias[level, : sizes[level]] = _array(layer.bias)
        if level:
            inner[level - 1, : sizes[level], : sizes[level - 1]] = _array(layer.weight)
    first = np.zeros((codec.n_inputs, width if depth else n_columns), dtype=np.float32)
    start = _array(layers[0].weight if depth else predictor.out.weight)
    first[:, : len(start)] = start.T
    to_columns, column_bias = np.zeros((n_columns, width), dtype=np.float32), np.zeros(n_columns, dtype=np.float32)
    if depth:
        to_columns[: codec.n_columns, : sizes[-1]] = _array(predictor.out.weight)
    column_bias[: codec.n_columns] = _array(predictor.out.bias)
    stay = np.zeros((codec.n_actions * codec.n_steps, codec.n_state_columns), dtype=np.float32)
    if predictor.stay is not None:
        stay += _array(predictor.stay)
    return DenseWeights(
        pack_layout(codec),
        first,
        inner,
        bias,
        np.asarray([_padded(size, LANES) for size in sizes], dtype=np.int64),
        to_columns,
        column_bias,
        stay,
        codec.n_columns,
        ACTIVATION_CODES[predictor.activation],
    )


def _padded(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def pack_groups(conditioner: Conditioner) -> GroupWeights:
    """A conditioner's weights by group."""
    codec, size = conditioner.codec, conditioner.group_size
    n_groups, mask, members = len(conditioner.members), conditioner.groups.mask, conditioner.members.numpy()
    index = np.full(len(codec.outputs), -1, dtype=np.int64)
    index[members] = np.arange(n_groups)
    weight = _array(conditioner.groups.weight if mask is None else conditioner.groups.weight * mask)
    n_columns = codec.n_inputs + codec.n_columns
    columns = weight.reshape(n_groups, size, n_columns).transpose(0, 2, 1)
    of_state = slice(0, codec.n_state_columns)
    both = columns[:, of_state] + columns[:, codec.n_inputs :][:, of_state]
    to_values = np.zeros((n_groups, codec.width, size), dtype=np.float32)
    offset = np.zeros((n_groups, codec.width), dtype=np.float32)
    used = slice(1, 2) if codec.all_binary else slice(None)  # the logit of a bit's value 0 is 0
    to_values[:, used] = _array(conditioner.readout).transpose(0, 2, 1)
    offset[:, used] = _array(conditioner.offset)[:, 0]
    bits = np.asarray(codec.outputs)[members] == 2
    for table in (to_values, offset):
        table[bits, 1] -= table[bits, 0]
        table[bits, 0] = 0.0
    return GroupWeights(
        pack_layout(codec),
        index,
        np.ascontiguousarray(np.concatenate([columns, both], axis=1)),
        np.ascontiguousarray(_array(conditioner.groups.bias).reshape(n_groups, size)),
        to_values,
        offset,
        codec.n_inputs,
        n_columns,
        ACTIVATION_CODES[conditioner.activation],
        conditioner.correction,
    )


def _array(tensor: Tensor) -> Floats32:
    with torch.no_grad():
        array: Floats32 = np.array(tensor.detach().numpy(), dtype=np.float32)
    return array


def as_rows(states: States, actions: Actions, n_factors: int) -> tuple[States, Actions]:
    """Returns both as contiguous int64 arrays after checking their shapes, which the compiled kernels do not check."""
    states, actions = np.ascontiguousarray(states, dtype=np.int64), np.ascontiguousarray(actions, dtype=np.int64)
    if states.ndim != 2 or states.shape[1] != n_factors or actions.shape != (len(states),):
        raise ValueError(
            f"A model of {n_factors} factors needs states [B, {n_factors}] and actions [B], "
            f"got shapes {states.shape} and {actions.shape}."
        )
    return states, actions
