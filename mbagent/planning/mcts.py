"""Monte Carlo tree search for stochastic models (paper section 4.1), with values of the imagined machine at its leaves."""

from __future__ import annotations

import numpy as np
from mbagent_envs.random_keys import derive

from mbagent.models.base import Floats, States
from mbagent.models.state_graph import StateGraph
from mbagent.planning.machine_planner import MachinePlanner
from mbagent.planning.planner import Plan, best_actions
from mbagent.planning.rollouts import random_returns
from mbagent.planning.tree import Ints, Paths, back_up_max, back_up_mean, empty_paths, initialise, select
from mbagent.planning.value_iteration import Values, score_edges

LEAF_SAMPLES = 4
"""Draws for each (state, action) of a node that the search adds."""

_SEARCH_SALT = 0x5EA6C4


class MctsPlanner(MachinePlanner):
    """UCT on a graph of imagined states.

    With ``leaf_values="machine"`` the search starts from the values of the reachable machine (or of a lookahead machine
    around the root, which it goes on growing where it looks promising), each counting as ``prior_visits`` visits.
    With ``leaf_values="rollouts"`` it starts from nothing and values leaves by random play, as textbook UCT does.
    """

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        if self.settings.leaf_values == "machine":
            return super().plan(roots)
        graph = StateGraph(self._known_model())
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        values, visits, scores = self._search(graph, _nothing(graph, len(roots)), nodes, shared=False)
        return Plan(best_actions(scores), values, visits)

    def _search(
        self, graph: StateGraph, solution: Values, nodes: Ints, shared: bool
    ) -> tuple[Floats, Floats, Floats]:
        if not shared:
            return _Search(self, graph, solution, nodes).run()
        # Roots within one shared machine: each searches on its own copy of the values.
        parts = [_Search(self, graph, solution, nodes[r : r + 1]).run() for r in range(len(nodes))]
        values, visits, scores = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return values, visits, scores


class _Search:
    """One batch of searches, one for each root; the roots' parts of the graph do not touch, or there is one root."""

    def __init__(self, planner: MctsPlanner, graph: StateGraph, solution: Values, roots: Ints) -> None:
        self.planner, self.graph, self.roots = planner, graph, roots
        self.settings = planner.settings
        self.rollouts = self.settings.leaf_values == "rollouts"
        self.prior = 0.0 if self.rollouts else self.settings.prior_visits
        self.q, self.v, self.rewards = solution.q.copy(), solution.v.copy(), solution.rewards
        self.frontier = solution.frontier
        self.visits, self.counted = np.zeros_like(self.q), np.zeros_like(self.q)
        spread = solution.v[roots]
        self.extremes = np.stack([spread, spread], axis=1)
        self.spans = _spans(graph, solution, roots)

    def run(self) -> tuple[Floats, Floats, Floats]:
        """Runs all simulations; returns (values, visits, scores) [R, A] of the roots."""
        settings, done = self.settings, 0
        while done < settings.num_simulations:
            wave = min(settings.wave, settings.num_simulations - done)
            paths = empty_paths(len(self.roots), wave, settings.horizon)
            self._select(paths, done)
            self._expand(paths, done)
            self._back_up(paths, done)
            done += wave
        values, visits = self.q[self.roots], self.visits[self.roots]
        return values, visits, (visits + 1e-6 * _unit(values) if self.settings.backup == "mean" else values)

    def _select(self, paths: Paths, done: int) -> None:
        graph, settings = self.graph, self.settings
        select(
            self.roots,
            graph.expanded,
            graph.first,
            graph.count,
            graph.next_nodes,
            graph.probabilities,
            graph.terminated,
            self.q,
            self.visits,
            self.spans,
            self.prior,
            settings.c_uct,
            derive(settings.seed, _SEARCH_SALT)[0],
            done,
            paths.edges,
            paths.lengths,
            paths.leaves,
            paths.ends,
        )

    def _expand(self, paths: Paths, done: int) -> None:
        """Adds the wave's leaves to the graph: one call of the model, one of the goal."""
        graph, leaves = self.graph, np.unique(paths.leaves[paths.leaves >= 0])
        if len(leaves) == 0:
            return
        n_edges = graph.n_edges
        draws = self.settings.n_samples if self.rollouts else LEAF_SAMPLES
        fresh = graph.expand(leaves, draws, int(derive(self.settings.seed, _SEARCH_SALT, done + 1)[0]))
        self.rewards = np.concatenate([self.rewards, score_edges(graph, self.planner._known_goal(), n_edges)])
        n_actions = self.q.shape[1]
        room = np.zeros((len(fresh), n_actions))
        self.q, self.visits, self.counted = (np.concatenate([x, room]) for x in (self.q, self.visits, self.counted))
        self.v = np.concatenate([self.v, self.frontier[graph.groups[fresh]]])
        if not self.rollouts:
            self._bellman(leaves)

    def _bellman(self, nodes: Ints) -> None:
        graph = self.graph
        initialise(
            nodes,
            graph.first,
            graph.count,
            graph.next_nodes,
            graph.probabilities,
            graph.terminated,
            self.rewards,
            self.settings.gamma,
            self.v,
            self.q,
        )

    def _back_up(self, paths: Paths, done: int) -> None:
        graph, gamma = self.graph, self.settings.gamma
        if self.settings.backup == "max":
            back_up_max(
                graph.sources,
                graph.first,
                graph.count,
                graph.next_nodes,
                graph.probabilities,
                graph.terminated,
                self.rewards,
                gamma,
                paths.edges,
                paths.lengths,
                self.v,
                self.q,
            )
            return
        back_up_mean(
            graph.sources,
            graph.actions,
            self.rewards,
            gamma,
            self.prior,
            paths.edges,
            paths.lengths,
            self._end_values(paths, done),
            self.counted,
            self.q,
            self.spans,
            self.extremes,
        )

    def _end_values(self, paths: Paths, done: int) -> Floats:
        """Value [R, W] of the node each simulation ended at."""
        values = np.zeros(paths.ends.shape)
        alive = paths.ends >= 0
        if not self.rollouts:
            values[alive] = self.v[paths.ends[alive]]
            return values
        settings = self.settings
        simulation = np.broadcast_to(done + np.arange(paths.ends.shape[1]), paths.ends.shape)[alive]
        keys = derive(np.full(len(simulation), settings.seed, dtype=np.uint64), _SEARCH_SALT, simulation)
        states = self.graph.states[paths.ends[alive]]
        model, goal = self.planner._known_model(), self.planner._known_goal()
        values[alive] = random_returns(model, goal, states, keys, settings.horizon, settings.gamma)
        return values


def _spans(graph: StateGraph, solution: Values, roots: Ints) -> Floats:
    """Range [R] of the values of the expanded states around each root, at least that of the rewards."""
    groups = graph.groups
    low, high = np.full(groups.max() + 1, np.inf), np.full(groups.max() + 1, -np.inf)
    known = graph.expanded
    np.minimum.at(low, groups[known], solution.v[known])
    np.maximum.at(high, groups[known], solution.v[known])
    edge_groups = groups[graph.sources]
    if len(solution.rewards):
        np.maximum.at(high, edge_groups, low[edge_groups] + np.abs(solution.rewards))
    spans = (high - low)[groups[roots]]
    return np.where(np.isfinite(spans) & (spans > 0.0), spans, 1.0)


def _unit(values: Floats) -> Floats:
    """Values [R, A] brought to 0 ... 1 by row, for breaking ties."""
    low, high = values.min(axis=1, keepdims=True), values.max(axis=1, keepdims=True)
    unit: Floats = (values - low) / np.maximum(high - low, 1e-12)
    return unit


def _nothing(graph: StateGraph, n_groups: int) -> Values:
    """Values of a graph of which nothing is known yet."""
    nothing = np.zeros((len(graph), graph.model.n_actions))
    return Values(np.zeros(len(graph)), nothing, np.zeros(0), nothing, np.zeros(n_groups))
