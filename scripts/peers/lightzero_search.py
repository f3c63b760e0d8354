"""Searches in a tabular MDP with LightZero's C++ tree of MuZero. Run with a Python that has LightZero's wheel.

Only the compiled tree is loaded, by its path, so the wheel is enough (pip install --no-deps LightZero): neither torch nor
DI-engine is needed. The loop is LightZero's own (mcts_ctree.py: MuZeroMCTSCtree.search), with the table instead of the network.
"""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from pathlib import Path
from typing import Any

from peers.common import Array, read_task, run, stay_on_one_core

stay_on_one_core()

import numpy as np

PB_C_BASE, PB_C_INIT, VALUE_DELTA_MAX = 19652, 1.25, 0.01
"""LightZero's own."""


def load_tree() -> Any:
    """The compiled module.

    Raises:
        ImportError: it is missing or cannot be loaded.
    """
    folder = Path(sysconfig.get_paths()["purelib"]) / "lzero/mcts/ctree/ctree_muzero"
    found = sorted(folder.glob("mz_tree*.so")) + sorted(folder.glob("mz_tree*.pyd"))
    spec = importlib.util.spec_from_file_location("mz_tree", found[0]) if found else None
    if spec is None or spec.loader is None:
        raise ImportError("LightZero's compiled tree is not installed here: pip install --no-deps LightZero")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def search_tree(tree: Any, arrays: dict[str, Array], roots: Array, simulations: int, rng: np.random.Generator) -> Array:
    """Actions [R] by visits, as in LightZero's evaluation."""
    n_roots, n_actions = len(roots), arrays["successors"].shape[1]
    cumulated, gamma = arrays["cumulated"], float(arrays["gamma"])
    nobody, flat = [-1] * n_roots, [[0.0] * n_actions for _ in range(n_roots)]
    nodes = tree.Roots(n_roots, [list(range(n_actions)) for _ in range(n_roots)])
    nodes.prepare_no_noise([0.0] * n_roots, flat, nobody)
    stats = tree.MinMaxStatsList(n_roots)
    stats.set_delta(VALUE_DELTA_MAX)
    states = np.empty((simulations + 1, n_roots), dtype=np.int64)
    states[0] = roots
    for simulation in range(1, simulations + 1):
        results = tree.ResultsWrapper(num=n_roots)
        path, batch, actions, players = tree.batch_traverse(nodes, PB_C_BASE, PB_C_INIT, gamma, stats, results, nobody)
        at = states[path, batch]
        noise = rng.random(n_roots)
        chosen = (noise[:, None] >= cumulated[at, actions, :-1]).sum(axis=1)
        following = states[simulation] = arrays["successors"][at, actions, chosen]
        # Nodes cannot terminate; terminated states lead to themselves with reward 0 (see ``without_ends``).
        rewards, values = arrays["rewards"][at, following], arrays["leaf_values"][following]
        tree.batch_backpropagate(simulation, gamma, rewards.tolist(), values.tolist(), flat, stats, results, players)
    best: Array = np.asarray(nodes.get_distributions()).argmax(axis=1)
    return best


def without_ends(arrays: dict[str, Array]) -> dict[str, Array]:
    """The same MDP for a tree without termination: terminated states become absorbing, with value and reward 0.

    Rewards become [S, S'], since arrival in an absorbing state is rewarded only from outside of it.
    """
    ends, successors = arrays["ends"], arrays["successors"].copy()
    successors[ends] = np.flatnonzero(ends)[:, None, None]
    rewards = np.where(ends[:, None], 0.0, arrays["rewards"][None, :])
    leaf_values = np.where(ends, 0.0, arrays["leaf_values"])
    cumulated = arrays["probabilities"].cumsum(axis=2)
    return {**arrays, "successors": successors, "rewards": rewards, "leaf_values": leaf_values, "cumulated": cumulated}


def main(path: Path) -> None:
    """Runs LightZero's loop."""
    task, tree = read_task(path), load_tree()
    arrays = without_ends(task.arrays)

    def search(roots: Array, simulations: int, seed: int) -> tuple[Array, int]:
        actions = search_tree(tree, arrays, roots, simulations, np.random.default_rng(seed))
        return actions, len(roots) * simulations

    run(task, {"LightZero, C++ MuZero tree": search})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
