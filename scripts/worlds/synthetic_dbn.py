"""A synthetic DBN of d bits of which only a few are ever random, and models trained on it, for timing samplers."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
import torch
from gymnasium import spaces

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.training import NeuralConfig, Trainer, TrainingConfig, examples
from mbagent.models.registry import build_model
from mbagent.spaces import FactoredSpace
from mbagent.types import Ints

Sampler: TypeAlias = Literal["networks", "sweeps"]

PAIRS_REDRAWN = (0, 1, 2, 4)
"""Number of pairs of bits that each action redraws: 0, 2, 4 or 8 of the d bits are uncertain, 3.5 on average."""

AGREEMENT = 0.9
"""Probability that the second bit of a redrawn pair is the opposite of the first."""


def following(states: Ints, actions: Ints, seed: int, rng: np.random.Generator) -> Ints:
    """Next states int64 [B, d]: bits keep their values, except that an action sets a quarter of them, and some pairs are redrawn.

    Args:
        states: states int64 [B, d].
        actions: actions int64 [B].
        seed: seed of the rules: the bits that each action sets, and the pairs.
        rng: random generator of the transitions.
    """
    n, d = states.shape
    fixed = np.random.default_rng([seed, d])
    places = fixed.permutation(d)
    is_set = fixed.random((len(PAIRS_REDRAWN), d)) < 0.25
    value = fixed.integers(0, 2, size=(len(PAIRS_REDRAWN), d))
    result = np.where(is_set[actions], value[actions], states)
    for pair in range(max(PAIRS_REDRAWN)):
        first, second = places[2 * pair : 2 * pair + 2]
        redrawn = np.asarray(PAIRS_REDRAWN)[actions] > pair
        bits = rng.integers(0, 2, size=n)
        opposite = np.where(rng.random(n) < AGREEMENT, 1 - bits, bits)
        result[:, first] = np.where(redrawn, bits, states[:, first])
        result[:, second] = np.where(redrawn, opposite, states[:, second])
    return result


def random_inputs(d: int, n: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """States int64 [n, d] of random bits and actions int64 [n]."""
    return rng.integers(0, 2, size=(n, d)), rng.integers(0, len(PAIRS_REDRAWN), size=n)


def random_data(d: int, n: int, seed: int) -> TransitionDataset:
    """Transitions from random states under random actions, ten per episode."""
    rng = np.random.default_rng([seed, d, 1])
    states, actions = random_inputs(d, n, rng)
    data = TransitionDataset((2,) * d, len(PAIRS_REDRAWN))
    after = following(states, actions, seed, rng)
    data.append(TransitionBatch(states, actions, after, np.zeros(n, dtype=np.bool_), np.zeros(n), np.arange(n) // 10))
    return data


def build_sampler(sampler: Sampler, d: int, steps: int) -> NeuralTransitionModel:
    """An untrained model of the synthetic DBN.

    Args:
        sampler: "networks", as ``model="networks"`` builds it (causal conditioner); or "sweeps": predictor and conditioner
            of the paper's sizes, 2d + 1 and 2d per group, one group per variable, and the paper's sampling.
        d: number of bits.
        steps: steps of gradient descent; "sweeps" only.
    """
    n_actions = len(PAIRS_REDRAWN)
    if sampler == "networks":
        built = build_model("networks", FactoredSpace(spaces.MultiBinary(d)), n_actions, 0.02)
        assert isinstance(built, NeuralTransitionModel)
        return built
    training = TrainingConfig(
        learning_rate=0.01, weight_decay=0.0, batch_size=4096 // d, min_steps=steps, max_steps=steps, checks=2, negligible=-1.0
    )
    # Sizes, masks and procedure are the paper's; the other settings make the networks accurate in few steps.
    config = replace(
        NeuralConfig.paper(d), activation="relu", residual=True, correction=True, certain=1.1, sweeps=1, training=training
    )
    return NeuralTransitionModel((2,) * d, n_actions, config)


def trained(sampler: Sampler, d: int, seed: int, steps: tuple[int, int] = (3000, 300)) -> NeuralTransitionModel:
    """A model fitted to random transitions.

    Args:
        sampler: see ``build_sampler``; "networks" is fitted with its defaults.
        d: number of bits.
        seed: seed of data and fit.
        steps: steps of gradient descent in the predictor and in the conditioner of "sweeps": a step of the conditioner, which has
            d groups as large as the predictor, costs d times as much.
    """
    model, data = build_sampler(sampler, d, steps[1]), random_data(d, 6000, seed)
    if sampler == "networks":
        model.fit(data, seed=seed)
        return model
    training = replace(model.config.training, min_steps=steps[0], max_steps=steps[0])
    alone = NeuralTransitionModel(
        model.cardinalities, model.n_actions, replace(model.config, conditioner=None, training=training), seed=seed
    )
    alone.fit(data, seed=seed)
    train, held_out = (examples(rows) for rows in data.split(training.validation, seed))
    trainer = Trainer(model.codec, alone.predictor, model.conditioner, model.config.training)
    trainer.fit_conditioner(train, held_out, torch.Generator().manual_seed(seed), None)
    model.load_state_dict({**model.state_dict(), **alone.state_dict()})
    return model
