"""The networks of the paper's section 3: training, pruning and compiled inference."""

from mbagent.models.neural.model import NeuralTransitionModel

__all__ = ["NeuralTransitionModel"]
