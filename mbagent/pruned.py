"""Pruning an agent (paper section 5): most connections of its model go, and it plans on with what is left."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, Self, cast, runtime_checkable

from mbagent.models.base import FitReport, TransitionModel
from mbagent.models.pruning import PruningConfig, check_fraction
from mbagent.reporting import fit_progress, log_fit
from mbagent.saving import SavableAlgorithm
from mbagent.transitions import TransitionDataset

if TYPE_CHECKING:
    from mbagent.agent import ModelLearningAgent


@runtime_checkable
class PrunableModel(Protocol):
    """A transition model that has connections to remove; see ``NeuralTransitionModel.prune``."""

    def prune(
        self,
        data: TransitionDataset,
        fraction: float,
        *,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        config: PruningConfig | None = None,
    ) -> FitReport:
        """Removes connections and trains what is left; leaves the model as it was where that fails."""
        ...


class PrunableAlgorithm(SavableAlgorithm):
    """What ModelLearningAgent does to make its model smaller."""

    def prune(self, fraction: float, *, progress_bar: bool = False, config: PruningConfig | None = None) -> Self:
        """Removes the smallest weights of the model's networks, trains what is left on the transitions met, and plans on with it.

        Each network loses this share of its connections, and those left over that the transitions do not call for; the goal
        stays. Pruned again, the agent goes on from what is left. ``learn`` fits anew, with all connections.

        Args:
            fraction: least share of the connections that are gone afterwards, 0 or more and less than 1.
            progress_bar: shows one.
            config: how, see PruningConfig; ``PruningConfig(evidence=False)`` removes this share and no more.

        Raises:
            ValueError: a fraction out of range, nothing learned yet, or no transitions to train on (after ``load``).
            TypeError: the model has no weights. The agent is as it was in each of these cases, as after any other error.
        """
        agent = cast("ModelLearningAgent", self)
        fraction, model = check_fraction(fraction), prunable(agent.model)
        if not agent.policy.fitted:
            raise ValueError("There is nothing to prune yet: call learn() first.")
        if not len(agent.experience.dataset):
            raise ValueError(
                "prune() trains what is left on the transitions met, and this agent has none: give it some with "
                "load_transitions(path), or save agents with include=['transitions']."
            )
        with agent.policy.lock, fit_progress(progress_bar) as progress:
            report = model.prune(agent.transitions, fraction, seed=agent._planning_seed, progress=progress, config=config)
            agent._n_updates += 1
            agent.fit_report = report
            agent._refresh()
        if hasattr(agent, "_logger"):  # a loaded agent has none before it learns
            log_fit(agent.logger, report, agent._n_updates, len(agent.transitions), len(agent.policy.start_states))
        return self


def prunable(model: TransitionModel) -> PrunableModel:
    """The model, if it can be pruned.

    Raises:
        TypeError: it has no weights; the message says what to do.
    """
    if isinstance(model, PrunableModel):
        return model
    raise TypeError(
        f"This agent's model, {type(model).__name__}, has no connections to prune: decision graphs and tables hold only what the "
        "data called for. Learn with model='networks' or model='paper' to prune networks."
    )
