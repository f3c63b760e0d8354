"""Flat Monte Carlo: the paper's basic search (section 4.1)."""

from __future__ import annotations

import time

import numpy as np

from mbagent.models.base import Floats, States, TransitionModel
from mbagent.models.forecasts import DirectForecastModel
from mbagent.models.state_graph import StateGraph
from mbagent.planning.foresight import Foresight
from mbagent.planning.goal import Goal
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.rollouts import forecast_returns, random_returns
from mbagent.planning.value_iteration import score_edges
from mbagent_envs.random_keys import derive


class FlatMonteCarlo:
    """Simulates random play after every action and takes the action whose simulations did best.

    "Several simulations are rolled out up to a bounded number of steps using the transition sampling method. At the end
    of each simulation the reward is counted, and the action which produced the greatest reward is selected."
    By default an action is judged by the mean of its simulations; ``choice="greatest"`` is the paper's wording, which
    seeks risk wherever the world is stochastic. What the few simulations of an action do not happen to draw has no part in its
    value, so outcomes that are rare and decide are missed here; the other planners list them.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Takes the settings; a model and a goal must follow."""
        self.settings = settings
        self._model: TransitionModel | None = None
        self._goal: Goal | None = None

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner."""
        self._model = model

    def set_goal(self, goal: Goal) -> None:
        """See Planner."""
        self._goal = goal

    def plan(self, roots: States) -> Plan:
        """See Planner. The simulations are shared out evenly over the actions.

        With a time budget there are rounds of ``wave`` simulations until the next would not be done in time.
        """
        if self._model is None or self._goal is None:
            raise RuntimeError("The planner has no model or no goal yet; call set_model and set_goal first.")
        budget, began = self.settings.time_budget, time.perf_counter()
        returns = self._returns(roots, 0)
        total, greatest, each = returns.sum(axis=2), returns.max(axis=2), returns.shape[2]
        done = each
        while budget is not None:
            used = time.perf_counter() - began
            if used + used * each / done > len(roots) * budget:
                break
            returns = self._returns(roots, done)
            total, greatest, done = total + returns.sum(axis=2), np.maximum(greatest, returns.max(axis=2)), done + each
        values = total / done if self.settings.choice == "mean" else greatest
        return Plan(best_actions(values), values, np.full(values.shape, float(done)))

    def _returns(self, roots: States, done: int) -> Floats:
        """Discounted returns [R, A, simulations for an action] of one round, after ``done`` others of each action."""
        model, goal, settings = self._model, self._goal, self.settings
        assert model is not None
        assert goal is not None  # ``plan`` has seen to both
        n_actions = model.n_actions
        each = max(1, (settings.num_simulations if settings.time_budget is None else settings.wave) // n_actions)
        rows = np.repeat(np.arange(len(roots)), n_actions * each)
        actions = np.tile(np.repeat(np.arange(n_actions), each), len(roots))
        # Simulation k meets the same luck under every action.
        luck = derive(settings.seed, np.arange(done, done + each))
        keys = np.tile(luck, len(roots) * n_actions)
        given = (goal, roots[rows], keys, settings.horizon, settings.gamma, actions)
        if settings.forecasts == "direct":
            returns = forecast_returns(direct_model(model), *given)
        else:
            returns = random_returns(model, *given)
        return returns.reshape(len(roots), n_actions, each)

    def foresee(self, root: States) -> Foresight:
        """What the plan from one root [1, F] rests on; as there is no behaviour but random play, futures are one step long."""
        plan, model, goal = self.plan(root), self._model, self._goal
        assert model is not None
        assert goal is not None  # ``plan`` has seen to both
        graph = StateGraph(model)
        node = graph.add(root, np.zeros(1, dtype=np.int64))
        graph.expand(node, self.settings.n_samples, self.settings.seed)
        return Foresight(plan, graph, int(node[0]), score_edges(graph, goal), np.full(len(graph), -1, dtype=np.int64))


def direct_model(model: TransitionModel) -> DirectForecastModel:
    """The model, if it forecasts several steps directly.

    Raises:
        ValueError: it does not.
    """
    if not isinstance(model, DirectForecastModel):
        raise ValueError(
            f"forecasts='direct' needs a model with forecasts of several steps, not a {type(model).__name__}; "
            "give the agent model='direct'."
        )
    return model
