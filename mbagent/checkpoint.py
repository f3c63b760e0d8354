"""Saving and loading agents as files that hold no code: SB3's zip layout with JSON data and plain arrays."""

from __future__ import annotations

import inspect
import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast, get_args

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info

from mbagent import files
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.files import Target
from mbagent.rewards import RewardFn, Source

if TYPE_CHECKING:
    from mbagent.agent import ModelLearningAgent

FORMAT = "mbagent-agent-1"


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """A discrete space as JSON data.

    Raises:
        TypeError: the space has no such form.
    """
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {
            "type": "MultiDiscrete",
            "nvec": space.nvec.tolist(),
            "start": space.start.tolist(),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.MultiBinary):
        n = space.n
        return {
            "type": "MultiBinary",
            "n": int(n) if isinstance(n, int | np.integer) else [int(k) for k in n],
        }
    if isinstance(space, spaces.Box):
        return {
            "type": "Box",
            "low": space.low.tolist(),
            "high": space.high.tolist(),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": [[key, space_to_json(part)] for key, part in space.spaces.items()]}
    if isinstance(space, spaces.Tuple):
        return {"type": "Tuple", "spaces": [space_to_json(part) for part in space.spaces]}
    raise TypeError(f"The space {space} cannot be written as JSON.")


def space_from_json(data: Mapping[str, Any]) -> spaces.Space[Any]:
    """The space that ``space_to_json`` wrote.

    Raises:
        ValueError: the data names no known space.
    """
    kind = data.get("type")
    if kind == "Discrete":
        return spaces.Discrete(data["n"], start=data["start"])
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(np.array(data["nvec"]), start=np.array(data["start"]), dtype=np.dtype(data["dtype"]).type)
    if kind == "MultiBinary":
        return spaces.MultiBinary(data["n"] if isinstance(data["n"], int) else tuple(data["n"]))
    if kind == "Box":
        dtype = np.dtype(data["dtype"])
        return spaces.Box(np.array(data["low"], dtype=dtype), np.array(data["high"], dtype=dtype), dtype=dtype.type)
    if kind == "Dict":
        return spaces.Dict([(key, space_from_json(part)) for key, part in data["spaces"]])
    if kind == "Tuple":
        return spaces.Tuple([space_from_json(part) for part in data["spaces"]])
    raise ValueError(f"The file names an unknown space {kind!r}; it was written by another program or version.")


def write(target: Target, data: Mapping[str, Any], arrays: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    """Writes a zip with ``data`` as JSON and each group of ``arrays`` as an ``.npz`` of its own.

    A path without suffix gets ``.zip``, as in SB3; missing folders are made. The file is complete or not there.

    Raises:
        TypeError, ValueError, OSError: see ``files.writing``.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", json.dumps({"format": FORMAT, **data}, indent=1))
        for name, group in arrays.items():
            part = io.BytesIO()
            np.savez(part, allow_pickle=False, **group)
            archive.writestr(f"{name}.npz", part.getvalue())
        archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
        archive.writestr("system_info.txt", f"- Gymnasium: {gym.__version__}\n- Numpy: {np.__version__}\n")
    with files.writing(target, ".zip", always=False) as file:
        file.write(buffer.getbuffer())


def read(source: Target) -> tuple[dict[str, Any], dict[str, dict[str, NDArray[Any]]]]:
    """Reads what ``write`` wrote, as (data, arrays); nothing in the file is ever run.

    Raises:
        FileNotFoundError: there is no such file.
        TypeError: ``source`` is neither a path nor an open binary file.
        ValueError: the file is of another kind, or holds serialized code; the message names the entry.
    """
    label: Any = "The file"
    try:
        with files.reading(source, ".zip") as file, zipfile.ZipFile(file) as archive:
            label = getattr(file, "name", label)
            names = archive.namelist()
            data = json.loads(archive.read("data")) if "data" in names else {}
            ours = isinstance(data, dict) and data.get("format") == FORMAT
            if not ours and "_stable_baselines3_version" in names:
                raise ValueError(
                    f"{label} was saved by another Stable-Baselines3 algorithm, not by ModelLearningAgent; load it with the "
                    "class that saved it, for example stable_baselines3.PPO.load(path)."
                )
            refuse_serialized(data, names)
            if not ours:
                raise ValueError(f"{label} was not saved by ModelLearningAgent; load it with the program that saved it.")
            arrays = {Path(name).stem: _arrays(archive, name, label) for name in names if name.endswith(".npz")}
    except (zipfile.BadZipFile, json.JSONDecodeError, UnicodeDecodeError, KeyError, NotImplementedError, zlib.error) as error:
        raise ValueError(f"{label} is no saved agent, or is damaged: {error}.") from error
    return data, arrays


def refuse_serialized(data: Any, names: list[str]) -> None:
    """Raises ValueError, naming the entry, if the file holds pickled objects, which would run code when read."""
    for name in names:
        if name.endswith((".pth", ".pt", ".pkl", ".pickle")):
            raise ValueError(f"The file's entry {name!r} is a pickle, which runs code when read; mbagent files hold none.")
    if not isinstance(data, dict):
        raise ValueError("The file's entry 'data' is no JSON object; it was not saved by an mbagent agent.")
    for key, value in data.items():
        if isinstance(value, dict) and ":serialized:" in value:
            raise ValueError(f"The file's entry {key!r} is serialized code; mbagent files hold none, so it is refused.")


def _arrays(archive: zipfile.ZipFile, name: str, label: Any) -> dict[str, NDArray[Any]]:
    try:
        return files.arrays(io.BytesIO(archive.read(name)))
    except ValueError as error:
        raise ValueError(f"{label} is damaged: its entry {name!r} cannot be read because {error}.") from error


SETTINGS = (
    "gamma",
    "num_simulations",
    "time_budget",
    "horizon",
    "policy_kwargs",
    "stats_window_size",
    "tensorboard_log",
    "verbose",
    "seed",
)
"""Constructor arguments kept as they are; keyword arguments of ``load`` override them."""

REQUIRED = (
    "policy_class",
    "observation_space",
    "action_space",
    "settings",
    "learning_rate",
    "model",
    "exploration",
    "planning_seed",
    "reward_source",
    "fitted",
    "reward_learned",
    "num_timesteps",
    "n_envs",
    "n_updates",
)
"""What a file's data must hold."""


class SavableAlgorithm(BaseAlgorithm):
    """What ModelLearningAgent does with files; SB3's own ``load`` would run code that a hostile file holds."""

    def save(  # type: ignore[override]
        self,
        path: Target,
        exclude: Sequence[str] | None = None,
        include: Sequence[str] | str | None = None,
    ) -> None:
        """Writes settings, weights, start states and the learned reward to a zip that holds no code (see persistence).

        Args:
            path: a path (".zip" is added where there is no suffix) or an open binary file.
            exclude: accepted as in SB3; nothing here can be left out.
            include: ``"transitions"``, or a list of it, adds what was experienced.

        Raises:
            ValueError: the model or the exploration is an object that a file cannot rebuild, or ``include`` names anything else.
            TypeError: ``path`` is neither a path nor an open binary file.
            OSError: the file cannot be written; one that was there before is unchanged.
        """
        del exclude
        _save(cast("ModelLearningAgent", self), path, [include] if isinstance(include, str) else include or ())

    @classmethod
    def load(  # type: ignore[override]
        cls,
        path: Target,
        env: GymEnv | None = None,
        device: torch.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        reward: RewardFn | None = None,
        **kwargs: Any,
    ) -> Self:
        """The agent that ``save`` wrote; no code in the file is ever run.

        Args:
            path: where it was written.
            env: a new environment, with the same spaces.
            device: torch device.
            custom_objects: accepted as in SB3; files hold no objects that could be replaced.
            print_system_info: accepted as in SB3.
            force_reset: whether ``learn`` starts with a reset.
            reward: the goal; needed again if it was a custom one.
            **kwargs: constructor arguments that override the saved ones.

        Raises:
            FileNotFoundError, TypeError, ValueError: no such file, no path at all, or no saved agent.
        """
        del custom_objects
        if print_system_info:
            get_system_info()
        return cast(
            "Self", _load(cast("type[ModelLearningAgent]", cls), path, env, reward, force_reset, {"device": device, **kwargs})
        )

    def set_parameters(
        self,
        load_path_or_dict: str | Mapping[str, Any],
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Takes weights from a saved agent or from ``get_parameters``; planning caches are dropped, the goal stays."""
        params = load_path_or_dict
        if not isinstance(params, Mapping):
            params = {"policy": read(params)[1]["policy"]}
        agent = cast("ModelLearningAgent", self)
        with agent.policy.lock:
            before = agent.policy.parts()
            try:
                weights = params.get("policy", {})
                agent._recode(agent.policy.factored.from_value_arrays({k: np.asarray(v) for k, v in dict(weights).items()}))
                super().set_parameters(dict(params), exact_match, device)
            except Exception:
                if before[0] is not agent.policy.factored:
                    agent.policy.recode(*before)
                    agent.goals.recode()
                    agent._refresh()
                raise
            agent._refresh()

    def save_transitions(self, path: Target) -> None:
        """Writes what was experienced as an ``.npz`` of plain arrays (see TransitionDataset.save, also for what it raises)."""
        cast("ModelLearningAgent", self).experience.dataset.save(path)

    def load_transitions(self, path: Target) -> None:
        """Takes transitions from a file into this agent's experience; the next ``learn`` fits to them too.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it holds no transitions, or those of another kind of environment; nothing is changed then.
        """
        loaded = TransitionDataset.load(path)
        cast("ModelLearningAgent", self).experience.dataset.take(loaded)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "policy", "transitions", "goals"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []


def _save(agent: ModelLearningAgent, target: Target, include: Sequence[str]) -> None:
    unknown = [name for name in include if name != "transitions"]
    if unknown:
        raise ValueError(f"include takes 'transitions' only, got {unknown[0]!r}; everything else is always saved.")
    if not isinstance(agent.model_name, str):
        raise ValueError(
            f"This agent's model is a {type(agent.model).__name__} object, which a file without code cannot rebuild; "
            "register a factory with mbagent.models.register_model(name, factory) and pass model=name."
        )
    if not isinstance(agent.exploration_name, str):
        raise ValueError("This agent's exploration is an object, which a file cannot rebuild; pass it by name.")
    with agent.policy.lock:
        if agent.policy.fitted:
            agent.goals.fit_learned()
        arrays = {"policy": agent.policy.arrays(), "planning": {"start_states": agent.policy.start_states}}
        if "transitions" in include:
            rows = agent.experience.dataset.rows()
            arrays["transitions"] = {name: getattr(rows, name) for name in rows.__dataclass_fields__}
        data = _data(agent)
    write(target, data, arrays)


def _data(agent: ModelLearningAgent) -> dict[str, Any]:
    settings: dict[str, Any] = {name: getattr(agent, name) for name in SETTINGS if name != "stats_window_size"}
    return {
        "policy_class": _policy_name(agent),
        "observation_space": space_to_json(agent.observation_space),
        "action_space": space_to_json(agent.action_space),
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


def _load(
    cls: type[ModelLearningAgent],
    source: Target,
    env: GymEnv | None,
    reward: RewardFn | None,
    force_reset: bool,
    overrides: dict[str, Any],
) -> ModelLearningAgent:
    data, arrays = read(source)
    _check(data, arrays)
    allowed = set(inspect.signature(cls.__init__).parameters) - {
        "self",
        "policy",
        "env",
        "reward",
        "_init_setup_model",
    }
    unknown = sorted(set(overrides) - allowed)
    if unknown:
        raise TypeError(f"load() has no argument {unknown[0]!r}; it takes {', '.join(sorted(allowed))}.")
    arguments = {**data["settings"], "learning_rate": data["learning_rate"], "model": data["model"]}
    arguments |= {"exploration": data["exploration"], **overrides}
    agent = cls(data["policy_class"], env=None, _init_setup_model=False, **arguments)
    agent.observation_space = space_from_json(data["observation_space"])
    agent.action_space = space_from_json(data["action_space"])
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


def _check(data: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Raises ValueError, naming what is wrong, if the file lacks something."""
    missing = [name for name in REQUIRED if name not in data] + [
        f"{name}.npz" for name in ("policy", "planning") if name not in arrays
    ]
    if not missing and "start_states" not in arrays["planning"]:
        missing = ["planning.npz: start_states"]
    if missing:
        raise ValueError(f"The file is no complete saved agent: it lacks {', '.join(missing)}.")
    if not isinstance(data["settings"], dict) or data["reward_source"] not in get_args(Source):
        raise ValueError("The file is damaged: its settings or its reward source cannot be read.")


def _restore(agent: ModelLearningAgent, data: dict[str, Any], arrays: dict[str, Any], reward: RewardFn | None) -> None:
    policy = agent.policy
    agent._recode(policy.factored.from_value_arrays(arrays["policy"]))
    starts = arrays["planning"]["start_states"].astype(np.int64)
    if (
        starts.ndim != 2
        or starts.shape[1] != len(policy.factored)
        or (starts < 0).any()
        or (starts >= policy.factored.cardinalities).any()
    ):
        raise ValueError("The file's start states lie outside its observation space; it is damaged.")
    policy.start_states = starts
    if "transitions" in arrays:
        agent.experience.dataset.append(TransitionBatch(**arrays["transitions"]))
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
