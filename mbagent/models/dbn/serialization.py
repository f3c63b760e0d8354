"""Decision graphs to and from plain arrays; arrays from files are validated, since compiled kernels check nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.dbn.arrays import Graphs
from mbagent.models.dbn.features import Layout

_FILE_NAMES = {"feature": "column", "persistence": "stays", "unseen_mass": "novelty"}

SAVED = {_FILE_NAMES.get(field, field): field for field in Graphs._fields if field != "noise"}
"""Fields of ``Graphs`` by their names in files. ``noise`` belongs to planning and is not saved."""

_FLOATS = ("rate", "spread", "stays", "novelty", "base", "still")


def to_arrays(graphs: Graphs) -> dict[str, NDArray[Any]]:
    """The graphs' arrays by name."""
    return {name: getattr(graphs, field).copy() for name, field in SAVED.items()}


def table_of(array: NDArray[Any], width: int) -> NDArray[np.int64]:
    """The array as integers, int64 [n, width].

    Raises:
        ValueError: the array has another width.
    """
    if np.ndim(array) != 2 or np.shape(array)[1] != width:
        raise ValueError(f"These weights do not fit: a table of {width} columns has the shape {np.shape(array)}.")
    return np.ascontiguousarray(array, dtype=np.int64)


def from_arrays(arrays: Mapping[str, NDArray[Any]], layout: Layout, n_features: int) -> Graphs:
    """The graphs, from the result of ``to_arrays``.

    Args:
        arrays: by name.
        layout: the variables.
        n_features: number of features that nodes can test.

    Raises:
        ValueError: the arrays are not graphs of these variables.
    """
    missing = sorted(set(SAVED) ^ set(arrays))
    if missing:
        raise ValueError(f"These weights are not decision graphs (first difference: {missing[0]!r}).")
    kinds = {name: np.float64 if name in _FLOATS else np.int64 for name in SAVED}
    flat: dict[str, Any] = {
        SAVED[name]: np.ascontiguousarray(array, dtype=kinds[name]).reshape(-1) for name, array in arrays.items()
    }
    graphs = Graphs(**flat, noise=np.zeros(1))
    if not _sound(graphs, layout, n_features):
        raise ValueError(
            "These weights do not fit: they are not graphs of these variables; load them into a model of the same environment."
        )
    return graphs


def _sound(graphs: Graphs, layout: Layout, n_features: int) -> bool:
    """Whether all indices and values are valid and no path is a cycle."""
    n_variables, n_nodes, n_entries = len(layout.outputs), len(graphs.feature), len(graphs.values)
    pairs = np.concatenate([[0], np.cumsum(layout.encoding.n_action_classes * layout.outputs)])
    start = np.concatenate([[0], np.cumsum(layout.outputs)])
    if not (np.array_equal(graphs.pairs, pairs) and np.array_equal(graphs.start, start)):
        return False
    lengths = {
        "off": n_nodes,
        "on": n_nodes,
        "rate": n_nodes,
        "spread": n_nodes,
        "nodes": n_entries,
        "entries": pairs[-1] + 1,
        "stays": pairs[-1],
        "novelty": pairs[-1],
        "base": start[-1],
        "still": 1,
    }
    if any(len(getattr(graphs, SAVED[name])) != length for name, length in lengths.items()):
        return False
    shares = [getattr(graphs, SAVED[name]) for name in _FLOATS]
    inner, numbers = graphs.feature >= 0, np.arange(n_nodes)
    return bool(
        _within(graphs.changing, n_variables)
        and _within(graphs.feature + 1, n_features + 1)
        and _within(graphs.nodes, n_nodes)
        and (np.diff(graphs.entries) >= 0).all()
        and (graphs.entries[0], graphs.entries[-1]) == (0, n_entries)
        and ((graphs.off >= 0) & (graphs.off < numbers))[inner].all()
        and ((graphs.on >= 0) & (graphs.on < numbers))[inner].all()
        and _values_fit(graphs, layout)
        and all(np.isfinite(share).all() and (share >= 0.0).all() and (share <= 1.0).all() for share in shares)
        and (np.add.reduceat(graphs.base, start[:-1]) <= 1.0 + 1e-6).all()
    )


def _values_fit(graphs: Graphs, layout: Layout) -> bool:
    """Whether each entry's value is less than its variable's cardinality."""
    pair = np.repeat(np.arange(len(graphs.entries) - 1), np.diff(graphs.entries))
    variable = np.searchsorted(graphs.pairs, pair, side="right") - 1
    return bool(((graphs.values >= 0) & (graphs.values < layout.outputs[variable])).all())


def _within(values: NDArray[np.int64], n: int) -> bool:
    return bool(((values >= 0) & (values < n)).all())
