"""Planning by dynamic programming on the imagined finite-state machine (paper section 2)."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import States, TransitionModel
from mbagent.models.state_graph import StateGraph
from mbagent.planning.goal import Goal
from mbagent.planning.lookahead import grow_lookahead
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.value_iteration import Machine, Values, break_ties, solve


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

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner. The machine is generated at the next ``plan``."""
        self._model, self._start, self._machine = model, start_states, None

    def set_goal(self, goal: Goal) -> None:
        """See Planner. The machine stays, its values go."""
        self._goal = goal
        if self._machine is not None:
            self._machine.values = None

    def plan(self, roots: States) -> Plan:
        """See Planner."""
        machine = self._solved_machine()
        nodes = machine.find(roots)
        known = nodes >= 0
        n_actions = self._known_model().n_actions
        values, visits = np.zeros((len(roots), n_actions)), np.zeros((len(roots), n_actions))
        scores = np.zeros((len(roots), n_actions))
        if known.any() and machine.graph is not None and machine.values is not None:
            found = self._search(machine.graph, machine.values, nodes[known], shared=True)
            values[known], visits[known], scores[known] = found
        if not known.all():
            graph, solution, local = self._lookahead(roots[~known])
            found = self._search(graph, solution, local, shared=False)
            values[~known], visits[~known], scores[~known] = found
        return Plan(best_actions(scores), values, visits)

    def _search(
        self, graph: StateGraph, solution: Values, nodes: np.ndarray, shared: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(values, visits, scores) [R, A] of the root nodes [R]; here the values as they are, without a search."""
        del shared
        values = solution.q[nodes]
        return values, np.zeros_like(values), break_ties(graph, solution.q, nodes, self.settings.gamma)

    def _lookahead(self, roots: States) -> tuple[StateGraph, Values, np.ndarray]:
        """A machine around each root [R, F], solved; root r is in group r. Returns (graph, values, root nodes)."""
        graph, settings = StateGraph(self._known_model()), self.settings
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        grow_lookahead(
            graph,
            nodes,
            settings.lookahead_states,
            settings.lookahead_samples,
            settings.horizon,
            settings.seed,
        )
        return graph, solve(graph, self._known_goal(), settings.gamma, n_groups=len(roots)), nodes

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
