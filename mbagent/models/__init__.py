"""Transition models behind one protocol: decision graphs, the paper's networks, tables of counts, and simulators."""

from mbagent.models.base import BaseTransitionModel
from mbagent.models.fit_report import FitReport
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.networks import Conditioner, DensePredictor, FactorCodec, PlanePredictor, Predictor
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from mbagent.models.protocol import Successors, TransitionModel
from mbagent.models.registry import build_model, register_model
from mbagent.models.simulator import SimulatorModel
from mbagent.models.tabular import TabularModel

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
