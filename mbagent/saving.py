"""Saving and loading agents: what goes into the file and how it comes back."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces

from mbagent import persistence
from mbagent.rewards import RewardFn
from mbagent.transitions import TransitionBatch

if TYPE_CHECKING:
    from mbagent.agent import ModelLearningAgent

_Agent = TypeVar("_Agent", bound="ModelLearningAgent")

SETTINGS = ("gamma", "num_simulations", "horizon", "policy_kwargs", "stats_window_size", "tensorboard_log", "verbose", "seed")
"""Constructor arguments kept as they are; keyword arguments of ``load`` override them."""


def save_agent(agent: ModelLearningAgent, target: persistence.Target, include: Sequence[str]) -> None:
    """See ModelLearningAgent.save."""
    unknown = sorted(set(include) - {"transitions"})
    if unknown:
        raise ValueError(f"include takes 'transitions' only, got {unknown[0]!r}; everything else is saved anyway.")
    if not isinstance(agent.model_name, str):
        raise ValueError(
            f"This agent's model is a {type(agent.model).__name__} object, which a file without code cannot rebuild; "
            "register a factory with mbagent.models.register_model(name, factory) and pass model=name."
        )
    if not isinstance(agent.exploration_name, str):
        raise ValueError("This agent's exploration is an object, which a file cannot rebuild; pass it by name.")
    if agent.policy.fitted:
        agent.goals.fit_learned()
    arrays = {"policy": agent.policy.arrays(), "planning": {"start_states": agent.policy.start_states}}
    if "transitions" in include:
        rows = agent.transitions.rows()
        arrays["transitions"] = {name: getattr(rows, name) for name in rows.__dataclass_fields__}
    persistence.write(target, _data(agent), arrays)


def _data(agent: ModelLearningAgent) -> dict[str, Any]:
    settings: dict[str, Any] = {name: getattr(agent, name) for name in SETTINGS if name != "stats_window_size"}
    return {
        "policy_class": _policy_name(agent),
        "observation_space": persistence.space_to_json(agent.observation_space),
        "action_space": persistence.space_to_json(agent.action_space),
        "settings": {**settings, "stats_window_size": agent._stats_window_size},
        "learning_rate": float(agent.lr_schedule(1.0)),
        "model": agent.model_name,
        "exploration": agent.exploration_name,
        "planning_seed": agent._planning_seed,
        "reward_source": agent.goals.source,
        "fitted": agent.policy.fitted,
        "reward_learned": agent.goals.learned,
        "num_timesteps": agent.num_timesteps,
        "n_envs": getattr(agent, "n_envs", 1),
        "n_updates": agent._n_updates,
    }


def _policy_name(agent: ModelLearningAgent) -> str:
    for name, policy_class in agent.policy_aliases.items():
        if policy_class is agent.policy_class:
            return name
    raise ValueError(
        f"The policy {agent.policy_class.__name__} has no name that a file could hold; "
        "add it to ModelLearningAgent.policy_aliases."
    )


def load_agent(
    cls: type[_Agent],
    source: persistence.Target,
    env: GymEnv | None,
    reward: RewardFn | None,
    force_reset: bool,
    overrides: dict[str, Any],
) -> _Agent:
    """See ModelLearningAgent.load."""
    data, arrays = persistence.read(source)
    allowed = set(inspect.signature(cls.__init__).parameters) - {"self", "policy", "env", "reward", "_init_setup_model"}
    unknown = sorted(set(overrides) - allowed)
    if unknown:
        raise TypeError(f"load() has no argument {unknown[0]!r}; it takes {', '.join(sorted(allowed))}.")
    arguments = {**data["settings"], "learning_rate": data["learning_rate"], "model": data["model"]}
    arguments |= {"exploration": data["exploration"], **overrides}
    agent = cls(data["policy_class"], env=None, _init_setup_model=False, **arguments)
    agent.observation_space = persistence.space_from_json(data["observation_space"])
    agent.action_space = persistence.space_from_json(data["action_space"])
    if overrides.get("seed") is None:
        agent._planning_seed = int(data["planning_seed"])
    agent.n_envs = int(data["n_envs"])
    if env is not None:
        wrapped = cls._wrap_env(env, agent.verbose)
        check_for_correct_spaces(wrapped, agent.observation_space, agent.action_space)
        agent.env, agent.n_envs = wrapped, wrapped.num_envs
    agent._setup_model()
    agent.num_timesteps, agent._n_updates = int(data["num_timesteps"]), int(data["n_updates"])
    _restore(agent, data, arrays, reward)
    if force_reset:
        agent._last_obs = None
    return agent


def _restore(agent: ModelLearningAgent, data: dict[str, Any], arrays: dict[str, Any], reward: RewardFn | None) -> None:
    policy = agent.policy
    policy.start_states = arrays["planning"]["start_states"].astype(np.int64)
    if "transitions" in arrays:
        agent.transitions.append(TransitionBatch(**arrays["transitions"]))
    fitted = bool(data["fitted"])
    if fitted:
        policy.transition_model.load_state_dict(_prefixed(arrays["policy"], "model."))
        policy.reward_model.load_state_dict(_prefixed(arrays["policy"], "reward."))
        policy.fitted = True
    agent.goals.learned = bool(data["reward_learned"])
    policy.refresh()
    if reward is not None:
        agent.set_reward(reward)
    elif fitted or data["reward_source"] == "custom":
        policy.set_goal(agent.goals.restore(data["reward_source"]))


def _prefixed(arrays: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
