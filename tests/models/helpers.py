"""Small data sets and models with random weights, for tests of models."""

from collections.abc import Callable

import numpy as np
import torch

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models import NeuralConfig, NeuralTransitionModel, SimulatorModel, TrainingConfig
from mbagent.types import Bools, Floats, Ints
from mbagent_envs import Game
from mbagent_envs.random_keys import draw_keys

MIXED = (2, 3, 2, 4)
"""Cardinalities of a small mixed world."""

QUICK = TrainingConfig(min_steps=400, max_steps=400)


def dataset(
    cardinalities: tuple[int, ...],
    n_actions: int,
    states: Ints,
    actions: Ints,
    next_states: Ints,
    terminated: Bools | None = None,
    episode_length: int = 20,
) -> TransitionDataset:
    n = len(actions)
    data = TransitionDataset(cardinalities, n_actions)
    ends = np.zeros(n, dtype=np.bool_) if terminated is None else terminated
    data.append(TransitionBatch(states, actions, next_states, ends, np.zeros(n), np.arange(n) // episode_length))
    return data


def played(game: Game, n_steps: int, episode_length: int, seed: int = 0) -> TransitionDataset:
    """Random play in a game that never terminates."""
    model, rng = SimulatorModel(game), np.random.default_rng(seed)
    n_episodes = n_steps // episode_length
    states = game.initial(draw_keys(rng, n_episodes)).reshape(n_episodes, -1).astype(np.int64)
    data = TransitionDataset(model.cardinalities, model.n_actions)
    for _ in range(episode_length):
        actions = rng.integers(model.n_actions, size=n_episodes)
        following, ends = model.sample(states, actions, rng)
        data.append(TransitionBatch(states, actions, following, ends, np.zeros(n_episodes), np.arange(n_episodes)))
        states = following
    return data


def outcomes(cardinalities: tuple[int, ...]) -> tuple[Ints, Bools]:
    """All combinations of next state and terminated."""
    every = np.stack(np.unravel_index(np.arange(2 * np.prod(cardinalities)), (*cardinalities, 2)), axis=1)
    return every[:, :-1].astype(np.int64), every[:, -1] == 1


def distribution(model: NeuralTransitionModel, state: Ints, action: int) -> Floats:
    """Probability of each of ``outcomes`` after one state and action."""
    following, ends = outcomes(model.cardinalities)
    n = len(ends)
    return np.exp(model.log_prob(np.tile(state, (n, 1)), np.full(n, action), following, ends))


def outcome_numbers(cardinalities: tuple[int, ...], states: Ints, terminated: Bools) -> Ints:
    """Index of each outcome in ``outcomes``."""
    return np.ravel_multi_index((*states.T, terminated.astype(np.int64)), (*cardinalities, 2)).astype(np.int64)


def scrambled(
    cardinalities: tuple[int, ...] = MIXED,
    n_actions: int = 3,
    config: NeuralConfig | None = None,
    scale: float = 1.0,
    seed: int = 0,
    body: Callable[..., torch.nn.Module] | None = None,
) -> NeuralTransitionModel:
    """A model with random weights: all probabilities are well above 0, and all dependencies exist."""
    model = NeuralTransitionModel(cardinalities, n_actions, config or NeuralConfig(hidden=(8,), group_size=4), body=body)
    rng = np.random.default_rng(seed)
    weights = {
        name: (rng.normal(scale=scale, size=array.shape).astype(array.dtype) if array.dtype == np.float32 else array)
        for name, array in model.state_dict().items()
    }
    model.load_state_dict(weights)
    return model


def random_rows(cardinalities: tuple[int, ...], n_actions: int, n: int, seed: int = 0) -> tuple[Ints, Ints]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, cardinalities, size=(n, len(cardinalities))), rng.integers(n_actions, size=n)
