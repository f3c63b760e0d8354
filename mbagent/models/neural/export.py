"""Conversion of torch modules to the plain arrays of the compiled kernels, and the kernel of the plane predictor.

Each row is computed separately, so its result does not depend on the other rows. Shapes: C' input channels (planes,
or planes times values), H rows, W columns, D hidden channels, A actions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from mbagent.models.neural.kernels import ACTIVATION_CODES, DenseWeights, Floats32, GroupWeights, Layout, dense_logits
from mbagent.models.neural.networks import Affine, Conditioner, DensePredictor, FactorCodec, PlanePredictor
from mbagent.types import Actions, Ints, States
from mbagent_envs.jit import compiled

CompiledBody: TypeAlias = Callable[[States, Actions], Floats32]
"""(states int64 [B, F], actions int64 [B]) -> logits float32 [B, O, K]; a row's result does not depend on its batch."""

ROWS_PER_CHUNK = 64
"""Rows per evaluation of torch bodies without a kernel; always this number, since matrix products round differently in other
sizes."""


LANES = 16
"""Hidden layers are padded with zeros to a multiple of this, for vector instructions."""


def compiled_body(predictor: nn.Module, layout: Layout) -> CompiledBody:
    """A predictor with its present weights, for inference: compiled if there is a kernel for it, else by torch."""
    if isinstance(predictor, DensePredictor):
        dense = pack_dense(predictor)
        return lambda states, actions: dense_logits(states, actions, layout, dense)
    if isinstance(predictor, PlanePredictor):
        planes, width = pack_planes(predictor), predictor.codec.width
        return lambda states, actions: plane_logits(states, actions, planes, width)
    return lambda states, actions: in_chunks(predictor, states, actions)


@torch.inference_mode()
def in_chunks(predictor: nn.Module, states: States, actions: Actions) -> Floats32:
    """Logits float32 [B, O, K] of a torch body, in chunks of ``ROWS_PER_CHUNK`` rows, the last one padded with zeros."""
    parts = []
    for start in range(0, max(len(states), 1), ROWS_PER_CHUNK):
        rows = slice(start, min(start + ROWS_PER_CHUNK, len(states)))
        n = rows.stop - rows.start
        chunk_states = np.zeros((ROWS_PER_CHUNK, states.shape[1]), dtype=np.int64)
        chunk_actions = np.zeros(ROWS_PER_CHUNK, dtype=np.int64)
        chunk_states[:n], chunk_actions[:n] = states[rows], actions[rows]
        parts.append(predictor(torch.from_numpy(chunk_states), torch.from_numpy(chunk_actions)).numpy()[:n])
    return np.concatenate(parts).astype(np.float32, copy=False)


def pack_layout(codec: FactorCodec) -> Layout:
    """Layout of the codec's factors among its columns."""
    factor = codec.column_factor.numpy()
    start = np.searchsorted(factor, np.arange(len(codec.outputs))).astype(np.int64)
    return Layout(np.asarray(codec.outputs, dtype=np.int64), start, codec.n_state_columns, codec.n_actions, codec.n_steps)


def pack_dense(predictor: DensePredictor) -> DenseWeights:
    """A dense predictor's weights, padded to its widest hidden layer and to ``LANES``."""
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
    """Both as contiguous int64, as required by the compiled kernels, which do not check shapes."""
    states, actions = np.ascontiguousarray(states, dtype=np.int64), np.ascontiguousarray(actions, dtype=np.int64)
    if states.ndim != 2 or states.shape[1] != n_factors or actions.shape != (len(states),):
        raise ValueError(
            f"A model of {n_factors} factors needs states [B, {n_factors}] and actions [B], "
            f"got shapes {states.shape} and {actions.shape}."
        )
    return states, actions


class PlaneWeights(NamedTuple):
    """A PlanePredictor's weights in the layout of the kernel.

    Attributes:
        row, column, channel: int64 [F], position of each factor (channel of its value 0 if cells have many values).
        values: 1 for binary cells, else K.
        first: [C', 3, 3, D]; base: [H, W, D], bias and border of the first layer; action: [A, D].
        second: [9 * D, D] (in, out); second_bias: [D]; second_top: [D, D] (in, out).
        out: [D, C'] ; out_bias: [C']; out_top: [D, C'].
        end: [D]; end_bias: [1].
        stay: [C'].
    """

    row: Ints
    column: Ints
    channel: Ints
    values: int
    first: Floats32
    base: Floats32
    action: Floats32
    second: Floats32
    second_bias: Floats32
    second_top: Floats32
    out: Floats32
    out_bias: Floats32
    out_top: Floats32
    end: Floats32
    end_bias: Floats32
    stay: Floats32


@torch.no_grad()
def pack_planes(body: PlanePredictor) -> PlaneWeights:
    """The weights of a torch predictor."""
    layout, values = body.layout, body.values
    shape = (layout.height, layout.width, layout.channels) if layout.channels_last else ()
    shape = shape or (layout.channels, layout.height, layout.width)
    index = np.indices(shape).reshape(3, -1)
    row, column, channel = index if layout.channels_last else (index[1], index[2], index[0])
    ones = torch.zeros(1, body.first.weight.shape[1], layout.height, layout.width)
    ones[:, -1] = 1.0
    base = body.first(ones)[0].permute(1, 2, 0)
    first = body.first.weight[:, :-1].permute(1, 2, 3, 0)
    return PlaneWeights(
        np.ascontiguousarray(row),
        np.ascontiguousarray(column),
        np.ascontiguousarray(channel * values),
        values,
        _array(first),
        _array(base),
        _array(body.action),
        _array(body.second.weight.permute(2, 3, 1, 0).reshape(-1, body.second.weight.shape[0])),
        _array(body.second.bias + body.second_top.bias),
        _array(body.second_top.weight.T),
        _array(body.out.weight[:, :, 0, 0].T),
        _array(body.out.bias + body.out_top.bias),
        _array(body.out_top.weight.T),
        _array(body.end.weight[0]),
        _array(body.end.bias),
        _array(body.stay.repeat_interleave(values)),
    )


@compiled
def plane_logits(states: Ints, actions: Ints, w: PlaneWeights, width: int) -> Floats32:
    """Logits float32 [B, O, K] for states int64 [B, F] and actions int64 [B]; K is ``width``, ``terminated`` comes last."""
    n_rows, n_factors = states.shape
    height, columns, hidden = w.base.shape
    cells = height * columns
    logits = np.zeros((n_rows, n_factors + 1, width), dtype=np.float32)
    plain = np.empty((height, columns, hidden), dtype=np.float32)
    padded = np.zeros((height + 2) * (columns + 2) * hidden, dtype=np.float32)
    patches = np.zeros((cells, 9 * hidden), dtype=np.float32)
    above, read = np.empty((cells, hidden), dtype=np.float32), np.empty((cells, len(w.out_bias)), dtype=np.float32)
    top, bias = np.empty(hidden, dtype=np.float32), np.empty(hidden, dtype=np.float32)
    out_bias = np.empty(len(w.out_bias), dtype=np.float32)
    for b in range(n_rows):
        if b == 0 or not _same(states, b):
            _first_layer(states[b], w, plain)
        _activate_first(plain, w.action[actions[b]], padded, patches, top)
        # One product for each state: in a product for several, the rounding of a row can depend on its position.
        np.dot(patches, w.second, above)
        _mix(top, w.second_top, w.second_bias, bias)
        _activate_second(above, bias, top)
        np.dot(above, w.out, read)
        _mix(top, w.out_top, w.out_bias, out_bias)
        _read_out(states[b], w, read, out_bias, columns, logits[b])
        total = w.end_bias[0]
        for d in range(hidden):
            total += top[d] * w.end[d]
        logits[b, n_factors, 1] = total
    return logits


@compiled
def _same(states: Ints, b: int) -> bool:
    """Whether row b has the same state as the previous row, so that its first layer differs only by the action."""
    return bool((states[b] == states[b - 1]).all())


@compiled
def _first_layer(state: Ints, w: PlaneWeights, plain: Floats32) -> None:
    """First convolution without the action, summed over the cells that are 1."""
    height, columns, hidden = plain.shape
    plain[:] = w.base
    for f in range(len(state)):
        if w.values == 1 and state[f] == 0:
            continue
        channel = w.channel[f] if w.values == 1 else w.channel[f] + state[f]
        for dy in range(3):
            y = w.row[f] + 1 - dy
            if y < 0 or y >= height:
                continue
            for dx in range(3):
                x = w.column[f] + 1 - dx
                if x < 0 or x >= columns:
                    continue
                for d in range(hidden):
                    plain[y, x, d] += w.first[channel, dy, dx, d]


@compiled
def _activate_first(plain: Floats32, action: Floats32, padded: Floats32, patches: Floats32, top: Floats32) -> None:
    """Adds the action, and writes each position's 3x3 neighbourhood to a row of ``patches`` [H * W, 9 * D].

    ``padded`` [(H + 2) * (W + 2) * D] contains the activations with a border of zeros: three neighbours in a row are
    contiguous there, so a patch consists of three runs of 3 * D numbers.
    """
    height, columns, hidden = plain.shape
    top[:] = 0.0
    for y in range(height):
        for x in range(columns):
            cell = padded[((y + 1) * (columns + 2) + x + 1) * hidden :][:hidden]
            source = plain[y, x]
            for d in range(hidden):
                value = max(source[d] + action[d], np.float32(0.0))
                cell[d] = value
                top[d] = max(top[d], value)
    run = 3 * hidden
    for y in range(height):
        for x in range(columns):
            row = patches[y * columns + x]
            for dy in range(3):
                start = ((y + dy) * (columns + 2) + x) * hidden
                row[dy * run : (dy + 1) * run] = padded[start : start + run]


@compiled
def _mix(top: Floats32, weights: Floats32, start: Floats32, result: Floats32) -> None:
    """``result = start + top @ weights``."""
    result[:] = start
    for d in range(len(top)):
        value = top[d]
        if value != 0.0:
            for e in range(len(result)):
                result[e] += value * weights[d, e]


@compiled
def _activate_second(above: Floats32, bias: Floats32, top: Floats32) -> None:
    flat, hidden = above.reshape(-1), above.shape[1]
    top[:] = 0.0
    for start in range(0, len(flat), hidden):
        for d in range(hidden):
            value = max(flat[start + d] + bias[d], np.float32(0.0))
            flat[start + d] = value
            top[d] = max(top[d], value)


@compiled
def _read_out(state: Ints, w: PlaneWeights, read: Floats32, out_bias: Floats32, columns: int, logits: Floats32) -> None:
    for f in range(len(state)):
        position, first = w.row[f] * columns + w.column[f], w.channel[f]
        for k in range(w.values):
            channel = first + k
            on = state[f] == (1 if w.values == 1 else k)
            stay = w.stay[channel] if on else -w.stay[channel]
            logits[f, 1 if w.values == 1 else k] = read[position, channel] + out_bias[channel] + stay
