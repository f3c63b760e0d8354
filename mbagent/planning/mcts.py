"""Monte Carlo tree search for stochastic models (paper section 4.1), with values of the imagined machine at its leaves."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import Floats, States
from mbagent.models.state_graph import StateGraph
from mbagent.planning.lookahead import place_in_group
from mbagent.planning.machine_planner import MachinePlanner
from mbagent.planning.planner import Plan, best_actions
from mbagent.planning.rollouts import random_returns
from mbagent.planning.tree import Ints, Paths, back_up_max, back_up_mean, empty_paths, initialise, select
from mbagent.planning.value_iteration import Values, break_ties, score_edges, settle
from mbagent_envs.random_keys import derive

FINAL_SWEEPS = 100
"""Sweeps of value iteration, at most, that settle the grown graph after the last simulation."""

WIDENING_SWEEPS = 3
"""The same after a wave that widened the graph."""

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
        graph.expand(nodes, self.settings.n_samples, self.settings.seed)
        nothing = np.zeros((len(graph), graph.model.n_actions))
        rewards = score_edges(graph, self._known_goal())
        solution = Values(nothing[:, 0].copy(), nothing, rewards, np.zeros(len(roots)))
        values, visits, scores = self._search(graph, solution, nodes, shared=False)
        return Plan(best_actions(scores), values, visits)

    def _search(self, graph: StateGraph, solution: Values, nodes: Ints, shared: bool) -> tuple[Floats, Floats, Floats]:
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
        self.solution = Values(solution.v.copy(), solution.q.copy(), solution.rewards, solution.frontier.copy())
        self.root_visits = np.zeros((len(roots), graph.model.n_actions))
        self.visits, self.counted = np.zeros_like(solution.q), np.zeros_like(solution.q)
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
            self._count(paths)
            if not self.rollouts:
                self.spans = _spans(self.graph, self.solution, self.roots)
            done += wave
        values, visits = self.solution.q, self.root_visits
        if settings.backup == "mean":
            return values[self.roots], visits, visits + 1e-6 * _unit(values[self.roots])
        settle(self.graph, self.solution, settings.gamma, FINAL_SWEEPS)
        return values[self.roots], visits, break_ties(self.graph, values, self.roots, settings.gamma)

    def _count(self, paths: Paths) -> None:
        """First actions of the wave's simulations; a root met again further down does not count."""
        rows = np.repeat(np.arange(len(self.roots)), paths.lengths.shape[1])
        moved = paths.lengths.ravel() > 0
        np.add.at(self.root_visits, (rows[moved], self.graph.actions[paths.edges[:, :, 0].ravel()[moved]]), 1.0)

    def _select(self, paths: Paths, done: int) -> None:
        graph, settings = self.graph, self.settings
        select(
            self.roots,
            graph.arrays,
            self.solution.q,
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
        graph, solution = self.graph, self.solution
        leaves = np.unique(paths.leaves[paths.leaves >= 0])
        widened = np.zeros(0, dtype=np.int64) if self.rollouts else self._widen(paths)
        leaves = np.union1d(leaves, widened)
        if len(leaves) == 0:
            return
        n_edges = graph.n_edges
        draws = self.settings.n_samples if self.rollouts else LEAF_SAMPLES
        fresh = graph.expand(leaves, draws, int(derive(self.settings.seed, _SEARCH_SALT, done + 1)[0]))
        solution.rewards = np.concatenate([solution.rewards, score_edges(graph, self.planner._known_goal(), n_edges)])
        room = np.zeros((len(fresh), graph.model.n_actions))
        solution.q, self.visits, self.counted = (np.concatenate([x, room]) for x in (solution.q, self.visits, self.counted))
        solution.v = np.concatenate([solution.v, solution.frontier[graph.groups[fresh]]])
        if self.rollouts:
            return
        self._bellman(leaves)
        if len(widened):  # no path leads there yet that a backup would follow
            only = np.isin(np.arange(len(solution.frontier)), graph.groups[widened])
            settle(graph, solution, self.settings.gamma, WIDENING_SWEEPS, only)

    def _widen(self, paths: Paths) -> Ints:
        """For every simulation that only went round in known states: the state that has waited longest, instead."""
        idle = ((paths.leaves < 0) & (paths.ends >= 0)).sum(axis=1)
        graph = self.graph
        if not idle.any() or graph.expanded.all():
            return np.zeros(0, dtype=np.int64)
        waiting = np.flatnonzero(~graph.expanded)
        waiting = waiting[~graph.only_terminal(waiting)]
        allowance = np.zeros(graph.groups.max() + 1, dtype=np.int64)
        allowance[graph.groups[self.roots]] = idle
        groups = graph.groups[waiting]
        return waiting[place_in_group(groups) < allowance[groups]]

    def _bellman(self, nodes: Ints) -> None:
        solution = self.solution
        initialise(nodes, self.graph.arrays, solution.rewards, self.settings.gamma, solution.v, solution.q)

    def _back_up(self, paths: Paths, done: int) -> None:
        graph, gamma, solution = self.graph.arrays, self.settings.gamma, self.solution
        if self.settings.backup == "max":
            back_up_max(graph, solution.rewards, gamma, paths.edges, paths.lengths, solution.v, solution.q)
            return
        back_up_mean(
            graph,
            solution.rewards,
            gamma,
            self.prior,
            paths.edges,
            paths.lengths,
            self._end_values(paths, done),
            self.counted,
            solution.q,
            self.spans,
            self.extremes,
        )

    def _end_values(self, paths: Paths, done: int) -> Floats:
        """Value [R, W] of the node each simulation ended at."""
        values = np.zeros(paths.ends.shape)
        alive = paths.ends >= 0
        if not self.rollouts:
            values[alive] = self.solution.v[paths.ends[alive]]
            return values
        settings = self.settings
        simulation = np.broadcast_to(done + np.arange(paths.ends.shape[1]), paths.ends.shape)[alive]
        keys = derive(settings.seed, _SEARCH_SALT, simulation)
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
