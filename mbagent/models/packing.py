"""From torch modules to the plain arrays that the compiled kernels read."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mbagent.models.kernels import ACTIVATION_CODES, DenseWeights, Floats32, GroupWeights, Layout
from mbagent.models.networks import Conditioner, DensePredictor, FactorCodec


def pack_layout(codec: FactorCodec) -> Layout:
    """Where the codec's factors lie among its columns."""
    factor = codec.column_factor.numpy()
    start = np.searchsorted(factor, np.arange(len(codec.outputs))).astype(np.int64)
    return Layout(np.asarray(codec.outputs, dtype=np.int64), start, codec.n_state_columns)


def pack_dense(predictor: DensePredictor) -> DenseWeights:
    """A dense predictor's weights, padded to its widest hidden layer."""
    layers = list(predictor.layers)
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
        first = np.zeros((predictor.codec.n_inputs, width), dtype=np.float32)
        first[:, : sizes[0]] = _array(layers[0].weight).T
        last[: sizes[-1]] = out
    stay = np.zeros((predictor.codec.n_actions, predictor.codec.n_state_columns), dtype=np.float32)
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
    n_outputs = len(codec.outputs)
    mask = conditioner.groups.mask
    weight = conditioner.groups.weight if mask is None else conditioner.groups.weight * mask
    columns = np.ascontiguousarray(_array(weight).reshape(n_outputs, size, -1).transpose(0, 2, 1))
    readout = np.zeros((n_outputs, size, codec.width), dtype=np.float32)
    offset = np.zeros((n_outputs, codec.width), dtype=np.float32)
    used = slice(1, 2) if codec.all_binary else slice(None)  # the logit of a bit's value 0 is 0
    readout[:, :, used] = _array(conditioner.readout)
    offset[:, used] = _array(conditioner.offset)[:, 0]
    return GroupWeights(
        np.ascontiguousarray(columns[:, : codec.n_inputs]),
        np.ascontiguousarray(columns[:, codec.n_inputs :]),
        np.ascontiguousarray(_array(conditioner.groups.bias).reshape(n_outputs, size)),
        readout,
        offset,
        ACTIVATION_CODES[conditioner.activation],
        conditioner.correction,
    )


def _array(tensor: Tensor) -> Floats32:
    with torch.no_grad():
        array: Floats32 = np.array(tensor.detach().numpy(), dtype=np.float32)
    return array
