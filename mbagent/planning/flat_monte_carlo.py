"""Flat Monte Carlo, the paper's basic search (section 4.1): random simulated play after every action."""

from __future__ import annotations

import time

import numpy as np

from mbagent.models.mdp import StateGraph
from mbagent.models.neural.forecasts import DirectForecastModel
from mbagent.models.protocol import TransitionModel
from mbagent.planning.planner import Plan, PlannerSettings, best_actions
from mbagent.planning.trajectories import PlanTrace
from mbagent.planning.value_iteration import score_edges
from mbagent.types import Actions, Floats, Keys, Reward, States
from mbagent_envs.random_keys import derive, uniforms

_STRING = 1 << 32
"""Salt of a string's random numbers: no depth is as large, so no step's numbers are used twice."""


def random_returns(
    model: TransitionModel,
    goal: Reward,
    states: States,
    keys: Keys,
    horizon: int,
    gamma: float,
    first_actions: Actions | None = None,
) -> Floats:
    """Discounted return of one random rollout from each state.

    Args:
        model: where next states come from.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], the rollout's randomness.
        horizon: steps.
        gamma: discount of a step.
        first_actions: int64 [B], else the first action is random too.

    Returns:
        float64 [B].
    """
    total, alive = np.zeros(len(states)), np.arange(len(states))
    for depth in range(horizon):
        if len(alive) == 0:
            break
        step_keys = derive(keys[alive], depth)
        if depth == 0 and first_actions is not None:
            actions = first_actions
        else:
            actions = (uniforms(derive(step_keys, 1), 1)[:, 0] * model.n_actions).astype(np.int64)
        next_states, terminated = model.sample(states, actions, step_keys)
        total[alive] += gamma**depth * goal(states, actions, next_states)
        states, alive = next_states[~terminated], alive[~terminated]
    return total


def forecast_returns(
    model: DirectForecastModel, goal: Reward, states: States, keys: Keys, horizon: int, gamma: float, first_actions: Actions
) -> Floats:
    """Discounted return of one random string of actions from each state, every step forecast from the start (paper 4.2).

    Step k's transition begins in a draw of where the first k actions lead, made by the model of k steps, and is itself a
    draw of the one-step model. Errors do not accumulate over steps. The draws of different steps are not of one and the
    same future, which a mean of returns does not feel, but their maximum would.

    Args:
        model: the models of one and of several steps.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], the string's and the draws' randomness.
        horizon: steps.
        gamma: discount of a step.
        first_actions: int64 [B].

    Returns:
        float64 [B].
    """
    total = np.zeros(len(states))
    strings = (uniforms(derive(keys, _STRING), horizon) * model.n_actions).astype(np.int64)
    strings[:, 0] = first_actions
    for depth in range(horizon):
        step_keys = derive(keys, depth)
        reached, over = model.forecast(states, strings[:, :depth], derive(step_keys, 1))
        alive = np.flatnonzero(~over)
        here, actions = reached[alive], strings[alive, depth]
        next_states, _ = model.sample(here, actions, step_keys[alive])
        total[alive] += gamma**depth * goal(here, actions, next_states)
    return total


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
        self._goal: Reward | None = None

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """See Planner."""
        self._model = model

    def set_goal(self, goal: Reward) -> None:
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
        noise = derive(settings.seed, np.arange(done, done + each))
        keys = np.tile(noise, len(roots) * n_actions)
        given = (goal, roots[rows], keys, settings.horizon, settings.gamma, actions)
        if settings.forecasts == "direct":
            returns = forecast_returns(direct_model(model), *given)
        else:
            returns = random_returns(model, *given)
        return returns.reshape(len(roots), n_actions, each)

    def trace(self, root: States) -> PlanTrace:
        """What the plan from one root [1, F] rests on; as there is no behaviour but random play, futures are one step long."""
        plan, model, goal = self.plan(root), self._model, self._goal
        assert model is not None
        assert goal is not None  # ``plan`` has seen to both
        graph = StateGraph(model)
        node = graph.add(root, np.zeros(1, dtype=np.int64))
        graph.expand(node, self.settings.n_samples, self.settings.seed)
        return PlanTrace(plan, graph, int(node[0]), score_edges(graph, goal), np.full(len(graph), -1, dtype=np.int64))


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
