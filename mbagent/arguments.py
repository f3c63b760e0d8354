"""Checks of the agent's arguments; each error names the mistake and the fix in one sentence."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy

from mbagent.exploration.strategies import EXPLORATIONS, Exploration
from mbagent.models.protocol import TransitionModel
from mbagent.planning.planner import PlannerSettings
from mbagent.policies import PlannerPolicy
from mbagent.spaces import FactoredSpace

MAX_SEED = 2**32 - 1


def fitting_model(model: TransitionModel, space: FactoredSpace, n_actions: int) -> TransitionModel:
    """The given model, if it matches this environment.

    Raises:
        ValueError: the model has different factors or actions.
    """
    if tuple(model.cardinalities) != space.cardinalities or model.n_actions != n_actions:
        raise ValueError(
            f"The model has {len(model.cardinalities)} factors and {model.n_actions} actions, but the environment "
            f"has {len(space)} and {n_actions}; build the model for this environment's spaces."
        )
    return model


def planner_settings(own: Mapping[str, Any], policy_kwargs: Mapping[str, Any], seed: int) -> PlannerSettings:
    """Planner settings from the agent's own arguments and from ``policy_kwargs``.

    Raises:
        TypeError: ``policy_kwargs`` is not a dict, or contains an unknown setting.
        ValueError: a setting is out of range.
    """
    if not isinstance(policy_kwargs, Mapping):
        raise TypeError(f"policy_kwargs must be a dict of planner settings, got {policy_kwargs!r}.")
    policy_kwargs = _present(policy_kwargs)
    known = sorted(set(PlannerSettings.__dataclass_fields__) - {*own, "seed"})
    unknown = sorted(set(policy_kwargs) - set(known))
    if unknown:
        raise TypeError(f"policy_kwargs has no {unknown[0]!r}; it takes {', '.join(known)}.")
    return PlannerSettings(**own, seed=seed, **policy_kwargs)


def _present(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with current names and values; deprecated ones from the previous version work for one more version."""
    given = dict(policy_kwargs)
    if "wave" in given:
        warnings.warn("policy_kwargs: 'wave' is now called 'batch_size'.", DeprecationWarning, stacklevel=4)
        given.setdefault("batch_size", given.pop("wave"))
    if given.get("leaf_values") == "machine":
        warnings.warn("policy_kwargs: leaf_values='machine' is now called 'lookahead'.", DeprecationWarning, stacklevel=4)
        given["leaf_values"] = "lookahead"
    return given


def check_seed(seed: Any) -> int | None:
    """The seed as an int, or None."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be a whole number from 0 to {MAX_SEED:,} or None, got {seed!r}.")
    return int(seed)


def check_timesteps(total: Any) -> int:
    """``total_timesteps`` as an int; 1e5 is accepted, 2.5 is not. 0 means a fit to the recorded transitions only."""
    number = not isinstance(total, bool) and isinstance(total, int | float | np.number)
    if not number or not math.isfinite(total) or total < 0 or total != int(total):
        raise ValueError(f"total_timesteps must be a whole number of environment steps, 0 or more, got {total!r}.")
    return int(total)


def check_count(name: str, count: Any, none: str) -> int | None:
    """An integer argument of at least 1, as an int; or None. ``none`` describes the meaning of None in the error message."""
    if count is None:
        return None
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, or None for {none}, got {count!r}.")
    return int(count)


def check_callback(callback: Any) -> None:
    """Checks the ``callback`` argument: an SB3 callback, a list of these, a function of (locals, globals), or None."""
    for each in callback if isinstance(callback, list) else [callback]:
        if not (isinstance(each, BaseCallback) or (each is callback and (each is None or callable(each)))):
            raise TypeError(
                "callback must be a BaseCallback of SB3, a list of these, a function of (locals, globals) or None, "
                f"got {callback!r}."
            )


def check_device(device: Any) -> torch.device | str:
    """The ``device`` argument; "auto" means "cpu"."""
    try:
        return "cpu" if device == "auto" else torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(
            f"device must be 'auto', 'cpu' or another device that torch supports, such as 'cuda', got {device!r}."
        ) from error


def check_policy(policy: Any, known: Iterable[str]) -> Any:
    """The ``policy`` argument: a known name or a planner policy."""
    if isinstance(policy, type) and not issubclass(policy, PlannerPolicy):
        raise TypeError(f"policy must be a planner policy such as 'MctsPolicy', got {policy.__name__}.")
    if policy in known if isinstance(policy, str) else isinstance(policy, type):
        return policy
    raise ValueError(f"policy must be one of {sorted(known)}, or a subclass of PlannerPolicy, got {policy!r}.")


def check_learning_rate(rate: Any) -> float:
    """The learning rate as a float."""
    if isinstance(rate, bool) or not isinstance(rate, int | float | np.number) or not math.isfinite(rate) or rate <= 0:
        raise ValueError(f"learning_rate must be a finite number above 0 (the default is 0.02), got {rate!r}.")
    return float(rate)


def check_model(model: Any) -> str | TransitionModel:
    """The ``model`` argument: a name, or an object that implements TransitionModel."""
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


def check_overrides(constructor: Callable[..., Any], given: Mapping[str, Any]) -> None:
    """Checks that ``load`` and ``from_state`` accept these arguments.

    Raises:
        TypeError: an argument is not one of the constructor's, or cannot be overridden.
    """
    fixed = {"self", "policy", "env", "reward", "_init_setup_model"}
    allowed = set(inspect.signature(constructor).parameters) - fixed
    if unknown := sorted(set(given) - allowed):
        raise TypeError(f"load() has no argument {unknown[0]!r}; it takes {', '.join(sorted(allowed))}.")


def policy_name(policy_class: type[BasePolicy], aliases: Mapping[str, type[BasePolicy]]) -> str:
    """The name under which a policy is saved.

    Raises:
        ValueError: the policy has no name.
    """
    for name, known in aliases.items():
        if known is policy_class:
            return name
    raise ValueError(f"The policy {policy_class.__name__} has no name for saving; add it to ModelLearningAgent.policy_aliases.")
