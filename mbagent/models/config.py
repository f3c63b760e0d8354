"""What a neural model looks like and how it is used."""

from __future__ import annotations

from dataclasses import dataclass, field

from mbagent.models.networks import Activation, Mask
from mbagent.models.training import TrainingConfig


@dataclass(frozen=True)
class NeuralConfig:
    """What the networks look like and how they are used.

    Attributes:
        hidden: sizes of the dense predictor's hidden layers.
        activation: of all hidden nodes.
        residual: whether the predictor has a learned path from s_i to s'_i.
        conditioner: "causal" (ancestral sampling, exact probabilities), "others" (the paper's sweeps), or None (factors
            independent given state and action).
        group_size: hidden nodes in each of the conditioner's groups.
        correction: whether the conditioner's output is added to the predictor's logits.
        certain: a factor whose likeliest value has this probability in the predictor's eyes is left to the predictor; in sweeps
            the conditioner is asked about it only where the number drawn could matter (``sweep_blocks.LEEWAY``).
        dropout: share of hidden nodes zeroed in each training step; without it, networks learn the noise of rare
            states. None: 0.4, or 0 where the state is a single factor: its columns show nothing that states have in
            common, the network is a table then, and dropout only blurs it.
        sweeps: passes over all factors, mask "others".
        real_guess: whether the first guess is the predictor's probabilities rather than bits drawn from them.
        training: see TrainingConfig.
    """

    hidden: tuple[int, ...] = (128,)
    activation: Activation = "silu"
    residual: bool = True
    conditioner: Mask | None = "causal"
    group_size: int = 16
    correction: bool = True
    certain: float = 0.999
    dropout: float | None = None
    sweeps: int = 5
    real_guess: bool = False
    training: TrainingConfig = field(default_factory=TrainingConfig)

    def dropout_for(self, n_factors: int) -> float:
        """The dropout share that is meant for states of ``n_factors`` factors."""
        if self.dropout is not None:
            return self.dropout
        return 0.4 if n_factors > 1 else 0.0

    @classmethod
    def paper(cls, n_variables: int) -> NeuralConfig:
        """Section 3's networks as they stand, for d = ``n_variables``: 2d + 1 and 2d^2 hidden nodes, sigmoids, squared error."""
        return cls(
            hidden=(2 * n_variables + 1,),
            activation="sigmoid",
            residual=False,
            conditioner="others",
            group_size=2 * n_variables,
            correction=False,
            certain=1.0,
            dropout=0.0,
            training=TrainingConfig(learning_rate=0.03, weight_decay=0.0, loss="squared"),
        )
