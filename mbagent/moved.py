"""Module paths of the previous version, valid for one more version with a DeprecationWarning."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_PACKAGE = "mbagent."

_FORMERLY = {
    "evaluation": "analysis",
    "evaluation.baselines": "analysis.baselines",
    "evaluation.evaluate": "analysis.evaluation",
    "evaluation.statistics": "analysis.statistics",
    "agent": "pruned",
    "checkpoint spaces agent": "saving",
    "checkpoint": "persistence",
    "training_log": "reporting",
    "data": "experience transitions",
    "environments": "subprocesses wrapping",
    "explain": "explanations",
    "rewards": "goals",
    "spaces": "leaves",
    "types": "planning.goal",
    "exploration.controllability": "steering",
    "exploration.strategies": "visits",
    "models.base": "models.known",
    "models.dbn": "models.graphs",
    "models.held_out": "models.memory",
    "models.mdp": "models.reachable models.state_graph",
    "models.model_error": "models.trust",
    "models.kernel": "models.compiled_model models.overloads",
    "models.registry": "models.factory",
    "models.reward": "learned_reward models.reward_kernel",
    "models.reward_changes": "reward_changes",
    "models.systematic_sampling": "models.particles models.thinning",
    "models.tabular": "models.table",
    "planning.fitted_value_iteration": "planning.fitted_values",
    "planning.flat_monte_carlo": "planning.rollouts",
    "planning.lookahead": "planning.growing",
    "planning.planners": "planning.machine_planner planning.mcts",
    "planning.racing": "planning.rehearsal",
    "planning.search": "planning.reuse planning.tree planning.waves",
    "planning.trajectories": "planning.foresight",
    "planning.value_iteration": "planning.leaf_values",
    "models.dbn.affected_variables": "models.graphs.ending models.graphs.lean",
    "models.dbn.arrays": "models.graphs.arrays models.graphs.compiled",
    "models.dbn.change_points": "models.graphs.recency",
    "models.dbn.effects": "models.graphs.habits models.graphs.manners models.graphs.partners",
    "models.dbn.expander": "models.graphs.expanding",
    "models.dbn.features": "models.graphs.acts models.graphs.units",
    "models.dbn.fitting": "models.graphs.conditioner models.graphs.events models.graphs.fitting",
    "models.dbn.planes.invariants": "models.graphs.laws",
    "models.dbn.planes.large_data": "models.graphs.looks models.graphs.zoom",
    "models.dbn.leaf_prior": "models.graphs.leaves",
    "models.dbn.model": "models.graphs.model models.graphs.parents",
    "models.dbn.mutex": "models.graphs.couplings models.graphs.exclusive",
    "models.dbn.planes.features": "models.graphs.instantiate models.graphs.windows",
    "models.dbn.planes.model": "models.graphs.channels models.graphs.local models.graphs.placed",
    "models.dbn.reward_graphs": "models.graphs.transition_classes",
    "models.dbn.sampling": "models.graphs.draws",
    "models.dbn.score": "models.graphs.evidence models.graphs.search",
    "models.dbn.split_search": "models.graphs.greedy models.graphs.pairs",
    "models.dbn.successors": "models.graphs.listing models.graphs.predictions models.graphs.whole",
    "models.neural.connections": "models.pruning",
    "models.neural.export": "models.packing",
    "models.neural.forecasts": "models.forecasts",
    "models.neural.gibbs": "models.sweep_blocks models.sweeps",
    "models.neural.kernels": "models.arithmetic models.kernels",
    "models.neural.network_pair": "models.network_pair",
    "models.neural.network_pair models.neural.training": "models.config",
    "models.neural.networks": "models.networks models.plane_strings models.planes",
    "models.neural.pruning": "models.evidence models.modules models.retraining",
    "models.neural.sampling": "models.samplers",
    "models.neural.sampling models.systematic_sampling": "models.systematic",
    "models.neural.training": "models.training",
    "models.neural.truth_tables": "models.bit_rules models.tabulate",
}
"""Present modules, separated by spaces where an old one was divided: the old modules that they hold now."""

MOVED = {
    _PACKAGE + old: tuple(_PACKAGE + name for name in new.split()) for new, olds in _FORMERLY.items() for old in olds.split()
}
"""Old module path: the paths where its names are now."""


_RENAMED = {
    "MachinePlanner": "ValueIterationPlanner",
    "TableModel": "TabularMDP",
    "KnownModel": "ExactModel",
    "GivenReward": "CallableReward",
    "GoalBook": "RewardSelector",
    "Goal": "Reward",
}
"""Names of classes at the old paths, and their present ones."""


class _OldPaths(MetaPathFinder, Loader):
    """Finds the old paths, and only those: it comes after all other finders."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """See MetaPathFinder."""
        if fullname not in MOVED:
            return None
        return ModuleSpec(fullname, self, is_package=any(other.startswith(f"{fullname}.") for other in MOVED))

    def exec_module(self, module: ModuleType) -> None:
        """See Loader."""
        places = MOVED[module.__name__]
        warnings.warn(f"{module.__name__} has moved to {' and '.join(places)}.", DeprecationWarning, stacklevel=2)

        def find(name: str) -> Any:
            for place in () if name.startswith("__") else places:
                found = importlib.import_module(place)
                for present in (name, _RENAMED.get(name, name)):
                    if hasattr(found, present):
                        return getattr(found, present)
            raise AttributeError(f"{module.__name__} has moved to {' and '.join(places)}, and has no {name!r} there.")

        vars(module)["__getattr__"] = find


def install() -> None:
    """Makes the old paths importable."""
    if not any(isinstance(finder, _OldPaths) for finder in sys.meta_path):
        sys.meta_path.append(_OldPaths())
