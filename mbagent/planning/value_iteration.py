"""Value iteration on state graphs, and the value function of unexpanded states.

The value function is linear in features and in pairs of features.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.mdp import GraphArrays, StateGraph, grow_reachable
from mbagent.models.protocol import TransitionModel
from mbagent.planning.planner import best_actions
from mbagent.types import Bools, Floats, Ints, Reward, States
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.structs import Struct


class LeafValues(Struct):
    """Value function: a mean plus the weights of a state's active features and of their pairs.

    Each of the C features tests whether a factor has one particular value, other than its most common one.

    Attributes:
        common: most common value of each factor, int64 [F]. If it is empty, nothing was learned; unexpanded states then have the
            lowest value of the expanded states in their group.
        first: where each factor's values begin in ``column``, int64 [F].
        column: feature index of each value of each factor, -1 if the value has no feature, int64 [sum of cardinalities].
        mean: value of a state without active features.
        weights: weight of each feature, [C].
        pairs: symmetric matrix of the weights of feature pairs, [C, C]; shape [0, 0] if pairs are not used.
        low: lower bound of values.
        high: upper bound of values.
    """

    common: Ints
    first: Ints
    column: Ints
    mean: float
    weights: Floats
    pairs: Floats
    low: float
    high: float


_NOTHING = np.zeros(0, dtype=np.int64)

LOWEST_KNOWN = LeafValues(_NOTHING, _NOTHING, _NOTHING, 0.0, np.zeros(0), np.zeros((0, 0)), 0.0, 0.0)
"""No values were learned: unexpanded states have the lowest value of the expanded states around their root."""


@compiled
def features_on(leaf: LeafValues, state: Ints, on: Ints) -> int:
    """Writes the indices of a state's active features to the start of ``on`` [F]; returns how many there are."""
    n = 0
    for f in range(len(state)):
        if state[f] != leaf.common[f]:
            column = leaf.column[leaf.first[f] + state[f]]
            if column >= 0:
                on[n] = column
                n += 1
    return n


@compiled
def sum_of(leaf: LeafValues, on: Ints) -> float:
    """Value of a state with the active features ``on``."""
    total, paired = leaf.mean, len(leaf.pairs) > 0
    for i in range(len(on)):
        total += leaf.weights[on[i]]
        if paired:
            for j in range(i):
                total += leaf.pairs[on[i], on[j]]
    return float(min(max(total, leaf.low), leaf.high))


@compiled
def leaf_value(leaf: LeafValues, state: Ints) -> float:
    """Value of a state [F]; not defined for LOWEST_KNOWN."""
    on = np.empty(len(state), dtype=np.int64)
    return sum_of(leaf, on[: features_on(leaf, state, on)])


@compiled
def evaluate(leaf: LeafValues, states: Ints, skipped: Bools, v: Floats) -> None:
    """Writes the values of ``states`` [N, F] to ``v`` [N], except where ``skipped`` [N]; does nothing for LOWEST_KNOWN."""
    if len(leaf.common) > 0:
        for node in range(len(v)):
            if not skipped[node]:
                v[node] = leaf_value(leaf, states[node])


TOLERANCE = 1e-7
"""Sweeps stop when no value changes by more than this share of the largest expected reward."""

MAX_SWEEPS = 5000

VALUE_TIE = 1e-6
"""Values that differ by less than this share of the greatest are treated as equal; sweeps are about this accurate."""

MAX_NEWS_SWEEPS = 200


class Values(Struct):
    """Values of a state graph for a goal; a search keeps spare room for further nodes and edges.

    Attributes:
        v: float64 [N], value of each state: that of the best action if expanded, else that given by ``leaf`` or ``frontier``.
        q: float64 [N, A], value of each action; zero rows for unexpanded states.
        rewards: float64 [M], reward of every successor edge.
        frontier: float64 [G], value of each group's unexpanded states; used only if ``leaf`` is LOWEST_KNOWN.
        leaf: learned values of unexpanded states.
    """

    v: Floats
    q: Floats
    rewards: Floats
    frontier: Floats
    leaf: LeafValues = LOWEST_KNOWN


def score_edges(graph: StateGraph, goal: Reward, start: int = 0) -> Floats:
    """Rewards [M - start] of the graph's successor edges ``start`` ... M - 1, from one call of ``goal``."""
    if graph.n_edges == start:
        return np.zeros(0)
    sources, next_nodes = graph.sources[start:], graph.next_nodes[start:]
    states = graph.states  # take is three times as fast as indexing of rows
    score: Reward = getattr(goal, "of_owned", goal)
    return score(states.take(sources, axis=0), graph.actions[start:], states.take(next_nodes, axis=0))


def solve(graph: StateGraph, goal: Reward, gamma: float, n_groups: int = 1, leaf: LeafValues = LOWEST_KNOWN) -> Values:
    """Value iteration from scratch.

    Unexpanded states have the values of ``leaf``. With LOWEST_KNOWN, they have the lowest value of the expanded states in their
    group; it is updated in every sweep. If unexpanded states had value zero instead, costs and income would seem to end there.
    If they had the mean value, they could be more attractive than a reward after which few states are expanded; the agent would
    then wander for ever.

    Args:
        graph: the state graph.
        goal: reward function.
        gamma: discount, below one.
        n_groups: number of groups in the graph, indexed 0 ... n_groups - 1.
        leaf: learned values of unexpanded states.
    """
    zeros = np.zeros((len(graph), graph.model.n_actions))
    values = Values(zeros[:, 0].copy(), zeros, score_edges(graph, goal), np.zeros(n_groups), leaf)
    if leaf is not LOWEST_KNOWN:
        evaluate(leaf, graph.states, graph.expanded, values.v)
    settle(graph, values, gamma)
    return values


def settle(graph: StateGraph, values: Values, gamma: float, max_sweeps: int = MAX_SWEEPS, only: Bools | None = None) -> None:
    """In-place value iteration that starts from the given values.

    Gauss-Seidel updates, last node first. If the graph has no cycles, nodes precede their successors and the values of
    unexpanded states are fixed, one sweep suffices.

    Args:
        graph: the state graph.
        values: initial values, updated in place.
        gamma: discount.
        max_sweeps: maximum number of sweeps.
        only: bool [G], the groups to update; None for all.
    """
    active = np.ones(len(values.frontier), dtype=np.bool_) if only is None else only.copy()
    sweep(graph.arrays, values, gamma, max_sweeps, active)


@compiled
def bellman(node: int, graph: GraphArrays, rewards: Floats, gamma: float, v: Floats, q: Floats) -> float:
    """Sets row ``node`` of ``q`` [N, A] from the successors' values in ``v`` [N]; returns the maximum of the row."""
    best = -np.inf
    for a in range(q.shape[1]):
        total = 0.0
        for e in range(graph.first[node, a], graph.first[node, a] + graph.counts[node, a]):
            future = 0.0 if graph.terminated[e] else gamma * v[graph.next_nodes[e]]
            total += graph.probabilities[e] * (rewards[e] + future)
        q[node, a] = total
        best = max(best, total)
    return best


@inlined
def _still_active(active: Bools, moved: Floats, tolerance: float, scale: Floats) -> bool:
    """Removes groups whose values moved little from ``active`` [G]; returns whether any is left."""
    left = False
    for g in range(len(active)):
        active[g] = active[g] and moved[g] > tolerance * max(scale[g], 1e-12)
        left = left or active[g]
    return bool(left)


@compiled
def _set_frontier(graph: GraphArrays, active: Bools, lows: Floats, moved: Floats, v: Floats, frontier: Floats) -> None:
    """Gives unexpanded states of active groups the group's lowest expanded value; updates ``moved``, ``v``, ``frontier``."""
    for g in range(len(frontier)):
        if active[g]:
            moved[g] = max(moved[g], abs(lows[g] - frontier[g]))
            frontier[g] = lows[g]
    for s in range(graph.sizes[0]):
        if active[graph.groups[s]] and not graph.expanded[s]:
            v[s] = frontier[graph.groups[s]]


@compiled
def sweep(graph: GraphArrays, values: Values, gamma: float, max_sweeps: int, active: Bools) -> None:
    """Sweeps over the ``active`` groups [G]; updates the values and overwrites ``active``."""
    # Every group has its own stopping criterion: its values must not depend on the other groups of the same call.
    v, q, rewards, n, n_groups = values.v, values.q, values.rewards, graph.sizes[0], len(values.frontier)
    lows, moved, scale = np.zeros(n_groups), np.zeros(n_groups), np.zeros(n_groups)
    for s in range(n):
        for a in range(q.shape[1]):
            expected = 0.0  # expected rewards, since a rare reward may be a thousand times larger than any other
            for e in range(graph.first[s, a], graph.first[s, a] + graph.counts[s, a]):
                expected += graph.probabilities[e] * rewards[e]
            scale[graph.groups[s]] = max(scale[graph.groups[s]], abs(expected))
    for _ in range(max_sweeps):
        for g in range(n_groups):
            moved[g], lows[g] = 0.0, np.inf
        for s in range(n - 1, -1, -1):
            g = graph.groups[s]
            if not (active[g] and graph.expanded[s]):
                continue
            best = bellman(s, graph, rewards, gamma, v, q)
            moved[g] = max(moved[g], abs(best - v[s]))
            v[s] = best
            lows[g] = min(lows[g], best)
        if len(values.leaf.common) == 0:
            _set_frontier(graph, active, lows, moved, v, values.frontier)
        if not _still_active(active, moved, TOLERANCE, scale):
            break


def break_ties(graph: StateGraph, q: Floats, roots: Ints, gamma: float) -> Floats:
    """Action scores [R, A]: Q-values, with ties broken in favour of actions that reach unexpanded states sooner.

    If all actions in the graph are equally good, rewards can only be found outside the graph. Among optimal policies, the scores
    prefer the one that reaches unexpanded states soonest. Otherwise, an agent that sees no reward would repeat the first action
    for ever.

    Args:
        graph: the state graph.
        q: float64 [N, A], values of all nodes' actions.
        roots: int64 [R], nodes to score.
        gamma: discount, here for each step until an unexpanded state.
    """
    scores = q[roots].copy()
    top = scores.max(axis=1, keepdims=True)
    slack = VALUE_TIE * np.maximum(np.abs(scores).max(axis=1, keepdims=True), 1e-12)
    tied = scores >= top - slack
    if (tied.sum(axis=1) < 2).all() or graph.expanded[graph.next_nodes[~graph.terminated]].all():
        return scores
    reach = np.zeros_like(q)
    _reach_unexpanded(graph.arrays, q, VALUE_TIE, gamma, MAX_NEWS_SWEEPS, reach)
    found = reach[roots]
    scores[tied] = (top + slack * (1.0 + found))[tied]
    return scores


@compiled
def _reach_unexpanded(graph: GraphArrays, q: Floats, tie: float, gamma: float, max_sweeps: int, reach: Floats) -> None:
    """Fills ``reach`` [N, A]: greatest discounted probability that a policy optimal for ``q`` reaches an unexpanded state."""
    n_groups = 0
    w = np.zeros(len(q))
    for s in range(len(q)):
        w[s], n_groups = 0.0 if graph.expanded[s] else 1.0, max(n_groups, graph.groups[s] + 1)
    active, moved, scale = np.ones(n_groups, dtype=np.bool_), np.zeros(n_groups), np.ones(n_groups)
    for _ in range(max_sweeps):
        for g in range(n_groups):
            moved[g] = 0.0
        for s in range(len(q) - 1, -1, -1):
            g = graph.groups[s]
            if not (active[g] and graph.expanded[s]):
                continue
            best, top, largest = 0.0, q[s, 0], 1e-12
            for a in range(q.shape[1]):
                top, largest = max(top, q[s, a]), max(largest, abs(q[s, a]))
            threshold = top - tie * largest
            for a in range(q.shape[1]):
                total = 0.0
                for e in range(graph.first[s, a], graph.first[s, a] + graph.counts[s, a]):
                    if not graph.terminated[e]:
                        total += gamma * graph.probabilities[e] * w[graph.next_nodes[e]]
                reach[s, a] = total
                if q[s, a] >= threshold:
                    best = max(best, total)
            moved[g] = max(moved[g], abs(best - w[s]))
            w[s] = best
        if not _still_active(active, moved, TOLERANCE, scale):
            break


SLIGHT = 1e-3
"""Errors of values below this share of their range are not worth a warning."""


def doubt(graph: StateGraph, values: Values, gamma: float) -> Floats | None:
    """Possible error of each action's value [N, A] due to merged rare outcomes; None if no outcomes were merged.

    The error of one step is the probability of the merged outcomes times the range of the values of all outcomes in the group;
    it is assumed that the merged outcomes also lie in this range. The discounted errors of later steps under the best policy are
    added. Also None if no error exceeds ``SLIGHT`` of the largest range.
    """
    if not graph.left_out.any():
        return None
    span = np.zeros(len(values.frontier))
    for group in range(len(span)):
        edges = np.flatnonzero(graph.groups[graph.sources] == group)
        if len(edges):
            after = np.where(graph.terminated[edges], 0.0, gamma * values.v[graph.next_nodes[edges]])
            span[group] = np.ptp(values.rewards[edges] + after)
    bounds = graph.left_out * span[graph.groups][:, None]
    _add_later_doubt(graph.arrays, values.q, gamma, bounds.copy(), bounds)
    return bounds if bounds.max() > SLIGHT * span.max() else None


@compiled
def _add_later_doubt(graph: GraphArrays, q: Floats, gamma: float, first: Floats, bounds: Floats) -> None:
    """Adds the errors of later steps to ``bounds`` [N, A], which initially equals ``first``."""
    for _ in range(MAX_NEWS_SWEEPS):
        moved = 0.0
        for s in range(len(q) - 1, -1, -1):
            for a in range(q.shape[1]):
                later = 0.0
                for e in range(graph.first[s, a], graph.first[s, a] + graph.counts[s, a]):
                    if not graph.terminated[e]:
                        node = graph.next_nodes[e]
                        later += graph.probabilities[e] * bounds[node, np.argmax(q[node])]
                moved = max(moved, abs(first[s, a] + gamma * later - bounds[s, a]))
                bounds[s, a] = first[s, a] + gamma * later
        if moved <= 1e-3 * first.max():
            break


def undecided(scores: Floats, q: Floats, bounds: Floats) -> Bools:
    """Rows [R] in which an unchosen action with a bound above 0 could be best; ``bounds`` [R, A]: errors of values ``q``."""
    rows, best = np.arange(len(q)), best_actions(scores)
    rivals = q + bounds > (q - bounds)[rows, best][:, None]
    rivals[rows, best] = False
    return np.asarray((rivals & (bounds > 0.0)).any(axis=1), dtype=np.bool_)


DRAWS, MOST_SMALL_SAMPLES = 4_000_000, 256
"""Maximum number of samples of a stochastic MDP, and of one (state, action): small MDPs get more samples for each."""


class SolvedMdp:
    """The MDP reachable from the start states, solved for each goal.

    Args:
        model: transition model.
        start: int64 [B, F], start states.
        max_states: if more states are reachable, ``graph`` is None.
        n_samples: number of samples for each (state, action) with too many successors to enumerate; small MDPs get more.
        seed: random seed of these samples.

    Attributes:
        graph: the reachable MDP, or None.
        values: solution of the MDP for the last goal, or None.
        bounds: see ``doubt``.
    """

    def __init__(self, model: TransitionModel, start: States, max_states: int, n_samples: int, seed: int) -> None:
        """See the class."""
        graph, complete = grow_reachable(model, start, max_states, n_samples, seed)
        self.graph = graph if complete and len(start) else None
        n_finer = _affordable(graph, n_samples)
        if self.graph is not None and n_finer > n_samples:
            finer, complete = grow_reachable(model, start, max_states, n_finer, seed)
            self.graph = finer if complete else graph
        self.values: Values | None = None
        self.bounds: Floats | None = None

    def set_goal(self, goal: Reward, gamma: float) -> None:
        """Solves the MDP for a goal."""
        if self.graph is not None:
            self.values = solve(self.graph, goal, gamma)
            self.bounds = doubt(self.graph, self.values, gamma)

    def find(self, states: States) -> NDArray[np.int64]:
        """Node of each state [B, F], int64 [B]; -1 if the state is not in the graph or not expanded."""
        if self.graph is None:
            return np.full(len(states), -1, dtype=np.int64)
        nodes = self.graph.find(states)
        return np.where((nodes >= 0) & self.graph.expanded[nodes], nodes, -1)


def _affordable(graph: StateGraph, n_samples: int) -> int:
    """Samples for each (state, action): if ``graph`` is stochastic, as many as DRAWS allows; at least ``n_samples``."""
    if n_samples >= MOST_SMALL_SAMPLES or graph.counts.max(initial=0) <= 1:
        return n_samples
    n_affordable = DRAWS // max(graph.counts.size, 1)
    return max(n_samples, min(MOST_SMALL_SAMPLES, 1 << max(n_affordable, 1).bit_length() - 1))
