"""Monte Carlo tree search for stochastic models (paper section 4.1), with values of the imagined machine at its leaves."""

from __future__ import annotations

import time
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Floats, States, TransitionModel
from mbagent.models.state_graph import StateGraph
from mbagent.planning.foresight import Foresight
from mbagent.planning.goal import Goal
from mbagent.planning.machine_planner import Imagined, MachinePlanner
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.reuse import MAX_KEPT, carry_over
from mbagent.planning.rollouts import random_returns
from mbagent.planning.tree import Ints, Paths, empty_paths
from mbagent.planning.value_iteration import Values, break_ties, score_edges, settle
from mbagent.planning.waves import Rules, Tables, begin_wave, end_wave, measure_spans
from mbagent_envs.random_keys import derive

FINAL_SWEEPS = 100
"""Sweeps of value iteration, at most, that settle the grown graph after the last simulation."""

LEAF_SAMPLES = 4
"""Draws for each (state, action) of a node that the search adds."""

MAX_SEARCHED = 100_000
"""Nodes at which a search with a time budget ends before its time; bounds the memory."""

_SEARCH_SALT, _CARRIED_SALT = 0x5EA6C4, 0xCA1212


class MctsPlanner(MachinePlanner):
    """UCT on a graph of imagined states.

    With ``leaf_values="machine"`` the search starts from the values of a lookahead machine around the root, each counting as
    ``prior_visits`` visits, and goes on growing it where it looks promising; where the whole reachable machine is known and
    solved there is nothing to search for.
    With ``leaf_values="rollouts"`` it starts from nothing and values leaves by random play, as textbook UCT does.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Takes the settings; a model and a goal must follow."""
        super().__init__(settings)
        self._last: _Search | None = None
        self._spare: StateGraph | None = None
        self.settling = 0.0
        """Seconds that the last search with a time budget took to settle a node, after its simulations."""

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner."""
        super().set_model(model, start_states)
        self._last, self._spare = None, None

    def set_goal(self, goal: Goal) -> None:
        """See Planner."""
        super().set_goal(goal)
        self._last = None

    def forget(self) -> None:
        """Drops what was kept of the last decision (with ``reuse_tree``)."""
        self._last = None

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        if len(roots) > 1:
            self._last = None
        if self.settings.leaf_values == "machine":
            return super().plan(roots)
        found = self._imagine(roots)
        return Plan(best_actions(found.scores), found.solution.q[found.nodes], found.visits)

    def foresee(self, root: States) -> Foresight:
        """See MachinePlanner."""
        return super().foresee(root) if self.settings.leaf_values == "machine" else self._foresight(self._imagine(root), 0)

    def _imagine(self, roots: States) -> Imagined:
        """Searches from each root [R, F]."""
        settings = self.settings
        deadline = None if settings.time_budget is None else time.perf_counter() + len(roots) * settings.time_budget
        search = self._carried_on(roots) if settings.reuse_tree else None
        if search is None:
            begin = self._lookahead if settings.leaf_values == "machine" else self._bare_roots
            graph, solution, nodes = begin(roots)
            search = _Search(self, graph, _first_tables(solution, nodes), nodes)
        found = search.run(deadline)
        if settings.reuse_tree and len(roots) == 1:
            self._last = search
        return found

    def _carried_on(self, roots: States) -> _Search | None:
        """The last decision's search, from a new root on; None where it knows too little of it, or is too large."""
        last, self._last = self._last, None  # should the goal fail now, nothing half done is kept
        if last is None or len(roots) != 1 or len(last.graph) > MAX_KEPT:
            return None
        root = int(last.graph.find(roots)[0])
        if root < 0 or not last.graph.expanded[root]:
            return None
        graph = self._spare = self._spare if self._spare is not None else StateGraph(self._known_model())
        tables = carry_over(last.graph, last.tables, root, graph)
        if self.settings.leaf_values == "machine" and 2 * graph.expanded.sum() < self._chosen_way().states:
            return None
        self._imagined, self._spare = graph, last.graph
        return _Search(self, graph, tables, np.zeros(1, dtype=np.int64), last.decision + 1)

    def _bare_roots(self, roots: States) -> tuple[StateGraph, Values, Ints]:
        """As ``_lookahead``: the roots with their successors, all worth nothing yet."""
        graph = self._empty_graph()
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        graph.expand(nodes, self.settings.n_samples, self.settings.seed)
        nothing = np.zeros((len(graph), graph.model.n_actions))
        rewards = score_edges(graph, self._known_goal())
        return graph, Values(nothing[:, 0].copy(), nothing, rewards, np.zeros(len(roots))), nodes


class _Search:
    """One batch of searches, one for each root; the roots' parts of the graph do not touch."""

    def __init__(self, planner: MctsPlanner, graph: StateGraph, tables: Tables, roots: Ints, decision: int = 0) -> None:
        self.planner, self.graph, self.tables, self.roots, self.decision = planner, graph, tables, roots, decision
        settings = self.settings = planner.settings
        rollouts = settings.leaf_values == "rollouts"
        prior = 0.0 if rollouts else settings.prior_visits
        # What is carried on must not meet the very luck that it was made of.
        key = derive(settings.seed, _CARRIED_SALT, decision)[0] if decision else _key(settings.seed, 0)
        self.rules = Rules(settings.gamma, settings.c_uct, prior, rollouts, settings.backup == "mean", key)
        if not (rollouts and decision):
            measure_spans(graph.arrays, roots, self.tables)

    def run(self, deadline: float | None = None) -> Imagined:
        """Runs all simulations, or those that there is time for; ``deadline`` is a value of ``time.perf_counter``."""
        if deadline is not None:
            return self._run_until(deadline)
        settings, done = self.settings, 0
        wave = min(settings.wave, settings.num_simulations)
        paths, leaves = empty_paths(len(self.roots), wave, settings.horizon), np.empty(2 * len(self.roots) * wave, dtype=np.int64)
        while done < settings.num_simulations:
            if settings.num_simulations - done < wave:
                wave = settings.num_simulations - done
                paths = empty_paths(len(self.roots), wave, settings.horizon)
            self._wave(paths, leaves, done)
            done += wave
        return self._result()

    def _run_until(self, deadline: float) -> Imagined:
        """Runs waves, one at least, until another one and what comes after the last would not be done in time."""
        wave, done, now = self.settings.wave, 0, time.perf_counter()
        paths = empty_paths(len(self.roots), wave, self.settings.horizon)
        leaves = np.empty(2 * len(self.roots) * wave, dtype=np.int64)
        last = 0.0
        while done == 0 or (now + last + self.planner.settling * len(self.graph) < deadline and len(self.graph) < MAX_SEARCHED):
            began = now
            self._wave(paths, leaves, done)
            done, now = done + wave, time.perf_counter()
            last = now - began
        found = self._result()
        self.planner.settling = (time.perf_counter() - now) / len(self.graph)
        return found

    def _result(self) -> Imagined:
        graph, roots, t = self.graph, self.roots, self.tables
        n, m, visits = len(graph), graph.n_edges, self.tables.root_visits
        solution = Values(t.v[:n], t.q[:n], t.rewards[:m], t.frontier, t.leaf)
        if self.settings.backup == "mean":
            return Imagined(graph, roots, solution, visits, visits + 1e-6 * _unit(t.q[roots]), t.visits[:n])
        settle(graph, solution, self.settings.gamma, FINAL_SWEEPS)
        return Imagined(graph, roots, solution, visits, break_ties(graph, solution.q, roots, self.settings.gamma))

    def _wave(self, paths: Paths, leaves: Ints, done: int) -> None:
        """A wave of simulations: one call of the model, one of the goal."""
        graph, rules = self.graph, self.rules
        n, n_widened = begin_wave(graph.arrays, self.roots, self.tables, rules, done, paths, leaves)
        n_nodes, n_edges, first = len(graph), graph.n_edges, paths.leaves.size
        draws = self.settings.n_samples if rules.rollouts else LEAF_SAMPLES
        graph.expand(leaves[:n], draws, int(_key(self.settings.seed, done + 1)))
        self._make_room()
        self.tables.rewards[n_edges : graph.n_edges] = score_edges(graph, self.planner._known_goal(), n_edges)
        ends = self._rollouts(paths, done) if rules.rollouts else np.empty(paths.ends.shape)
        widened = leaves[first : first + n_widened]
        end_wave(graph.arrays, self.roots, self.tables, rules, n_nodes, leaves[:n], widened, paths, ends)

    def _make_room(self) -> None:
        """Lengthens the tables to the graph's length."""
        tables, n, m = self.tables, len(self.graph), self.graph.n_edges
        if len(tables.v) < n:
            v, q, visits, counted = (_longer(table, 2 * n) for table in tables[:4])
            tables = tables._replace(v=v, q=q, visits=visits, counted=counted)
        if len(tables.rewards) < m:
            tables = tables._replace(rewards=_longer(tables.rewards, 2 * m))
        self.tables = tables

    def _rollouts(self, paths: Paths, done: int) -> Floats:
        """Value [R, W] of the node each simulation ended at, by random play."""
        values, settings = np.zeros(paths.ends.shape), self.settings
        alive = paths.ends >= 0
        simulation = np.broadcast_to(done + np.arange(paths.ends.shape[1]), paths.ends.shape)[alive]
        keys = derive(settings.seed, _SEARCH_SALT, simulation)
        states = self.graph.states[paths.ends[alive]]
        model, goal = self.planner._known_model(), self.planner._known_goal()
        values[alive] = random_returns(model, goal, states, keys, settings.horizon, settings.gamma)
        return values


def _first_tables(solution: Values, roots: Ints) -> Tables:
    """Tables before the first simulation."""
    q, spread = solution.q, solution.v[roots]
    return Tables(
        solution.v, q, np.zeros_like(q), np.zeros_like(q), solution.rewards, solution.frontier,
        np.zeros((len(roots), q.shape[1])), np.ones(len(roots)), np.stack([spread, spread], axis=1), solution.leaf,
    )  # fmt: skip


@lru_cache(maxsize=4096)
def _key(seed: int, wave: int) -> np.uint64:
    """Key of the search's luck (0), and of what the wave after ``wave - 1`` simulations imagines."""
    key: np.uint64 = (derive(seed, _SEARCH_SALT) if wave == 0 else derive(seed, _SEARCH_SALT, wave))[0]
    return key


def _longer(table: NDArray[np.float64], size: int) -> Floats:
    longer = np.empty((size, *table.shape[1:]))
    longer[: len(table)] = table
    return longer


def _unit(values: Floats) -> Floats:
    """Values [R, A] brought to 0 ... 1 by row, for breaking ties."""
    low, high = values.min(axis=1, keepdims=True), values.max(axis=1, keepdims=True)
    unit: Floats = (values - low) / np.maximum(high - low, 1e-12)
    return unit
