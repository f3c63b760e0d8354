"""How agents act while learning."""

import numpy as np
import pytest

from mbagent.exploration.strategies import PersistentExploration, RandomExploration


def test_random_actions_are_all_taken_equally_often() -> None:
    rng, states = np.random.default_rng(0), np.zeros((3000, 1), dtype=np.int64)
    counts = np.bincount(RandomExploration(3).act(states, rng), minlength=3)
    assert counts.min() > 900


def test_persistent_actions_are_repeated_in_each_environment() -> None:
    rng, exploration = np.random.default_rng(0), PersistentExploration(3, keep=0.9)
    acts = np.stack([exploration.act(np.zeros((4, 1), dtype=np.int64), rng) for _ in range(4000)])
    same = (acts[1:] == acts[:-1]).mean(axis=0)
    assert np.abs(same - (0.9 + 0.1 / 3)).max() < 0.02
    assert np.bincount(acts.ravel(), minlength=3).min() > 4000
    assert (acts[:, 0] != acts[:, 1]).any()
    assert len(exploration.act(np.zeros((2, 1), dtype=np.int64), rng)) == 2  # another number of environments
    with pytest.raises(ValueError, match="below 1"):
        PersistentExploration(3, keep=1.0)
