"""Tree search on an MDP with known transitions and rewards: many short simulations in one compiled call.

Trial-based heuristic tree search (Keller and Helmert 2013) with transpositions: actions are selected by upper confidence bounds
(Auer et al. 2002), successors are sampled, and Bellman backups with the exact probabilities follow the path back. A simulation
ends at a state that no simulation has visited, at the end of the episode, or after ``depth`` steps. No search reuses another's.
Shapes: S states, A actions, K successors, M edges, R roots.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import borrowed, compiled, inlined
from mbagent_envs.random_keys import derive_one, mix

DEPTH = 3
"""Default maximum number of steps of a simulation."""

MOST_VISITS = 1 << 14
"""Larger numbers of visits are treated as this number in the bounds."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
_UNIT = 2.0**-53


class KnownMachine(NamedTuple):
    """An MDP in the form that the search reads.

    Attributes:
        first: where the edges of each (state, action) begin, int64 [S * A + 1].
        following: state that each edge leads to, int64 [M].
        below: cumulative probability of the pair's edges up to and including this one, [M].
        weight: probability times discount, 0 where the episode ends, [M].
        income: expected reward of each (state, action), [S, A].
        first_value: value of states that were not visited yet, [S].
        over: whether an edge ends the episode, bool [M].
    """

    first: Ints
    following: Ints
    below: Floats
    weight: Floats
    income: Floats
    first_value: Floats
    over: Bools


class Searched(NamedTuple):
    """Results of a search at the roots.

    Attributes:
        values: of each action, [R, A].
        visits: simulations through each action, int64 [R, A].
        steps: total number of successors sampled.
    """

    values: Floats
    visits: Ints
    steps: int


def known_machine(
    first: Ints,
    following: Ints,
    probabilities: Floats,
    rewards: Floats,
    over: Bools,
    first_value: Floats,
    n_actions: int,
    gamma: float,
) -> KnownMachine:
    """Prepares an MDP for searches, once for each goal.

    Args:
        first: where the edges of each (state, action) begin, int64 [S * A + 1].
        following: int64 [M].
        probabilities: [M], summing to one over each pair.
        rewards: [M].
        over: whether an edge ends the episode, bool [M].
        first_value: value of states that the search has not visited yet, [S].
        n_actions: number of actions A.
        gamma: discount of a step.
    """
    pair = np.repeat(np.arange(len(first) - 1), np.diff(first))
    total = np.cumsum(probabilities)
    before = np.concatenate([[0.0], total])[first[:-1]]
    income: Floats = np.bincount(pair, weights=probabilities * rewards, minlength=len(first) - 1).astype(np.float64)
    weight = np.where(over, 0.0, gamma * probabilities)
    return KnownMachine(first, following, total - before[pair], weight, income.reshape(-1, n_actions), first_value, over)


_N = np.arange(MOST_VISITS, dtype=np.float64)
BOUND_TOP, BOUND_BELOW = np.sqrt(np.log(_N + 1.0)), 1.0 / np.sqrt(np.maximum(_N, 0.5))
"""Factors of the upper confidence bound, which depend on total visits and on an action's visits."""


def search_machine(
    machine: KnownMachine, roots: Ints, n_simulations: int, seed: int, *, depth: int = DEPTH, c_uct: float = 0.5
) -> Searched:
    """Searches from every root, int64 [R]; the result for a root depends neither on the others nor on their number.

    Args:
        machine: the MDP.
        roots: states to search from.
        n_simulations: for each root.
        seed: of the random numbers.
        depth: maximum number of steps of a simulation.
        c_uct: weight of exploration, in units of the range of the values of the root's actions, if they differ.

    Raises:
        ValueError: a root is not a state, depth or number of simulations is below 1, or the seed is negative.
    """
    n_states, n_actions = machine.income.shape
    if len(roots) and not (roots.min() >= 0 and roots.max() < n_states):
        raise ValueError(f"Roots must be states, 0 ... {n_states - 1}, got {roots}.")
    for name, value, least in (("n_simulations", n_simulations, 1), ("depth", depth, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}.")
    values, visits = np.empty((len(roots), n_actions)), np.zeros((len(roots), n_actions), dtype=np.int64)
    steps = _search_all(machine, roots, n_simulations, np.uint64(seed), depth, c_uct, BOUND_TOP, BOUND_BELOW, values, visits)
    return Searched(values, visits, steps)


@compiled
def _search_all(
    machine: KnownMachine,
    roots: Ints,
    n_simulations: int,
    seed: np.uint64,
    depth: int,
    c_uct: float,
    top: Floats,
    below: Floats,
    values: Floats,
    visits: Ints,
) -> int:
    n_states, n_actions = machine.income.shape
    owned = (
        np.empty((n_states, n_actions)),
        np.empty(n_states),
        np.empty((n_states, n_actions), dtype=np.int64),
        np.empty(n_states, dtype=np.int64),
    )
    q, v, n, met = borrowed(owned)
    path, steps, m = np.empty(depth, dtype=np.int64), 0, borrowed(machine)
    for r in range(len(roots)):
        root, state = roots[r], derive_one(seed, np.uint64(roots[r]))
        met[:] = 0
        v[:] = m.first_value
        _meet(root, m, q, v, n, met)
        for _ in range(n_simulations):
            state, taken = _simulate(root, state, depth, c_uct, m, top, below, q, v, n, met, path)
            visits[r, path[0] - root * n_actions] += 1
            steps += taken
        for a in range(n_actions):
            values[r, a] = _worth(root, a, m.first, m.following, m.weight, m.income, v)
    return steps + 0 * len(owned[1])  # the borrowed arrays must live until here


@inlined
def _worth(s: int, a: int, first: Ints, following: Ints, weight: Floats, income: Floats, v: Floats) -> float:
    """Value of an action, computed from those of its successors."""
    total = income[s, a]
    pair = s * income.shape[1] + a
    for e in range(first[pair], first[pair + 1]):
        total += weight[e] * v[following[e]]
    return float(total)


@inlined
def _meet(s: int, m: KnownMachine, q: Floats, v: Floats, n: Ints, met: Ints) -> None:
    """Initialises the value of a newly visited state from its successors' values."""
    best = -np.inf
    for a in range(q.shape[1]):
        q[s, a] = _worth(s, a, m.first, m.following, m.weight, m.income, v)
        n[s, a] = 0
        best = max(best, q[s, a])
    v[s] = best
    met[s] = 1


@inlined
def _best_bound(s: int, scale: float, below: Floats, q: Floats, n: Ints) -> int:
    """The action with the greatest upper confidence bound."""
    best, chosen = -np.inf, 0
    for a in range(q.shape[1]):
        score = q[s, a] + scale * below[min(n[s, a], MOST_VISITS - 1)]
        if score > best:
            best, chosen = score, a
    return chosen


@inlined
def _back_up(path: Ints, length: int, first: Ints, following: Ints, weight: Floats, income: Floats, q: Floats, v: Floats) -> None:
    """Bellman backups of the (state, action) pairs of a simulation, the last one first."""
    for i in range(length - 1, -1, -1):
        s = path[i] // q.shape[1]
        a = path[i] - s * q.shape[1]
        q[s, a] = _worth(s, a, first, following, weight, income, v)
        best = q[s, 0]
        for b in range(1, q.shape[1]):
            best = max(best, q[s, b])
        v[s] = best


@inlined
def _simulate(
    root: int,
    state: np.uint64,
    depth: int,
    c_uct: float,
    m: KnownMachine,
    top: Floats,
    below: Floats,
    q: Floats,
    v: Floats,
    n: Ints,
    met: Ints,
    path: Ints,
) -> tuple[np.uint64, int]:
    """Runs one simulation; returns the state of the random numbers after it, and the number of successors sampled."""
    first, following, weight, income, n_actions = m.first, m.following, m.weight, m.income, q.shape[1]
    low, high = q[root, 0], q[root, 0]
    for a in range(1, n_actions):
        low, high = min(low, q[root, a]), max(high, q[root, a])
    spread, s, length = c_uct * (high - low if high > low else 1.0), root, 0
    while length < depth:
        chosen = _best_bound(s, spread * top[min(met[s], MOST_VISITS - 1)], below, q, n)
        n[s, chosen] += 1
        met[s] += 1
        pair = s * n_actions + chosen
        path[length] = pair
        length += 1
        state += _STEP
        noise, e = float(mix(state) >> np.uint64(11)) * _UNIT, first[pair]
        last = first[pair + 1] - 1
        while e < last and noise >= m.below[e]:
            e += 1
        if m.over[e]:
            break
        s = following[e]
        if met[s] == 0:
            _meet(s, m, q, v, n, met)
            break
    _back_up(path, length, first, following, weight, income, q, v)
    return state, length
