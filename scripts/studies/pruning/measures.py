"""Accuracy of a learned model, and the cost of a sampled next state."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from mbagent.models.neural.model import NeuralTransitionModel, PrunedAs
from mbagent.models.neural.training import NeuralConfig
from mbagent.models.simulator import SimulatorModel
from mbagent_envs.random_keys import derive
from studies.planning.sampling import EVERYTHING, microseconds, using
from worlds.games import Case
from worlds.synthetic_dbn import random_data, random_inputs, trained

ROWS = 1024
"""Batch size for timing."""

CONDITIONED, PAPER = "every variable conditioned", "the paper's networks, 5 sweeps"
"""Other networks for the same game that are timed for comparison."""


class Speeds(NamedTuple):
    """Microseconds of processor time per sampled next state.

    Attributes:
        full: with whole matrices, where every variable with a group in the conditioner is sampled from it.
        matrices: with whole matrices, without the variables of which the predictor is certain.
        used: as the model is actually sampled: with tables, if no variable has too many parents for one.
        variation: upper bound of the total variation between ``used`` and ``matrices``: 95% limit of the share of samples that
            differ with the same random numbers.
    """

    full: float
    matrices: float
    used: float
    variation: float


def measure_speeds(model: NeuralTransitionModel, states: Any, actions: Any, seed: int) -> Speeds:
    """Speeds of a model on states int64 [B, F] and actions int64 [B]."""
    keys, few = derive(seed, np.arange(len(states))), slice(0, ROWS)

    def timed(certain: float, pruned_as: PrunedAs) -> float:
        with using(model, certain, model.config.sweeps, pruned_as):
            return microseconds(partial(model.sample, states[few], actions[few], keys[few]), len(states[few]))

    drawn = []
    for pruned_as in ("matrices", "tables"):
        with using(model, model.config.certain, model.config.sweeps, pruned_as):
            drawn.append(np.column_stack(model.sample(states, actions, keys)))
    differ, certain = int((drawn[0] != drawn[1]).any(axis=1).sum()), model.config.certain
    limit = stats.beta.ppf(0.95, differ + 1, len(states) - differ)  # Clopper and Pearson
    return Speeds(
        timed(EVERYTHING, "matrices"),
        timed(certain, "matrices"),
        timed(certain, "tables"),
        float(limit) if model.rules() is not None else 0.0,
    )


def measure_others(model: NeuralTransitionModel, states: Any, actions: Any, seed: int) -> dict[str, float]:
    """Cost of a next state for networks that condition every variable, as the paper's do; with random weights."""
    keys, found = derive(seed, np.arange(ROWS)), {}
    for name, config in ((CONDITIONED, NeuralConfig()), (PAPER, NeuralConfig.paper(len(model.cardinalities)))):
        other = NeuralTransitionModel(model.cardinalities, model.n_actions, config, seed=seed)
        with using(other, EVERYTHING, config.sweeps):
            found[name] = microseconds(partial(other.sample, states[:ROWS], actions[:ROWS], keys), ROWS)
    return found


class SizeRow(NamedTuple):
    """A synthetic DBN of d bits, few of which are ever random, learned and pruned.

    Attributes:
        d, seed: identification.
        connections: remaining connections.
        whole: microseconds per next state before pruning.
        pruned: the same after pruning.
    """

    d: int
    seed: int
    connections: int
    whole: float
    pruned: float


def measure_size(d: int, seed: int, fraction: float = 0.9) -> SizeRow:
    """Learns, prunes and times a synthetic DBN of d bits."""
    model, data = trained("networks", d, seed), random_data(d, 6000, seed)
    states, actions = random_inputs(d, ROWS, np.random.default_rng([seed, d, 2]))
    call = partial(model.sample, states, actions, derive(seed, np.arange(ROWS)))
    whole = microseconds(call, ROWS)
    model.prune(data, fraction, seed=seed)
    return SizeRow(d, seed, sum(part.left for part in model.connections().values()), whole, microseconds(call, ROWS))


def unseen_play(case: Case, seed: int, n: int = 2000) -> tuple[Any, Any, Any]:
    """States, actions and next states int64 of random play that is not used for learning."""
    game, rng = case.game, np.random.default_rng([seed, 77])
    assert game is not None
    obs, rows = game.initial(derive(seed, np.arange(n // 100), 7)), []
    for step in range(100):
        actions = rng.integers(len(game.action_names), size=len(obs))
        after = game.transition(obs, actions, derive(seed, np.arange(len(obs)), 8, step))
        rows.append((obs.reshape(len(obs), -1), actions, after.reshape(len(obs), -1)))
        obs = after
    states, taken, following = (np.concatenate(part).astype(np.int64) for part in zip(*rows, strict=True))
    return states, taken, following


def excess(case: Case, model: NeuralTransitionModel, states: Any, actions: Any, following: Any) -> float:
    """Loss of the model in nats per transition relative to the true one; nan if either has no exact probabilities."""
    game, alive = case.game, np.zeros(len(states), dtype=np.bool_)
    assert game is not None
    try:
        ours = model.log_prob(states, actions, following, alive)
        obs = states.reshape(-1, *game.observation_space.shape).astype(np.int8)
        outcomes, chances = game.transition_distributions(obs, actions)
    except NotImplementedError:
        return float("nan")
    same = (outcomes.reshape(*chances.shape, -1) == following[:, None]).all(axis=2)
    return float((np.log((chances * same).sum(axis=1)) - ours).mean())


def marginal_error(case: Case, model: NeuralTransitionModel, states: Any, actions: Any, n_draws: int = 200) -> float:
    """Total variation of single variables between samples of the model and of the game, mean over inputs and variables."""
    game = case.game
    assert game is not None
    row = np.repeat(np.arange(len(states)), n_draws)
    means = []
    for which, one in ((1, model), (2, SimulatorModel(game))):
        drawn, _ = one.sample(states[row], actions[row], derive(which, np.arange(len(row))))
        means.append(drawn.reshape(len(states), n_draws, -1).mean(axis=1))
    return float(np.abs(means[0] - means[1]).mean())
