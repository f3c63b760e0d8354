"""Flat Monte Carlo, the paper's basic search (section 4.1): each action is evaluated by random play after the action."""

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

_SEQUENCE = 1 << 32
"""Salt of the random numbers of action sequences: larger than any depth, so that no step uses the same numbers."""


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
        model: transition model.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], keys of the random numbers.
        horizon: number of steps.
        gamma: discount of a step.
        first_actions: int64 [B]; None: the first action is random, too.

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
    """Discounted return of one action sequence per state, random after the first action; direct forecasts (paper 4.2).

    The state before step k (from 0) is sampled from the k-step model, given the first k actions; the step itself is sampled from
    the one-step model. So errors do not accumulate over steps. The samples of different steps do not form one trajectory; this
    does not change the mean of the returns, but it changes their maximum.

    Args:
        model: a one-step model and models of several steps.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], keys of the random numbers for action sequences and samples.
        horizon: number of steps.
        gamma: discount of a step.
        first_actions: int64 [B].

    Returns:
        float64 [B].
    """
    total = np.zeros(len(states))
    sequences = (uniforms(derive(keys, _SEQUENCE), horizon) * model.n_actions).astype(np.int64)
    sequences[:, 0] = first_actions
    for depth in range(horizon):
        step_keys = derive(keys, depth)
        reached, ended = model.forecast(states, sequences[:, :depth], derive(step_keys, 1))
        alive = np.flatnonzero(~ended)
        before, actions = reached[alive], sequences[alive, depth]
        next_states, _ = model.sample(before, actions, step_keys[alive])
        total[alive] += gamma**depth * goal(before, actions, next_states)
    return total


class FlatMonteCarlo:
    """Simulates random play after every action and chooses the action with the best returns.

    "Several simulations are rolled out up to a bounded number of steps using the transition sampling method. At the end
    of each simulation the reward is counted, and the action which produced the greatest reward is selected."
    By default the value of an action is the mean return of its simulations; ``choice="greatest"`` takes the greatest return, as
    the paper says; this is risk-seeking in stochastic environments. Each action has few simulations, and outcomes that they do
    not sample do not affect its value. So rare but decisive outcomes are missed; the other planners list such outcomes.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Stores the settings; set a model and a goal before planning."""
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
        """See Planner. Every action gets the same number of simulations.

        With a time budget, rounds of ``batch_size`` simulations run until the next one would exceed it.
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
        """Discounted returns of one round, [R, A, simulations per action]; ``done``: earlier simulations of each action."""
        model, goal, settings = self._model, self._goal, self.settings
        assert model is not None
        assert goal is not None  # ``plan`` has checked both
        n_actions = model.n_actions
        each = max(1, (settings.num_simulations if settings.time_budget is None else settings.batch_size) // n_actions)
        rows = np.repeat(np.arange(len(roots)), n_actions * each)
        actions = np.tile(np.repeat(np.arange(n_actions), each), len(roots))
        # Common random numbers: simulation k uses the same ones for every action.
        noise = derive(settings.seed, np.arange(done, done + each))
        keys = np.tile(noise, len(roots) * n_actions)
        arguments = (goal, roots[rows], keys, settings.horizon, settings.gamma, actions)
        if settings.forecasts == "direct":
            returns = forecast_returns(direct_model(model), *arguments)
        else:
            returns = random_returns(model, *arguments)
        return returns.reshape(len(roots), n_actions, each)

    def trace(self, root: States) -> PlanTrace:
        """Trace of the plan from one root [1, F]; its trajectories have only one step, since play is random after that."""
        plan, model, goal = self.plan(root), self._model, self._goal
        assert model is not None
        assert goal is not None  # ``plan`` has checked both
        graph = StateGraph(model)
        node = graph.add(root, np.zeros(1, dtype=np.int64))
        graph.expand(node, self.settings.n_samples, self.settings.seed)
        return PlanTrace(plan, graph, int(node[0]), score_edges(graph, goal), np.full(len(graph), -1, dtype=np.int64))


def direct_model(model: TransitionModel) -> DirectForecastModel:
    """Returns the model if it can forecast several steps directly.

    Raises:
        ValueError: it cannot.
    """
    if not isinstance(model, DirectForecastModel):
        raise ValueError(
            f"forecasts='direct' needs a model with direct forecasts of several steps, not a {type(model).__name__}; "
            "give the agent model='direct'."
        )
    return model
