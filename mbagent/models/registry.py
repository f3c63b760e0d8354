"""Registry of models: names that create a model suited to the structure of the space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from mbagent.models.base import BaseTransitionModel
from mbagent.models.dbn import DecisionGraphModel, PlaneGraphModel, channel_cardinalities
from mbagent.models.neural.forecasts import DirectForecastModel, longest_string
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.networks import PlanePredictor, PlaneStringPredictor
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from mbagent.models.protocol import TransitionModel
from mbagent.models.tabular import TabularModel
from mbagent.spaces import FactoredSpace

ModelFactory = Callable[[FactoredSpace, int, float], TransitionModel]
"""``factory(space, n_actions, learning_rate) -> model``."""

PLANE_TRAINING = TrainingConfig(batch_size=128, weight_decay=1e-3, epochs=40.0, min_steps=1500, max_steps=4000)
"""Shared weights are trained on every position of every row, so small batches suffice; but planning finds and exploits model
errors, so training is long."""


STRING_STEPS = 2000
"""Maximum number of gradient steps for action sequences on planes, where each step needs as many layers as there are actions."""

DIRECT_STEPS = tuple(range(2, 16))
"""Numbers of steps for which the model "direct" learns a network each."""


def build_networks(space: FactoredSpace, n_actions: int, learning_rate: float) -> BaseTransitionModel:
    """Networks: weights shared over positions if observations are stacks of planes, else predictor and causal conditioner."""
    planes = space.planes
    if planes is None:
        training = replace(TrainingConfig(), learning_rate=learning_rate)
        return NeuralTransitionModel(space.cardinalities, n_actions, NeuralConfig(training=training))
    config = NeuralConfig(conditioner=None, training=replace(PLANE_TRAINING, learning_rate=learning_rate))
    return NeuralTransitionModel(
        space.cardinalities,
        n_actions,
        config,
        body=lambda codec, generator: PlanePredictor(codec, planes, generator=generator),
    )


def build_string(space: FactoredSpace, n_actions: int, learning_rate: float, n_steps: int) -> NeuralTransitionModel:
    """A model of the state after ``n_steps`` steps whose action sequence is treated as one action (paper 4.2)."""
    planes, cards = space.planes, space.cardinalities
    if planes is None:
        config = NeuralConfig(training=replace(TrainingConfig(), learning_rate=learning_rate))
        return NeuralTransitionModel(cards, n_actions, config, n_steps=n_steps)
    training = replace(PLANE_TRAINING, learning_rate=learning_rate, max_steps=STRING_STEPS)
    config = NeuralConfig(conditioner=None, training=training)
    return NeuralTransitionModel(
        cards,
        n_actions,
        config,
        body=lambda codec, generator: PlaneStringPredictor(codec, planes, generator=generator),
        n_steps=n_steps,
    )


def build_direct(
    space: FactoredSpace, n_actions: int, learning_rate: float, steps: Sequence[int] | None = None
) -> DirectForecastModel:
    """The model of ``build_networks``, and a further model for each step count in ``steps``.

    Default: those of ``DIRECT_STEPS`` whose action sequences can be enumerated.
    """
    if steps is None:
        steps = [n for n in DIRECT_STEPS if n <= longest_string(n_actions)]
    return DirectForecastModel(
        build_networks(space, n_actions, learning_rate),
        lambda n_steps: build_string(space, n_actions, learning_rate, n_steps),
        tuple(steps),
    )


def build_paper(space: FactoredSpace, n_actions: int, learning_rate: float) -> TransitionModel:
    """The two networks of the paper's section 3, unchanged, on flat variables."""
    config = NeuralConfig.paper(len(space))
    return NeuralTransitionModel(
        space.cardinalities,
        n_actions,
        replace(config, training=replace(config.training, learning_rate=learning_rate)),
    )


def build_tabular(space: FactoredSpace, n_actions: int, learning_rate: float) -> TransitionModel:
    """Count model of the observed transitions, without generalisation to unseen states."""
    del learning_rate
    return TabularModel(space.cardinalities, n_actions)


def build_graphs(
    space: FactoredSpace, n_actions: int, learning_rate: float, parts: Sequence[int] | None = None
) -> TransitionModel:
    """Decision graphs over each variable's few parents; on planes, parameters are tied over positions if that is better."""
    del learning_rate
    if space.planes is not None and channel_cardinalities(space) is not None:
        return PlaneGraphModel(space, n_actions, parts=parts)
    return DecisionGraphModel(space.cardinalities, n_actions, parts=parts)


_FACTORIES: dict[str, ModelFactory] = {
    "auto": build_graphs,
    "graphs": build_graphs,
    "networks": build_networks,
    "paper": build_paper,
    "tabular": build_tabular,
    "direct": build_direct,
}


def register_model(name: str, factory: ModelFactory) -> None:
    """Registers a model of your own as ``model=name``, so that agents with it can be saved and loaded.

    Raises:
        ValueError: the name is in use.
    """
    if name in _FACTORIES and _FACTORIES[name] is not factory:
        raise ValueError(f"A model called {name!r} is already registered; choose another name.")
    _FACTORIES[name] = factory


def build_model(
    name: str, space: FactoredSpace, n_actions: int, learning_rate: float, parts: Sequence[int] | None = None
) -> TransitionModel:
    """The model registered as ``name``.

    Args:
        name: of the model.
        space: of observations.
        n_actions: number of enumerated actions A.
        learning_rate: of models that have one.
        parts: number of values of each action component, for models that use them (decision graphs); None: no components.

    Raises:
        ValueError: no model has this name.
    """
    if name not in _FACTORIES:
        raise ValueError(f"There is no model called {name!r}; choose one of {sorted(_FACTORIES)} or pass a TransitionModel.")
    factory = _FACTORIES[name]
    return (
        build_graphs(space, n_actions, learning_rate, parts)
        if factory is build_graphs
        else factory(space, n_actions, learning_rate)
    )
