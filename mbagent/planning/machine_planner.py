"""Planning by dynamic programming on the imagined finite-state machine (paper section 2)."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mbagent.models.base import Actions, Floats, States, TransitionModel
from mbagent.models.state_graph import Indices, StateGraph
from mbagent.planning.fitted_values import Task, learn_values
from mbagent.planning.foresight import Foresight, best_behaviour
from mbagent.planning.goal import Goal
from mbagent.planning.leaf_values import LOWEST_KNOWN
from mbagent.planning.lookahead import grow_lookahead
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.rehearsal import Way, best_way
from mbagent.planning.value_iteration import Machine, Values, break_ties, doubt, solve, undecided

REHEARSED: dict[str, Any] = {"time_budget": None, "reuse_tree": False}
"""Settings while ways to look ahead are compared: the outcome must hang on neither the clock nor the order."""

ROOTS_AT_ONCE = 16
"""Roots that are imagined around together; bounds the memory."""


class Imagined(NamedTuple):
    """What was imagined around R roots, and what follows from it.

    Attributes:
        graph: root r lies in group r.
        nodes: int64 [R], the roots.
        solution: values of the graph.
        visits: [R, A], simulations through the roots' actions.
        scores: [R, A], what the choice goes by.
        tried: [N, A], simulations through all nodes' actions where behaviour goes by them; None where by values.
    """

    graph: StateGraph
    nodes: Indices
    solution: Values
    visits: Floats
    scores: Floats
    tried: Floats | None = None


class MachinePlanner:
    """Acts greedily on the values of the reachable machine.

    Where the machine reachable from the start states has at most ``max_states`` states it is generated once for the
    model and solved once for each goal. A root outside of it gets a lookahead machine of its own.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Takes the settings; a model and a goal must follow."""
        self.settings = settings
        self._model: TransitionModel | None = None
        self._goal: Goal | None = None
        self._start: States | None = None
        self._machine: Machine | None = None
        self._imagined: StateGraph | None = None
        self._way: Way | None = None
        self._told = False

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner. The machine is generated at the next ``plan``."""
        self._model, self._start, self._machine, self._imagined, self._way = model, start_states, None, None, None

    def set_goal(self, goal: Goal) -> None:
        """See Planner. The machine stays, its values go."""
        if self._machine is not None:
            self._machine.values = None  # before the goal changes: an interrupt must not leave values of another one
        self._goal, self._way, self._told = goal, None, False

    def look_ahead_as(self, other: MachinePlanner) -> None:
        """Takes over how another planner of the same model and goal looks ahead, if that has found out."""
        self._way = other._way

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        machine = self._solved_machine()
        nodes = machine.find(roots)
        n_actions = self._known_model().n_actions
        values, visits = np.zeros((len(roots), n_actions)), np.zeros((len(roots), n_actions))
        scores, known = np.zeros((len(roots), n_actions)), np.flatnonzero(nodes >= 0)
        if len(known) and machine.graph is not None and machine.values is not None:
            values[known] = machine.values.q[nodes[known]]
            scores[known] = break_ties(machine.graph, machine.values.q, nodes[known], self.settings.gamma)
            self._tell_doubt(machine.bounds, nodes[known], scores[known], values[known])
        unknown = np.flatnonzero(nodes < 0)
        for begin in range(0, len(unknown), ROOTS_AT_ONCE):
            some = unknown[begin : begin + ROOTS_AT_ONCE]
            found = self._imagine(roots[some])
            values[some], visits[some], scores[some] = found.solution.q[found.nodes], found.visits, found.scores
            if not self._told:
                bounds = doubt(found.graph, found.solution, self.settings.gamma)
                self._tell_doubt(bounds, found.nodes, scores[some], values[some])
        return Plan(best_actions(scores), values, visits)

    def _tell_doubt(self, bounds: Floats | None, nodes: Indices, scores: Floats, values: Floats) -> None:
        """Warns, once for each goal, where rare outcomes that have no part in a plan could change it."""
        if self._told or bounds is None or not undecided(scores, values, bounds[nodes]).any():
            return
        self._told, settings = True, self.settings
        warnings.warn(
            f"More outcomes are rare than plans have room for, so that others stand for some of them; values may be off by up to "
            f"{bounds[nodes].max():.3g}, which could change the choice of an action: raise n_samples (now {settings.n_samples}) "
            f"and lookahead_samples (now {settings.lookahead_samples}) in policy_kwargs.",
            stacklevel=2,
        )

    def foresee(self, root: States) -> Foresight:
        """What the plan from one root [1, F] rests on; see Foresight."""
        machine = self._solved_machine()
        nodes = machine.find(root)
        if nodes[0] < 0 or machine.graph is None or machine.values is None:
            return self._foresight(self._imagine(root), 0)
        graph, solution = machine.graph, machine.values
        scores = break_ties(graph, solution.q, nodes, self.settings.gamma)
        nothing = np.zeros((1, graph.model.n_actions))
        return self._foresight(Imagined(graph, nodes, solution, nothing, scores), int(graph.expanded.sum()))

    def _foresight(self, found: Imagined, machine_states: int) -> Foresight:
        plan = Plan(best_actions(found.scores), found.solution.q[found.nodes], found.visits)
        behaviour = best_behaviour(found.graph, found.solution.q, self.settings.gamma, found.tried)
        solution = found.solution
        return Foresight(plan, found.graph, int(found.nodes[0]), solution.rewards, behaviour, solution.v, machine_states)

    def _imagine(self, roots: States) -> Imagined:
        """Imagines around each root [R, F]; here a lookahead machine, solved, without a search."""
        graph, solution, nodes = self._lookahead(roots)
        scores = break_ties(graph, solution.q, nodes, self.settings.gamma)
        return Imagined(graph, nodes, solution, np.zeros_like(scores), scores)

    def _empty_graph(self) -> StateGraph:
        """A graph for the next roots; what the last one held is gone."""
        if self._imagined is None:
            self._imagined = StateGraph(self._known_model())
        self._imagined.clear()
        return self._imagined

    def _lookahead(self, roots: States) -> tuple[StateGraph, Values, Indices]:
        """A machine around each root [R, F], solved; root r is in group r. Returns (graph, values, root nodes)."""
        way, graph, settings = self._chosen_way(), self._empty_graph(), self.settings
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        grow_lookahead(graph, nodes, way.states, way.samples, settings.horizon, settings.seed)
        return graph, solve(graph, self._known_goal(), settings.gamma, len(roots), way.leaf), nodes

    def _chosen_way(self) -> Way:
        """How to look ahead under this goal: as the settings say, with learned values at the edge or instead, if any."""
        if self._way is None:
            settings, start = self.settings, self._start
            usual = Way(LOWEST_KNOWN, settings.lookahead_states, settings.lookahead_samples)
            if settings.learn_values and start is not None and len(start):
                usual = self._rehearse(usual, Task(self._known_model(), self._known_goal(), start, settings.gamma, settings.seed))
            self._way = usual
        return self._way

    def _rehearse(self, usual: Way, task: Task) -> Way:
        """Learns values for the goal, and finds out whether plans are best with them at the edge, without or only with them."""
        settings = self.settings
        leaf, met = learn_values(task)
        if len(leaf.common) == 0:
            return usual

        def act(way: Way, states: States) -> Actions:
            self._way = way
            return best_actions(self._imagine(states).scores)

        try:
            self.settings = replace(settings, **REHEARSED)
            ways = (usual._replace(leaf=leaf), usual, Way(leaf, 1, settings.n_samples))
            return best_way(replace(task, start=met), ways, act)
        finally:  # should the goal fail now, it is tried again
            self.settings, self._way = settings, None

    def _solved_machine(self) -> Machine:
        if self._machine is None:
            assert self._start is not None or self._model is None
            model, start, settings = self._known_model(), self._start, self.settings
            if start is None:
                raise RuntimeError("The planner has no start states; call set_model first.")
            self._machine = Machine(model, start, settings.max_states, settings.n_samples, settings.seed)
        if self._machine.values is None:
            self._machine.set_goal(self._known_goal(), self.settings.gamma)
        return self._machine

    def _known_model(self) -> TransitionModel:
        if self._model is None:
            raise RuntimeError("The planner has no model yet; call set_model first.")
        return self._model

    def _known_goal(self) -> Goal:
        if self._goal is None:
            raise RuntimeError("The planner has no goal yet; call set_goal first.")
        return self._goal
