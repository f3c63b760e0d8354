"""Structure found in data: bits that exclude each other, rare events, and what each variable hangs on."""

from mbagent.models.graphs.local import LocalGraphModel, channel_cardinalities
from mbagent.models.graphs.model import DecisionGraphModel
from mbagent.models.graphs.placed import PlaneGraphModel

__all__ = ["DecisionGraphModel", "LocalGraphModel", "PlaneGraphModel", "channel_cardinalities"]
