"""Saving and loading agents as files that contain no code: SB3's zip layout with JSON data and plain arrays."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import stable_baselines3
from numpy.typing import NDArray

from mbagent import files
from mbagent.data import TransitionBatch
from mbagent.files import Target
from mbagent.rewards import Source
from mbagent.types import Ints, States

FORMAT = "mbagent-agent-1"

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
"""Constructor arguments that are saved unchanged; keyword arguments of ``load`` override them."""

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
"""Keys that a file's data must contain."""


@dataclass(frozen=True)
class AgentState:
    """An agent as plain data: the contents of its file.

    Attributes:
        data: JSON data, with at least the keys in REQUIRED.
        arrays: arrays by group and name; the groups are "policy" (weights), "planning" (start states) and, if included,
            "transitions".

    Raises:
        ValueError: an entry is missing or of the wrong type; the message names it.
    """

    data: Mapping[str, Any]
    arrays: Mapping[str, Mapping[str, NDArray[Any]]]

    def __post_init__(self) -> None:
        """Checks that the state is complete."""
        missing = [name for name in REQUIRED if name not in self.data]
        missing += [f"{name}.npz" for name in ("policy", "planning") if name not in self.arrays]
        if not missing and "start_states" not in self.arrays["planning"]:
            missing = ["planning.npz: start_states"]
        if missing:
            raise ValueError(f"The file is not a complete saved agent: it lacks {', '.join(missing)}.")
        if not isinstance(self.data["settings"], dict) or self.data["reward_source"] not in get_args(Source):
            raise ValueError("The file is damaged: its settings or its reward source cannot be read.")

    def weights(self, prefix: str) -> dict[str, NDArray[Any]]:
        """The policy's arrays whose names begin with ``prefix``; the prefix is removed from the names."""
        return {name.removeprefix(prefix): value for name, value in self.arrays["policy"].items() if name.startswith(prefix)}

    def start_states(self, cardinalities: Ints) -> States:
        """Start states int64 [S, F].

        Args:
            cardinalities: number of values of each factor, int64 [F].

        Raises:
            ValueError: the saved start states are not states of these factors.
        """
        found = self.arrays["planning"]["start_states"].astype(np.int64)
        if found.ndim != 2 or found.shape[1] != len(cardinalities) or (found < 0).any() or (found >= cardinalities).any():
            raise ValueError("The file's start states lie outside its observation space; it is damaged.")
        return found

    @property
    def transitions(self) -> TransitionBatch | None:
        """The transitions, or None if not included."""
        return TransitionBatch(**self.arrays["transitions"]) if "transitions" in self.arrays else None


def write(target: Target, state: AgentState) -> None:
    """Writes a zip with the state's ``data`` as JSON and each group of its ``arrays`` as a separate ``.npz``.

    A path without suffix gets ``.zip``, as in SB3; missing folders are created. An interrupted call leaves no partial file.

    Raises:
        TypeError, ValueError, OSError: see ``files.writing``.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", json.dumps({"format": FORMAT, **state.data}, indent=1))
        for name, group in state.arrays.items():
            part = io.BytesIO()
            files.write_arrays(part, group)
            archive.writestr(f"{name}.npz", part.getvalue())
        archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
        archive.writestr("system_info.txt", f"- Gymnasium: {gym.__version__}\n- Numpy: {np.__version__}\n")
    with files.writing(target, ".zip", always=False) as file:
        file.write(buffer.getbuffer())


def read(source: Target) -> AgentState:
    """Reads a file written by ``write``; no code in the file is ever run.

    Raises:
        FileNotFoundError: there is no such file.
        TypeError: ``source`` is neither a path nor an open binary file.
        ValueError: the file is of another kind, incomplete, or contains serialized code; the message names the problem.
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
        raise ValueError(f"{label} is not a saved agent, or is damaged: {error}.") from error
    return AgentState(data, arrays)


def refuse_serialized(data: Any, names: list[str]) -> None:
    """Raises ValueError, naming the entry, if the file contains pickled objects, which would run code when read."""
    for name in names:
        if name.endswith((".pth", ".pt", ".pkl", ".pickle")):
            raise ValueError(f"The file's entry {name!r} is a pickle, which runs code when read; mbagent files contain none.")
    if not isinstance(data, dict):
        raise ValueError("The file's entry 'data' is not a JSON object; it was not saved by an mbagent agent.")
    for key, value in data.items():
        if isinstance(value, dict) and ":serialized:" in value:
            raise ValueError(f"The file's entry {key!r} is serialized code; mbagent files contain none, so it is refused.")


def _arrays(archive: zipfile.ZipFile, name: str, label: Any) -> dict[str, NDArray[Any]]:
    try:
        return files.arrays(io.BytesIO(archive.read(name)))
    except ValueError as error:
        raise ValueError(f"{label} is damaged: its entry {name!r} cannot be read because {error}.") from error
