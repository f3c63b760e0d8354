"""Planners: value iteration on the reachable MDP (paper section 2), and tree search if it is too large (paper section 4.1).

If the reachable MDP is small, it is solved once for each reward. Otherwise a lookahead around each observation is solved, and
Monte Carlo tree search starts from its values.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.mdp import StateGraph
from mbagent.models.protocol import TransitionModel
from mbagent.planning.fitted_value_iteration import Task, learn_values
from mbagent.planning.flat_monte_carlo import random_returns
from mbagent.planning.lookahead import grow_lookahead
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.racing import LookaheadConfig, best_config
from mbagent.planning.search import (
    MAX_KEPT,
    Batch,
    SearchRules,
    SearchTree,
    advance,
    backup,
    carry_over,
    empty_batch,
    measure_spans,
    take_in,
)
from mbagent.planning.trajectories import PlanTrace, best_policy
from mbagent.planning.value_iteration import (
    LOWEST_KNOWN,
    SolvedMdp,
    Values,
    break_ties,
    doubt,
    score_edges,
    settle,
    solve,
    undecided,
)
from mbagent.types import Actions, Floats, Ints, Reward, States
from mbagent_envs.random_keys import derive

RACED: dict[str, Any] = {"time_budget": None, "reuse_tree": False}
"""Settings during races between lookahead configurations, whose result must depend neither on time nor on earlier decisions."""

ROOTS_AT_ONCE = 16
"""Number of roots that are expanded together; bounds the memory."""


class Expanded(NamedTuple):
    """State graph and values around R roots.

    Attributes:
        graph: root r is in group r.
        nodes: int64 [R], the roots.
        solution: values of the graph.
        visits: [R, A], number of simulations that start with each root action.
        scores: [R, A], by which actions are chosen.
        tried: [N, A], visit counts of all nodes' actions if they determine the policy; None if the values do.
    """

    graph: StateGraph
    nodes: Ints
    solution: Values
    visits: Floats
    scores: Floats
    tried: Floats | None = None


class ValueIterationPlanner:
    """Acts greedily on the values of the reachable MDP.

    If at most ``max_states`` states are reachable from the start states, this MDP is generated once for the model and solved
    once for each goal. For each root outside this MDP, a lookahead is expanded and solved.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Stores the settings; set a model and a goal before planning."""
        self.settings = settings
        self._model: TransitionModel | None = None
        self._goal: Reward | None = None
        self._start: States | None = None
        self._mdp: SolvedMdp | None = None
        self._expanded: StateGraph | None = None
        self.config: LookaheadConfig | None = None
        """Lookahead configuration for the goal; if None, it is chosen when the first lookahead is needed."""
        self._warned = False

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner. The reachable MDP is generated at the next ``plan``."""
        self._model, self._start, self._mdp, self._expanded, self.config = model, start_states, None, None, None

    def set_goal(self, goal: Reward) -> None:
        """See Planner. The reachable MDP is kept, its values are dropped."""
        if self._mdp is not None:
            self._mdp.values = None  # before the goal changes, so that an interrupt cannot leave values of another goal
        self._goal, self.config, self._warned = goal, None, False

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        mdp = self._solved_mdp()
        nodes = mdp.find(roots)
        n_actions = self._known_model().n_actions
        values, visits = np.zeros((len(roots), n_actions)), np.zeros((len(roots), n_actions))
        scores, known = np.zeros((len(roots), n_actions)), np.flatnonzero(nodes >= 0)
        if len(known) and mdp.graph is not None and mdp.values is not None:
            values[known] = mdp.values.q[nodes[known]]
            scores[known] = break_ties(mdp.graph, mdp.values.q, nodes[known], self.settings.gamma)
            self._warn_of_errors(mdp.bounds, nodes[known], scores[known], values[known])
        unknown = np.flatnonzero(nodes < 0)
        for begin in range(0, len(unknown), ROOTS_AT_ONCE):
            chunk = unknown[begin : begin + ROOTS_AT_ONCE]
            found = self._expand(roots[chunk])
            values[chunk], visits[chunk], scores[chunk] = found.solution.q[found.nodes], found.visits, found.scores
            if not self._warned:
                bounds = doubt(found.graph, found.solution, self.settings.gamma)
                self._warn_of_errors(bounds, found.nodes, scores[chunk], values[chunk])
        return Plan(best_actions(scores), values, visits)

    def _warn_of_errors(self, bounds: Floats | None, nodes: Ints, scores: Floats, values: Floats) -> None:
        """Warns, once for each goal, if the merging of rare outcomes could change the choice of an action."""
        if self._warned or bounds is None or not undecided(scores, values, bounds[nodes]).any():
            return
        self._warned, settings = True, self.settings
        warnings.warn(
            f"There are more rare outcomes than plans can represent, so some of them were merged; values may be off by up to "
            f"{bounds[nodes].max():.3g}, which could change the choice of an action: raise n_samples (now {settings.n_samples}) "
            f"and lookahead_samples (now {settings.lookahead_samples}) in policy_kwargs.",
            stacklevel=2,
        )

    def trace(self, root: States) -> PlanTrace:
        """Trace of the plan from one root [1, F]; see PlanTrace."""
        mdp = self._solved_mdp()
        nodes = mdp.find(root)
        if nodes[0] < 0 or mdp.graph is None or mdp.values is None:
            return self._trace_of(self._expand(root), 0)
        graph, solution = mdp.graph, mdp.values
        scores = break_ties(graph, solution.q, nodes, self.settings.gamma)
        zeros = np.zeros((1, graph.model.n_actions))
        return self._trace_of(Expanded(graph, nodes, solution, zeros, scores), int(graph.expanded.sum()))

    def _trace_of(self, found: Expanded, mdp_states: int) -> PlanTrace:
        plan = Plan(best_actions(found.scores), found.solution.q[found.nodes], found.visits)
        policy = best_policy(found.graph, found.solution.q, self.settings.gamma, found.tried)
        solution = found.solution
        return PlanTrace(plan, found.graph, int(found.nodes[0]), solution.rewards, policy, solution.v, mdp_states)

    def _expand(self, roots: States) -> Expanded:
        """Expands and solves a lookahead around each root [R, F]; no search follows."""
        graph, solution, nodes = self._lookahead(roots)
        scores = break_ties(graph, solution.q, nodes, self.settings.gamma)
        return Expanded(graph, nodes, solution, np.zeros_like(scores), scores)

    def _empty_graph(self) -> StateGraph:
        """An empty graph for the next roots, in the memory of the previous graph."""
        if self._expanded is None:
            self._expanded = StateGraph(self._known_model())
        self._expanded.clear()
        return self._expanded

    def _lookahead(self, roots: States) -> tuple[StateGraph, Values, Ints]:
        """A solved lookahead around each root [R, F]; root r is in group r. Returns (graph, values, root nodes)."""
        config, graph, settings = self._chosen_config(), self._empty_graph(), self.settings
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        grow_lookahead(graph, nodes, config.states, config.samples, settings.horizon, settings.seed)
        return graph, solve(graph, self._known_goal(), settings.gamma, len(roots), config.leaf), nodes

    def _chosen_config(self) -> LookaheadConfig:
        """Lookahead configuration for this goal: the one in the settings, or the winner of a race if leaf values are learned."""
        if self.config is None:
            settings, start = self.settings, self._start
            default = LookaheadConfig(LOWEST_KNOWN, settings.lookahead_states, settings.lookahead_samples)
            if settings.learn_values and start is not None and len(start):
                default = self._race(default, Task(self._known_model(), self._known_goal(), start, settings.gamma, settings.seed))
            self.config = default
        return self.config

    def _race(self, default: LookaheadConfig, task: Task) -> LookaheadConfig:
        """Learns the goal's leaf values; races lookaheads with them, without them, and with them expanding only the root."""
        settings = self.settings
        leaf, visited = learn_values(task)
        if len(leaf.common) == 0:
            return default

        def act(config: LookaheadConfig, states: States) -> Actions:
            racer.config = config
            return best_actions(racer._expand(states).scores)

        racer = type(self)(replace(settings, **RACED))
        racer.set_model(task.model, task.start)
        racer.set_goal(task.goal)
        configs = (default._replace(leaf=leaf), default, LookaheadConfig(leaf, 1, settings.n_samples))
        return best_config(replace(task, start=visited), configs, act)

    def _solved_mdp(self) -> SolvedMdp:
        if self._mdp is None:
            assert self._start is not None or self._model is None
            model, start, settings = self._known_model(), self._start, self.settings
            if start is None:
                raise RuntimeError("The planner has no start states; call set_model first.")
            self._mdp = SolvedMdp(model, start, settings.max_states, settings.n_samples, settings.seed)
        if self._mdp.values is None:
            self._mdp.set_goal(self._known_goal(), self.settings.gamma)
        return self._mdp

    def _known_model(self) -> TransitionModel:
        if self._model is None:
            raise RuntimeError("The planner has no model yet; call set_model first.")
        return self._model

    def _known_goal(self) -> Reward:
        if self._goal is None:
            raise RuntimeError("The planner has no goal yet; call set_goal first.")
        return self._goal


FINAL_SWEEPS = 100
"""Maximum number of sweeps of value iteration on the graph after the last simulation."""

LEAF_SAMPLES = 4
"""Number of samples for each (state, action) of a node that the search expands."""

MAX_SEARCHED = 100_000
"""Number of nodes at which a search ends before its time budget is used; bounds the memory."""

_SEARCH_SALT, _REUSE_SALT = 0x5EA6C4, 0xCA1212


class MctsPlanner(ValueIterationPlanner):
    """UCT on a state graph.

    With ``leaf_values="lookahead"`` the search starts from the values of a lookahead around the root and expands promising
    states further. Each initial value counts for ``prior_visits`` visits. If the root is in a solved MDP, there is no search.
    With ``leaf_values="rollouts"`` the search starts without values and evaluates leaves by random play, as in textbook UCT.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Stores the settings; set a model and a goal before planning."""
        super().__init__(settings)
        self._last: _Search | None = None
        self._spare: StateGraph | None = None
        self.settling = 0.0
        """Seconds for each node that the final value iteration of the last search with a time budget took."""

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner."""
        super().set_model(model, start_states)
        self._last, self._spare = None, None

    def set_goal(self, goal: Reward) -> None:
        """See Planner."""
        super().set_goal(goal)
        self._last = None

    def forget(self) -> None:
        """Drops the search of the last decision (kept with ``reuse_tree``)."""
        self._last = None

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        if len(roots) > 1:
            self._last = None
        if self.settings.leaf_values == "lookahead":
            return super().plan(roots)
        found = self._expand(roots)
        return Plan(best_actions(found.scores), found.solution.q[found.nodes], found.visits)

    def trace(self, root: States) -> PlanTrace:
        """See ValueIterationPlanner."""
        return super().trace(root) if self.settings.leaf_values == "lookahead" else self._trace_of(self._expand(root), 0)

    def _expand(self, roots: States) -> Expanded:
        """Searches from each root [R, F]."""
        settings = self.settings
        deadline = None if settings.time_budget is None else time.perf_counter() + len(roots) * settings.time_budget
        search = self._reused_search(roots) if settings.reuse_tree else None
        if search is None:
            begin = self._lookahead if settings.leaf_values == "lookahead" else self._expanded_roots
            graph, solution, nodes = begin(roots)
            search = _Search(self, graph, _first_tree(solution, nodes))
        found = search.run(deadline)
        if settings.reuse_tree and len(roots) == 1:
            self._last = search
        return found

    def _reused_search(self, roots: States) -> _Search | None:
        """Last decision's search with a new root; None if its states are too many, or too few are reachable from the root."""
        last, self._last = self._last, None  # if the goal fails now, no incomplete search is kept
        if last is None or len(roots) != 1 or len(last.graph) > MAX_KEPT:
            return None
        root = int(last.graph.find(roots)[0])
        if root < 0 or not last.graph.expanded[root]:
            return None
        graph = self._spare = self._spare if self._spare is not None else StateGraph(self._known_model())
        tree = carry_over(last.graph, last.tree, root, graph)
        if self.settings.leaf_values == "lookahead" and 2 * graph.expanded.sum() < self._chosen_config().states:
            return None
        self._expanded, self._spare = graph, last.graph
        return _Search(self, graph, tree, last.decision + 1)

    def _expanded_roots(self, roots: States) -> tuple[StateGraph, Values, Ints]:
        """Like ``_lookahead``, but only the roots are expanded, and all values are 0."""
        graph = self._empty_graph()
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        graph.expand(nodes, self.settings.n_samples, self.settings.seed)
        zeros = np.zeros((len(graph), graph.model.n_actions))
        rewards = score_edges(graph, self._known_goal())
        return graph, Values(zeros[:, 0].copy(), zeros, rewards, np.zeros(len(roots))), nodes


class _Search:
    """Runs one search for each root of a batch; no edge connects the groups of different roots."""

    def __init__(self, planner: MctsPlanner, graph: StateGraph, tree: SearchTree, decision: int = 0) -> None:
        self.planner, self.graph, self.tree, self.decision = planner, graph, tree, decision
        settings = self.settings = planner.settings
        rollouts = settings.leaf_values == "rollouts"
        prior = 0.0 if rollouts else settings.prior_visits
        # A reused tree must not see the random numbers that it was built with.
        key = derive(settings.seed, _REUSE_SALT, decision)[0] if decision else _key(settings.seed, 0)
        self.rules = SearchRules(
            settings.gamma, float(settings.c_uct), float(prior), rollouts, settings.batch_size, settings.backup == "mean", key
        )
        if not (rollouts and decision):
            measure_spans(graph.arrays, tree)

    def run(self, deadline: float | None = None) -> Expanded:
        """Runs all simulations; with ``deadline``, as many as fit before that value of ``time.perf_counter``."""
        if deadline is not None:
            return self._run_until(deadline)
        settings, n_roots, total = self.settings, len(self.tree.roots), self.settings.num_simulations
        most = min(settings.batch_size, total) if self.rules.rollouts else total  # no larger batches of random returns
        self._run(empty_batch(n_roots, settings.batch_size, most, settings.horizon), 0, total)
        return self._result()

    def _run_until(self, deadline: float) -> Expanded:
        """Runs a batch, then more while one more batch and the final value iteration should end before the deadline."""
        size, done, now = self.settings.batch_size, 0, time.perf_counter()
        batch = empty_batch(len(self.tree.roots), size, size, self.settings.horizon)
        last = 0.0
        while done == 0 or (now + last + self.planner.settling * len(self.graph) < deadline and len(self.graph) < MAX_SEARCHED):
            began = now
            self._run(batch, done, done + size)
            done, now = done + size, time.perf_counter()
            last = now - began
        found = self._result()
        self.planner.settling = (time.perf_counter() - now) / len(self.graph)
        return found

    def _result(self) -> Expanded:
        graph, roots, t = self.graph, self.tree.roots, self.tree
        n, m, visits = len(graph), graph.n_edges, t.root_visits
        solution = replace(t.values, v=t.values.v[:n], q=t.values.q[:n], rewards=t.values.rewards[:m])
        if self.settings.backup == "mean":
            return Expanded(graph, roots, solution, visits, visits + 1e-6 * _scaled(solution.q[roots]), t.visits[:n])
        settle(graph, solution, self.settings.gamma, FINAL_SWEEPS)
        return Expanded(graph, roots, solution, visits, break_ties(graph, solution.q, roots, self.settings.gamma))

    def _run(self, batch: Batch, done: int, total: int) -> None:
        """Runs simulations until ``total`` are done; for each batch that reaches new states, one call of model and goal."""
        graph, rules = self.graph, self.rules
        while done < total:
            done, size, n_reached, n_widened = advance(graph.arrays, self.tree, rules, batch, done, total)
            if size == 0:
                return
            nodes = np.unique(np.concatenate([batch.reached[:n_reached], batch.widened[:n_widened]]))
            n_nodes, n_edges = len(graph), graph.n_edges
            n_samples = self.settings.n_samples if rules.rollouts else LEAF_SAMPLES
            graph.expand(nodes, n_samples, int(_key(self.settings.seed, done + 1)))
            self._make_room()
            self.tree.values.rewards[n_edges : graph.n_edges] = score_edges(graph, self.planner._known_goal(), n_edges)
            if rules.rollouts:
                self._roll_out(batch, done, size)
            take_in(graph.arrays, self.tree, rules, batch, n_nodes, nodes, n_widened)
            backup(graph.arrays, self.tree, rules, batch, size)
            done += size

    def _make_room(self) -> None:
        """Enlarges the statistics to the size of the graph, with spare capacity."""
        tree, values, n, m = self.tree, self.tree.values, len(self.graph), self.graph.n_edges
        if len(values.v) >= n and len(values.rewards) >= m:
            return
        v, q, visits, counted = (_longer(table, 2 * n) for table in (values.v, values.q, tree.visits, tree.counted))
        values = replace(values, v=v, q=q, rewards=_longer(values.rewards, 2 * m))
        self.tree = replace(tree, values=values, visits=visits, counted=counted)

    def _roll_out(self, batch: Batch, done: int, size: int) -> None:
        """Evaluates the node at which each of the ``size`` simulations from each root ended by random play."""
        settings, ends = self.settings, batch.ends[:, :size]
        values, alive = np.zeros(ends.shape), ends >= 0
        simulation = np.broadcast_to(done + np.arange(size), ends.shape)[alive]
        keys = derive(settings.seed, _SEARCH_SALT, simulation)
        states = self.graph.states[ends[alive]]
        model, goal = self.planner._known_model(), self.planner._known_goal()
        values[alive] = random_returns(model, goal, states, keys, settings.horizon, settings.gamma)
        batch.end_values[:, :size] = values


def _first_tree(solution: Values, roots: Ints) -> SearchTree:
    """Statistics before the first simulation."""
    spread, n_visits = solution.v[roots], np.zeros_like(solution.q)
    root_visits, extremes = np.zeros((len(roots), solution.q.shape[1])), np.stack([spread, spread], axis=1)
    return SearchTree(roots, solution, n_visits, n_visits.copy(), root_visits, np.ones(len(roots)), extremes)


@lru_cache(maxsize=4096)
def _key(seed: int, number: int) -> np.uint64:
    """Key of random numbers: search (``number`` 0), or expansions of the batch after ``number - 1`` simulations."""
    key: np.uint64 = (derive(seed, _SEARCH_SALT) if number == 0 else derive(seed, _SEARCH_SALT, number))[0]
    return key


def _longer(table: NDArray[np.float64], size: int) -> Floats:
    longer = np.empty((max(size, len(table)), *table.shape[1:]))
    longer[: len(table)] = table
    return longer


def _scaled(values: Floats) -> Floats:
    """Values [R, A], each row scaled to 0 ... 1, for breaking ties."""
    low, high = values.min(axis=1, keepdims=True), values.max(axis=1, keepdims=True)
    scaled: Floats = (values - low) / np.maximum(high - low, 1e-12)
    return scaled
