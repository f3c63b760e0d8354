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
    """How planners spend their effort.

    Attributes:
        num_simulations: simulations for each decision; ignored with a time budget.
        time_budget: seconds for each decision instead (of a batch: times the number of observations), or None. Simulations go
            on in waves, one at least, until the next would not be done in time, or MAX_SEARCHED states are imagined. The first
            decision under a new goal takes longer where it generates and solves the reachable machine; where that is solved, no
            time is needed. Outcomes then depend on the speed of the machine.
        gamma: discount of a step, above 0 and below 1: the values of an endless world need an end.
        horizon: steps a simulation looks ahead, at most.
        max_states: reachable states up to which the whole machine is solved once, for all decisions.
        lookahead_states: states imagined around each root where the whole machine is larger than that.
        n_samples: draws for a (state, action) whose successors are too many to enumerate, in the whole machine.
        lookahead_samples: the same near a root, where the whole machine is too large.
        learn_values: whether, where the whole machine is too large, values are learned in imagination, once for each goal. They
            stand for what lies beyond the lookahead machine; where it plays better in imagination, searches do without them, or
            begin with ``n_samples`` draws of a first step and these values, without a lookahead machine.
        leaf_values: "machine" (values of the reachable machine) or "rollouts" (random play).
        backup: "max" (an action is worth what the best behaviour after it is worth) or "mean" (plain UCT).
        choice: "mean", or "greatest" as in the paper (flat Monte Carlo only; it seeks risk).
        forecasts: "iterated" (simulations go step by step) or "direct" (flat Monte Carlo only: each step is forecast from
            the root by a model of its own, paper 4.2; needs ``model="direct"`` or another DirectForecastModel).
        c_uct: weight of the search's exploration, in units of the range of values seen.
        wave: simulations between two calls of the model.
        prior_visits: how many visits a value from the machine counts for in the search.
        reuse_tree: whether a decision begins with what the last one imagined (MctsPolicy, one observation at a time). Dropped at
            episode starts (``predict(..., episode_start=...)`` tells), with a new goal or new weights, where it holds more than
            MAX_KEPT states, or too few of what can follow. Outcomes then depend on the decisions before. It hardly helps: in
            two learned games returns stayed as they were (30 episodes); a decision of 64 simulations took 32% and 18% less time,
            one of 256 took 20% and 7% more, as kept graphs are larger.
        seed: which random numbers.

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
    leaf_values: Literal["machine", "rollouts"] = "machine"
    backup: Literal["max", "mean"] = "max"
    choice: Literal["mean", "greatest"] = "mean"
    forecasts: Literal["iterated", "direct"] = "iterated"
    c_uct: float = 0.5
    wave: int = 16
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
            "wave",
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
                f"gamma must lie between 0 and 1, both excluded, got {self.gamma!r}: the values of worlds without an end need a "
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
            "leaf_values": ("machine", "rollouts"),
            "backup": ("max", "mean"),
            "choice": ("mean", "greatest"),
            "forecasts": ("iterated", "direct"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}.")
        if self.leaf_values == "rollouts" and self.backup == "max":
            raise ValueError("leaf_values='rollouts' needs backup='mean': the maximum of random returns seeks luck.")


@dataclass(frozen=True)
class Plan:
    """What a planner found for each root.

    Attributes:
        actions: int64 [B], the best action.
        values: float64 [B, A], estimated discounted return of each action.
        visits: float64 [B, A], simulations through each action.
    """

    actions: Actions
    values: Floats
    visits: Floats


class Planner(Protocol):
    """Chooses actions by imagining with a model; the outcome is a pure function of (settings, model, goal, root).

    One that can also show what a plan rests on has the method of ``trace.TracingPlanner``.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        """Takes the settings; a model and a goal must follow."""
        ...

    def set_model(self, model: TransitionModel, start_states: States) -> None:
        """Takes a (newly fitted) model and the start states int64 [S, F] seen; every cache is dropped."""
        ...

    def set_goal(self, goal: Reward) -> None:
        """Takes a new goal; values of the old one are dropped, what was imagined of the world may stay."""
        ...

    def plan(self, roots: States) -> Plan:
        """Plans from each root int64 [B, F]."""
        ...


def best_actions(scores: Floats) -> Actions:
    """The first action [B] whose score [B, A] is the greatest but for rounding errors."""
    top = scores.max(axis=1, keepdims=True)
    slack = 1e-9 * abs(scores).max(axis=1, keepdims=True)
    result: Actions = (scores >= top - slack).argmax(axis=1)
    return result
