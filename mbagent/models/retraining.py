"""Removing connections of predictor and conditioner and training what is left (paper section 5)."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from mbagent.models.pruning import Connections, PruningConfig, Shrinking
from mbagent.models.training import Examples, Progress, Trainer

BATCHES = 0x9F
"""Added to the seed of the batches: they are not those of the fit before."""


def prune_networks(
    trainer: Trainer,
    connections: Mapping[str, Connections],
    fraction: float,
    train: Examples,
    held_out: Examples,
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
        seed: of the batches.
        progress: is told the share done.
        config: see PruningConfig.
    """
    config, generator = config or PruningConfig(), torch.Generator().manual_seed(seed + BATCHES)
    half = progress if progress is None or trainer.conditioner is None else lambda share: progress(0.5 * share)
    shrinking = Shrinking(connections["predictor"], fraction, config)
    epochs = trainer.fit(train, held_out, generator, half, shrinking)
    if "conditioner" not in connections or connections["conditioner"].total == 0:
        return epochs
    half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
    shrinking = Shrinking(connections["conditioner"], fraction, config)
    return epochs + trainer.fit_conditioner(train, held_out, generator, half, shrinking)
