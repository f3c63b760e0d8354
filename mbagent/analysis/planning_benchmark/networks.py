"""Searching in a game through its learned networks: what is trained here is exported as plain arrays for the peers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mbagent.analysis.planning_benchmark.peers import Speed, run_script
from mbagent.analysis.planning_benchmark.worlds import Floats, Ints
from mbagent.models.neural import NeuralTransitionModel
from mbagent.models.packing import pack_dense, pack_groups
from mbagent.transitions import TransitionBatch, TransitionDataset
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.random_keys import derive

WIDTH = 20
"""Columns of the GeyserRunner that is learned: d = 30 bits."""

SPEEDS = ((1, 1024), (16, 1024))
"""(roots, simulations) that are timed."""


class NetworkSearch(Protocol):
    """The library's own search through networks, timed on the same task as the peers'."""

    def __call__(self, task: NetworkTask, roots: Ints, n_simulations: int, seed: int) -> Ints:
        """Actions int64 [R] from roots int64 [R, F]."""
        ...


@dataclass(frozen=True)
class NetworkTask:
    """A learned game, and what is wanted in it.

    Attributes:
        model: predictor and causal conditioner, trained.
        linear: reward of a next state y: ``linear @ y + y @ pairs @ y``, float64 [F].
        pairs: float64 [F, F].
        roots: states of random play, int64 [R, F].
        gamma: discount of a step; leaves are worth 0.
    """

    model: NeuralTransitionModel
    linear: Floats
    pairs: Floats
    roots: Ints
    gamma: float = 0.95


def random_play(game: GeyserRunner, n: int, seed: int, episode: int = 50) -> TransitionDataset:
    """Transitions of random play, int64, ``episode`` steps an episode."""
    n_bits, n_actions = int(np.prod(game.observation_space.shape)), len(game.action_names)
    n_games, rng = max(1, n // episode), np.random.default_rng(seed)
    data, obs = TransitionDataset((2,) * n_bits, n_actions), game.initial(derive(seed, np.arange(n_games)))
    for step in range(episode):
        actions = rng.integers(0, n_actions, size=n_games)
        after = game.transition(obs, actions, derive(seed, np.arange(n_games), step))
        before, reached = obs.astype(np.int64), after.astype(np.int64)
        nothing = np.zeros(n_games)
        data.append(TransitionBatch(before, actions, reached, nothing.astype(np.bool_), nothing, np.arange(n_games)))
        obs = after
    return data


def build_task(seed: int, n_steps: int = 5000) -> NetworkTask:
    """Learns GeyserRunner from random play.

    Args:
        seed: of play and fit.
        n_steps: of random play.
    """
    game = GeyserRunner(width=WIDTH, hit_cost=2.0)
    data = random_play(game, n_steps, seed)
    model = NeuralTransitionModel(data.cardinalities, data.n_actions)
    model.fit(data, seed=seed)
    d, half = len(data.cardinalities), WIDTH // 2
    linear, pairs = np.zeros(d), np.zeros((d, d))
    linear[:WIDTH] = np.arange(WIDTH) / (WIDTH - 1)
    pairs[np.arange(WIDTH - half, WIDTH), np.arange(WIDTH, d)] = -2.0
    return NetworkTask(model, linear, pairs, data.rows().states[:: max(1, len(data) // 16)][:16])


def exported(task: NetworkTask) -> dict[str, NDArray[np.generic]]:
    """Everything that a sampler needs, as plain arrays: see ``DenseWeights`` and ``GroupWeights`` for their meaning.

    Raises:
        ValueError: the model is not what the peers' script can sample: bits, one hidden layer, a causal conditioner.
    """
    model = task.model
    config, codec = model.config, model.codec
    if config.conditioner != "causal" or not config.correction or len(config.hidden) != 1 or not codec.all_binary:
        raise ValueError("The networks script needs bits, one hidden layer, and a causal conditioner that corrects.")
    if config.activation != "silu" or model.conditioner is None:
        raise ValueError(f"The networks script needs silu nodes, not {config.activation}.")
    dense, group = pack_dense(task.model.predictor), pack_groups(model.conditioner)  # type: ignore[arg-type]
    arrays = {f"dense_{name}": getattr(dense, name) for name in ("first", "bias", "last", "last_bias", "stay")}
    arrays |= {f"group_{name}": getattr(group, name) for name in ("inputs", "others", "bias", "readout", "offset")}
    return {
        **arrays,
        "members": model.conditioner.members.numpy(),
        "certain": np.asarray(config.certain),
        "linear": task.linear,
        "pairs": task.pairs,
        "roots": task.roots,
        "gamma": np.asarray(task.gamma),
    }


def run_networks_in_mctx(python: Path, task: NetworkTask, repetitions: int = 5) -> tuple[list[Speed], Floats]:
    """Searches through the networks in mctx.

    Returns:
        what was timed, and the mean next state [F] that mctx's sampler draws from the first root under action 0, to compare.

    Raises:
        PeerError: it did not run.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "networks.npz"
        arrays = {**exported(task), "speeds": np.array(SPEEDS), "repetitions": np.asarray(repetitions)}
        np.savez(path, allow_pickle=False, **arrays)
        told = run_script(python, "mctx_networks", [str(path)])
    return [Speed(**speed) for speed in told["speeds"]], np.array(told["mean_next_state"])
