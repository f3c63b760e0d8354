"""Fitted value iteration for MDPs too large to solve: values linear in active features and in pairs of them.

States are sampled from simulated play, at first at random and then greedily by the values fitted so far; values are backed up
through the model's successors and fitted by kernel ridge regression, over and over (Gordon 1995; Guestrin, Koller, Parr and
Venkataraman 2003 for sums over few factors each). They hold for one reward function and are dropped with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from mbagent.models.mdp import GraphArrays, StateGraph
from mbagent.models.protocol import TransitionModel
from mbagent.planning.value_function import LOWEST_KNOWN, LeafValues, evaluate, sum_of
from mbagent.planning.value_iteration import bellman, score_edges
from mbagent.types import Actions, Floats, Ints, Reward, States
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive

RIDGE = 0.1
"""Strength of the pull towards equal values, in states."""

PAIRED = 0.3
"""Weight of pairs beside single columns: how large their part is expected to be."""

MOST_PAIRS = 10_000_000
"""Pairs in all states that are to be valued, at most; where there are more, there are no pairs."""

MOST_PAIR_FEATURES = 2000
"""Columns between which there can be pairs."""


class PairRegression:
    """Regression for many targets on the same states; columns are as in LeafValues, each factor's commonest value is none.

    The kernel of two states that share d columns is d + PAIRED d (d - 1) / 2, which counts every pair of columns as one more.

    Args:
        states: int64 [N, F], whose values are given, one at least.
        cardinalities: of the factors.
        valued: int64 [M, F], whose values are asked for.
        low, high: bounds of values.
    """

    def __init__(self, states: States, cardinalities: tuple[int, ...], valued: States, low: float, high: float) -> None:
        """See the class."""
        counts = np.asarray(cardinalities)
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        self._common = np.array([np.bincount(values).argmax() for values in states.T], dtype=np.int64)
        rows, factors = np.nonzero(states != self._common)
        used, column = np.unique(self._first[factors] + states[rows, factors], return_inverse=True)
        self._column = np.full(int(counts.sum()), -1)
        self._column[used] = np.arange(len(used))
        self._x = csr_array((np.ones(len(rows)), (rows, column)), shape=(len(states), len(used)))
        self._on, self._begin = self._shown(valued)
        n_on = np.diff(self._begin)
        self._paired = len(used) <= MOST_PAIR_FEATURES and int((n_on * (n_on - 1) // 2).sum()) <= MOST_PAIRS
        shared = (self._x @ self._x.T).toarray()
        kernel = shared + (PAIRED / 2.0) * shared * (shared - 1.0) if self._paired else shared
        self._typical = kernel.mean(axis=0)
        centred = kernel - self._typical - self._typical[:, None] + self._typical.mean()
        self._factor, self._bounds = cho_factor(centred + RIDGE * np.eye(len(states))), (low, high)

    def _shown(self, states: States) -> tuple[Ints, Ints]:
        """Columns that are on in states [M, F], those of one after another, and where each one's begin, int64 [M + 1]."""
        rows, factors = np.nonzero(states != self._common)
        column = self._column[self._first[factors] + states[rows, factors]]
        known = column >= 0
        return column[known], np.searchsorted(rows[known], np.arange(len(states) + 1)).astype(np.int64)

    def fit(self, values: Floats) -> LeafValues:
        """What fits values [N] of the states best."""
        mean, x = float(values.mean()), self._x
        share = cho_solve(self._factor, values - mean)
        pairs = PAIRED * (x.T @ x.multiply(share[:, None])).toarray() if self._paired else np.zeros((0, 0))
        level = mean - float(share @ self._typical)
        return LeafValues(self._common, self._first, self._column, level, x.T @ share, pairs, *self._bounds)

    def values(self, leaf: LeafValues) -> Floats:
        """Values [M] of the states that they are asked for."""
        out = np.empty(len(self._begin) - 1)
        _sums(leaf, self._on, self._begin, out)
        return out


@compiled
def _sums(leaf: LeafValues, on: Ints, begin: Ints, out: Floats) -> None:
    for i in range(len(out)):
        out[i] = sum_of(leaf, on[begin[i] : begin[i + 1]])


ITERATIONS = 3
"""Times that play, and the fit after it, are repeated."""

STATES_A_ROUND = 600
"""States taken from each round of play."""

EPISODES = 64
"""Episodes imagined side by side."""

EPISODE_STEPS = 40
"""Steps of each of them."""

RANDOM_ACTION = 0.2
"""Share of random actions once there are values to play by."""

FEWEST_SAMPLES, MOST_ROW_SAMPLES = 4, 32
"""Draws for each (state, action), at least and at most."""

SAMPLES_IN_ALL = 8000
"""Draws for each action, about: the fewer states were met, the more for each."""

SAMPLED_TOGETHER = 4
"""States that share their luck; values are to be means over many lucks."""

SWEEPS = 150
"""Backups and fits in a round, at most."""

CONVERGED = 1e-4
"""They end when no value moves by more than this share of the largest reward."""

_PLAY_SALT, _EXPAND_SALT, _SAMPLE_SALT = 0xF1A1, 0xF1A2, 0xF1A3


@dataclass(frozen=True)
class Task:
    """What values are learned for.

    Attributes:
        model: what to imagine with.
        goal: what is wanted.
        start: int64 [S, F], start states.
        gamma: discount.
        seed: which random numbers.
    """

    model: TransitionModel
    goal: Reward
    start: States
    gamma: float
    seed: int


@compiled
def _back_up(graph: GraphArrays, rewards: Floats, gamma: float, nodes: Ints, v: Floats, q: Floats, out: Floats) -> None:
    for i in range(len(nodes)):
        out[i] = bellman(nodes[i], graph, rewards, gamma, v, q)


def learn_values(task: Task) -> tuple[LeafValues, States]:
    """What states are worth under the best behaviour found in imagined play.

    Returns:
        (values, ``LOWEST_KNOWN`` where all steps earn the same; states int64 [N, F] that were met, distinct).
    """
    leaf, met = LOWEST_KNOWN, np.zeros((0, len(task.model.cardinalities)), dtype=np.int64)
    for number in range(ITERATIONS):
        played = _play(task, leaf, number)
        rng = np.random.default_rng([task.seed, number])
        some = rng.choice(len(played), size=min(len(played), STATES_A_ROUND), replace=False)
        met = np.unique(np.concatenate([met, played[np.sort(some)]]), axis=0)
        leaf = _fit(task, met, leaf, number)
    return leaf, met


def _play(task: Task, leaf: LeafValues, number: int) -> States:
    """States int64 [N, F] met by playing greedily on the values; by chance at first."""
    rng = np.random.default_rng([task.seed, number, _PLAY_SALT])
    states, met = task.start[rng.integers(len(task.start), size=EPISODES)], []
    for step in range(EPISODE_STEPS):
        met.append(states)
        actions = rng.integers(task.model.n_actions, size=EPISODES)
        if len(leaf.common):
            by_chance = rng.random(EPISODES) < RANDOM_ACTION
            actions = np.where(by_chance, actions, greedy_actions(task, leaf, states, number * EPISODE_STEPS + step))
        keys = derive(task.seed, _SAMPLE_SALT, number * EPISODE_STEPS + step, np.arange(EPISODES))
        after, over = task.model.sample(states, actions, keys)
        again = task.start[rng.integers(len(task.start), size=EPISODES)]
        states = np.where(over[:, None], again, after)
    return np.concatenate(met)


def greedy_actions(task: Task, leaf: LeafValues, states: States, step: int) -> Actions:
    """The actions [B] that are best one step ahead of states int64 [B, F]."""
    graph = StateGraph(task.model)
    nodes = graph.add(states, np.zeros(len(states), dtype=np.int64))
    distinct, v, _, q, rewards = _expanded(task, graph, leaf, step)
    _back_up(graph.arrays, rewards, task.gamma, distinct, v, q, np.empty(len(distinct)))
    best: Actions = q.argmax(axis=1)[nodes]
    return best


def _expanded(task: Task, graph: StateGraph, leaf: LeafValues, step: int) -> tuple[Ints, Floats, Floats, Floats, Floats]:
    """Expands all nodes of a graph; returns them, the values of what is met, room for new ones and for q, and the rewards."""
    nodes = np.arange(len(graph))
    samples = min(max(SAMPLES_IN_ALL // len(nodes), FEWEST_SAMPLES), MOST_ROW_SAMPLES)
    for begin in range(0, len(nodes), SAMPLED_TOGETHER):
        graph.expand(nodes[begin : begin + SAMPLED_TOGETHER], samples, int(derive(task.seed, _EXPAND_SALT, step, begin)[0]))
    v, q = np.zeros(len(graph)), np.zeros((len(graph), task.model.n_actions))
    evaluate(leaf, graph.states, np.zeros(len(graph), dtype=np.bool_), v)
    return nodes, v, np.empty(len(nodes)), q, score_edges(graph, task.goal)


def _fit(task: Task, states: States, leaf: LeafValues, number: int) -> LeafValues:
    """Values fitted on states int64 [N, F], distinct, from the given ones on."""
    graph = StateGraph(task.model)
    graph.add(states, np.zeros(len(states), dtype=np.int64))
    nodes, v, found, q, rewards = _expanded(task, graph, leaf, (ITERATIONS + number) * EPISODE_STEPS)
    if rewards.min() == rewards.max():
        return LOWEST_KNOWN
    low, high = (float(end) / (1.0 - task.gamma) for end in (min(rewards.min(), 0.0), max(rewards.max(), 0.0)))
    regression = PairRegression(graph.states[nodes], task.model.cardinalities, graph.states, low, high)
    moved = CONVERGED * float(np.abs(rewards).max())
    for _ in range(SWEEPS):
        _back_up(graph.arrays, rewards, task.gamma, nodes, v, q, found)
        leaf, before = regression.fit(found), v
        v = regression.values(leaf)
        if np.abs(v - before).max() <= moved:
            break
    return leaf if np.isfinite(leaf.mean) and np.isfinite(leaf.weights).all() else LOWEST_KNOWN
