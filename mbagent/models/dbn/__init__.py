"""Dynamic Bayesian networks whose conditional distributions are decision graphs, learned from transitions."""

from mbagent.models.dbn.model import DecisionGraphModel
from mbagent.models.dbn.planes.model import LocalGraphModel, PlaneGraphModel, channel_cardinalities

__all__ = ["DecisionGraphModel", "LocalGraphModel", "PlaneGraphModel", "channel_cardinalities"]
