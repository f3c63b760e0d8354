"""What the agent's arguments must be; every check names mistake and fix in one sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mbagent.exploration import EXPLORATIONS, Exploration
from mbagent.models.base import TransitionModel
from mbagent.planning.planner import PlannerSettings
from mbagent.spaces import FactoredSpace

MAX_SEED = 2**32 - 1


def fitting_model(model: TransitionModel, space: FactoredSpace, n_actions: int) -> TransitionModel:
    """A model that was given, if it is one of this environment.

    Raises:
        ValueError: it has other factors or actions.
    """
    if tuple(model.cardinalities) != space.cardinalities or model.n_actions != n_actions:
        raise ValueError(
            f"The model has {len(model.cardinalities)} factors and {model.n_actions} actions, but the environment "
            f"{len(space)} and {n_actions}; build the model for this environment's spaces."
        )
    return model


def planner_settings(own: Mapping[str, Any], policy_kwargs: Mapping[str, Any], seed: int) -> PlannerSettings:
    """The agent's own settings of the planner and those of ``policy_kwargs``.

    Raises:
        TypeError: there is no setting of that name.
        ValueError: one is out of range.
    """
    known = sorted(set(PlannerSettings.__dataclass_fields__) - {*own, "seed"})
    unknown = sorted(set(policy_kwargs) - set(known))
    if unknown:
        raise TypeError(f"policy_kwargs has no {unknown[0]!r}; it takes {', '.join(known)}.")
    return PlannerSettings(**own, seed=seed, **policy_kwargs)


def check_seed(seed: Any) -> int | None:
    """The seed as an int, or None."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be a whole number from 0 to {MAX_SEED:,} or None, got {seed!r}.")
    return int(seed)


def check_timesteps(total: Any) -> int:
    """``total_timesteps`` as an int; 1e5 is one, 2.5 is not. 0 fits what is known without a step."""
    number = not isinstance(total, bool) and isinstance(total, int | float | np.number)
    if not number or not math.isfinite(total) or total < 0 or total != int(total):
        raise ValueError(f"total_timesteps must be a whole number of environment steps, 0 or more, got {total!r}.")
    return int(total)


def check_log_interval(interval: Any) -> int | None:
    """``log_interval`` as an int of at least 1, or None."""
    if interval is None:
        return None
    if isinstance(interval, bool) or not isinstance(interval, int | np.integer) or interval < 1:
        raise ValueError(f"log_interval must be a whole number of at least 1, or None for no log, got {interval!r}.")
    return int(interval)


def check_learning_rate(rate: Any) -> float:
    """The learning rate as a float."""
    if isinstance(rate, bool) or not isinstance(rate, int | float | np.number) or not math.isfinite(rate) or rate <= 0:
        raise ValueError(f"learning_rate must be a finite number above 0 (the default is 0.02), got {rate!r}.")
    return float(rate)


def check_model(model: Any) -> str | TransitionModel:
    """The ``model`` argument: a name or an object that does what a TransitionModel does."""
    if isinstance(model, str | TransitionModel):
        return model
    raise TypeError(f"model must be 'auto', another registered name, or a TransitionModel, got {model!r}.")


def check_exploration(exploration: Any) -> str | Exploration:
    """The ``exploration`` argument: a known name or an object with ``act``."""
    if isinstance(exploration, str) and exploration not in EXPLORATIONS:
        raise ValueError(f"exploration must be one of {sorted(EXPLORATIONS)}, got {exploration!r}.")
    if not isinstance(exploration, str) and not callable(getattr(exploration, "act", None)):
        raise TypeError(f"exploration must be a name or an object with act(states, rng), got {exploration!r}.")
    checked: str | Exploration = exploration
    return checked
