"""Transition models: the paper's predictor and conditioner, tables, and the true simulator behind one protocol."""

from mbagent.models.base import BaseTransitionModel, FitReport, Successors, TransitionModel
from mbagent.models.config import NeuralConfig
from mbagent.models.factory import build_model, register_model
from mbagent.models.networks import Conditioner, DensePredictor, FactorCodec, Predictor
from mbagent.models.neural import NeuralTransitionModel
from mbagent.models.planes import PlanePredictor
from mbagent.models.simulator import SimulatorModel
from mbagent.models.tabular import TabularModel
from mbagent.models.training import TrainingConfig

__all__ = [
    "BaseTransitionModel",
    "Conditioner",
    "DensePredictor",
    "FactorCodec",
    "FitReport",
    "NeuralConfig",
    "NeuralTransitionModel",
    "PlanePredictor",
    "Predictor",
    "SimulatorModel",
    "Successors",
    "TabularModel",
    "TrainingConfig",
    "TransitionModel",
    "build_model",
    "register_model",
]
