"""Fewer successors where there are too many: systematic draws from an exact list."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import Successors
from mbagent.models.particles import start


def thin(full: Successors, n_samples: int, seed: int) -> Successors:
    """Cuts rows with more than ``n_samples`` successors down to ``n_samples`` systematic draws of them, merged.

    Args:
        full: all successors, with exact probabilities.
        n_samples: grid points a row.
        seed: which grid offset; the same for all rows.
    """
    counts = np.diff(full.offsets)
    if counts.max(initial=0) <= n_samples:
        return full
    rows = full.rows
    below = np.cumsum(full.probabilities)
    below -= np.concatenate([[0.0], below])[full.offsets[:-1]][rows]
    ends = np.ceil(below * n_samples - start(seed)[1]).clip(0, n_samples)
    ends[full.offsets[1:][counts > 0] - 1] = n_samples
    points = np.diff(ends, prepend=0.0)
    points[full.offsets[:-1][counts > 0]] = ends[full.offsets[:-1][counts > 0]]
    listed = (counts <= n_samples)[rows]
    kept = listed | (points > 0)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(rows[kept], minlength=len(counts)))]).astype(np.int64)
    weights = np.where(listed, full.probabilities, points / n_samples)[kept]
    return Successors(offsets, full.states[kept], full.terminated[kept], weights)
