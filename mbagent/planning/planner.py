"""The planner protocol, and the settings that planners share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from mbagent.models.protocol import TransitionModel
from mbagent.types import Actions, Floats, Reward, States


@dataclass(frozen=True)
class PlannerSettings:
    """Settings of planners.

    Attributes:
        num_simulations: simulations for each decision; ignored with a time budget.
        time_budget: seconds for each decision, in place of ``num_simulations`` (multiplied by the number of observations in a
            batch), or None. At least one batch of simulations runs; further batches follow until the next one would exceed the
            time or the graph has MAX_SEARCHED states. The first decision for a new goal takes longer if it generates and solves
            the reachable MDP; decisions in a solved MDP need no search. With a time budget, results depend on the speed of the
            computer.
        gamma: discount of a step, above 0 and below 1, so that values are finite even if episodes never end.
        horizon: maximum number of steps that a simulation looks ahead.
        max_states: if at most this many states are reachable, the reachable MDP is solved once for all decisions.
        lookahead_states: states expanded around each root if more than ``max_states`` are reachable.
        n_samples: samples for a (state, action) with too many successors to enumerate, in the reachable MDP.
        lookahead_samples: the same in a lookahead, near its root.
        learn_values: whether leaf values are learned in simulations, once for each goal, if the reachable MDP is too large. They
            are the values of the lookahead's unexpanded states. Two alternatives replace this if they do clearly better in
            simulations: no learned values, or a lookahead that expands only the root, with ``n_samples`` samples, and uses
            learned values after that step.
        leaf_values: "lookahead" (values of the reachable MDP, or of a lookahead around the root) or "rollouts" (random play).
        backup: "max" (the value of an action assumes that the best policy follows) or "mean" (plain UCT).
        choice: value of an action in flat Monte Carlo: "mean" return, or "greatest" (as in the paper; risk-seeking).
        forecasts: "iterated" (simulations go step by step) or "direct" (flat Monte Carlo only: the state before each step is
            forecast from the root by a separate model, paper 4.2; needs ``model="direct"`` or another DirectForecastModel).
        c_uct: weight of exploration in the search, in units of the range of values.
        batch_size: simulations between two calls of the model; later, without rollouts, a quarter of those done if that is more
            (at most 256).
        prior_visits: number of visits that an initial value counts for in the search.
        reuse_tree: whether a decision continues the search of the previous decision (MctsPolicy, one observation at a time). The
            kept search is dropped at episode starts (see ``predict(..., episode_start=...)``), with a new goal or new weights,
            if it has more than MAX_KEPT states, or if too few of its states are reachable from the new observation. With reuse,
            results depend on earlier decisions. The benefit is small: in two learned games, returns were unchanged (30
            episodes); decisions took 32% and 18% less time with 64 simulations, but 20% and 7% more with 256, since reused
            graphs are larger.
        seed: of the random numbers.

    Raises:
        ValueError: a setting is out of range.
    """

    num_simulations: int = 64
    time_budget: float | None = None
    gamma: float = 0.99
    horizon: int = 20
    max_states: int = 3000
    lookahead_states: int = 160
    n_samples: int = 16
    lookahead_samples: int = 4
    learn_values: bool = True
    leaf_values: Literal["lookahead", "rollouts"] = "lookahead"
    backup: Literal["max", "mean"] = "max"
    choice: Literal["mean", "greatest"] = "mean"
    forecasts: Literal["iterated", "direct"] = "iterated"
    c_uct: float = 0.5
    batch_size: int = 16
    prior_visits: float = 8.0
    reuse_tree: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in (
            "num_simulations",
            "horizon",
            "max_states",
            "lookahead_states",
            "n_samples",
            "lookahead_samples",
            "batch_size",
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}.")
            object.__setattr__(self, name, int(value))
        for name in ("gamma", "c_uct", "prior_visits"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number that is not negative, got {value!r}.")
            object.__setattr__(self, name, float(value))
        if not 0.0 < self.gamma < 1.0:
            raise ValueError(
                f"gamma must lie between 0 and 1, both excluded, got {self.gamma!r}: values of endless episodes need a "
                "discount below 1; 0.99 is the default."
            )
        self._check_choices()

    def _check_choices(self) -> None:
        budget = self.time_budget
        if budget is not None:
            number = not isinstance(budget, bool) and isinstance(budget, int | float | np.number)
            if not number or not 0.0 < budget < math.inf:
                raise ValueError(f"time_budget must be a finite number of seconds above 0, or None, got {budget!r}.")
            object.__setattr__(self, "time_budget", float(budget))
        for name in ("reuse_tree", "learn_values"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}.")
        choices = {
            "leaf_values": ("lookahead", "rollouts"),
            "backup": ("max", "mean"),
            "choice": ("mean", "greatest"),
            "forecasts": ("iterated", "direct"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}.")
        if self.leaf_values == "rollouts" and self.backup == "max":
            raise ValueError("leaf_values='rollouts' needs backup='mean': the maximum of random returns is risk-seeking.")


@dataclass(frozen=True)
class Plan:
    """Result of planning for each root.

    Attributes:
        actions: int64 [B], the chosen action.
        values: float64 [B, A], estimated discounted return of each action.
        visits: float64 [B, A], number of simulations that start with each action.
    """

    actions: Actions
    values: Floats
    visits: Floats


class Planner(Protocol):
    """Chooses actions by simulations with a model.

    The plan is a pure function of (settings, model, goal, root) except with ``reuse_tree``, where it also depends on the decision
    before, and with ``time_budget``, where it also depends on the machine's speed.

    Planners that can also return a plan's state graph implement ``trajectories.TracingPlanner``.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Stores the settings; set a model and a goal before planning."""
        ...

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """Sets a (newly fitted) model and the observed start states int64 [S, F]; drops all caches."""
        ...

    def set_goal(self, goal: Reward) -> None:
        """Sets a new goal; drops the values of the old goal, but may keep state graphs."""
        ...

    def plan(self, roots: States) -> Plan:
        """Plans from each of the roots, int64 [B, F]."""
        ...


def best_actions(scores: Floats) -> Actions:
    """First action [B] with the greatest score in each row of ``scores`` [B, A], up to rounding errors."""
    top = scores.max(axis=1, keepdims=True)
    slack = 1e-9 * abs(scores).max(axis=1, keepdims=True)
    result: Actions = (scores >= top - slack).argmax(axis=1)
    return result
