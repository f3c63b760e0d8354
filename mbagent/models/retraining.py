"""Removing connections of predictor and conditioner and training what is left (paper section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import nn

from mbagent.models.evidence import trim_conditioner, trim_predictor
from mbagent.models.networks import DensePredictor
from mbagent.models.pruning import Connections, PruningConfig, Shrinking
from mbagent.models.training import Examples, Progress, Trainer

BATCHES = 0x9F
"""Added to the seed of the batches: they are not those of the fit before."""

ROUNDS = 3
"""How often what the data do not call for goes; what is left says it more clearly each time that it is trained again."""

SETTLE, RATE = 600, 0.25
"""Steps of training after each time, and share of the learning rate."""


def prune_networks(
    trainer: Trainer,
    connections: Mapping[str, Connections],
    fraction: float,
    train: Examples,
    held_out: Examples,
    n_transitions: int,
    seed: int,
    progress: Progress | None,
    config: PruningConfig | None,
) -> float:
    """Prunes the predictor, then the conditioner, which corrects what the pruned predictor says; returns epochs done.

    Args:
        trainer: of the networks.
        connections: of "predictor" and, where there is one, "conditioner".
        fraction: of each network's connections that are gone in the end.
        train: to train on.
        held_out: to choose the best weights by.
        n_transitions: that the rows to train on stand for.
        seed: of the batches.
        progress: is told the share done.
        config: see PruningConfig.
    """
    config, generator = config or PruningConfig(), torch.Generator().manual_seed(seed + BATCHES)
    both = "conditioner" in connections and connections["conditioner"].total > 0
    predictor, conditioner = trainer.predictor, trainer.conditioner
    half = progress if progress is None or trainer.conditioner is None else lambda share: progress(0.5 * share)
    epochs = trainer.fit(train, held_out, generator, half, Shrinking(connections["predictor"], fraction, config))
    if isinstance(predictor, DensePredictor):
        for _ in range(ROUNDS * config.evidence):
            trim_predictor(predictor, train, n_transitions)
            epochs += _settle(trainer).fit(train, held_out, generator, None, _as_left(predictor))
    if not both or conditioner is None:
        return epochs
    half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
    shrinking = Shrinking(connections["conditioner"], fraction, config)
    epochs += trainer.fit_conditioner(train, held_out, generator, half, shrinking)
    for _ in range(ROUNDS * config.evidence):
        trim_conditioner(conditioner, predictor, train, n_transitions)
        epochs += _settle(trainer).fit_conditioner(train, held_out, generator, None, _as_left(conditioner))
    return epochs


def _settle(trainer: Trainer) -> Trainer:
    """A trainer of the same networks that trains them for a short while, at a low rate."""
    config = trainer.config
    short = replace(config, min_steps=SETTLE, max_steps=SETTLE, learning_rate=RATE * config.learning_rate)
    return Trainer(trainer.codec, trainer.predictor, trainer.conditioner, short)


def _as_left(module: nn.Module) -> Shrinking:
    """Keeps what is gone at 0."""
    return Shrinking(Connections(module, zeros_gone=True), 0.0, PruningConfig(gradual=False))
