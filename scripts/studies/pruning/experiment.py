"""Learns a game on flat variables, prunes to increasing shares, and measures the pruned networks."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Literal, TypeAlias

import numpy as np

import mbagent
from harness import Result, check_at_least
from mbagent.models.neural.connections import PruningConfig
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.pruning import Influence, dependent_groups, influence, modules
from mbagent.models.neural.training import NeuralConfig
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.types import Floats
from studies.pruning.measures import excess, marginal_error, measure_others, measure_speeds, unseen_play
from studies.pruning.truth import agreement
from worlds.games import Case, find_case, play
from worlds.known_rules import Scale, scale_of

Networks: TypeAlias = Literal["causal", "paper"]
"""The default networks or the paper's own, both on flat variables."""

Way: TypeAlias = Literal["by size", "by evidence"]
"""Remove the smallest weights only, as in the paper, or also those that the transitions do not support (the default)."""

Key: TypeAlias = tuple[float, Way]
"""Share of the connections to remove, and the method."""

GAMES = ("flier_catcher", "geyser_high_cost", "maneuverer")
FRACTIONS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)


@dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        games: keys of ``cases``.
        fractions: shares of the connections to remove.
        ways: pruning methods, see Way.
        networks: see Networks.
        timesteps: steps of random play to learn from.
        seeds: number of repetitions.
        first_seed: seed of the first repetition.
        episodes: episodes for each agent, the same for all shares; 0 for none.

    Raises:
        ValueError: a setting is out of range.
    """

    games: tuple[str, ...] = GAMES[:1]
    fractions: tuple[float, ...] = FRACTIONS
    ways: tuple[Way, ...] = ("by size", "by evidence")
    networks: Networks = "causal"
    timesteps: int = 20_000
    seeds: int = 1
    first_seed: int = 1000
    episodes: int = 10

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for key in self.games:
            if find_case(key).game is None:
                raise ValueError(f"{key} is none of this package's games, which have exact rules to compare with.")
        if not self.fractions or not all(0.0 <= fraction < 1.0 for fraction in self.fractions):
            raise ValueError(f"Shares of connections to remove are numbers from 0 up to but not 1, got {list(self.fractions)}.")
        if not self.ways:
            raise ValueError("Name at least one way to prune: 'by size' or 'by evidence'.")
        check_at_least(self, timesteps=100, seeds=1, episodes=0, first_seed=0)


@dataclass(frozen=True)
class Row:
    """One agent, pruned to one share by one method.

    Attributes:
        game, seed, fraction, way: identification; the share 0 stands for the agent before pruning.
        connections: remaining connections.
        gone: share of the removed connections.
        returned: normalised return; nan if no episodes were played.
        log_likelihood: loss in nats per transition relative to the true model, on unseen play; nan if the true model has no
            exact probabilities.
        marginal: total variation of single variables from the true ones, mean over variables and inputs.
        full, matrices, used, variation: see ``measures.Speeds``.
        parents: mean number of parents of a variable; before pruning, all variables connected to it by a path.
        precision, recall: precision and recall of the parents; nan if the true ones are not known.
        conditions_precision, conditions_recall: the same for dependencies between next variables.
        modules: share of the true modules, and groups of dependent variables, that are found exactly.
        seconds: time of pruning and training.
    """

    game: str
    seed: int
    fraction: float
    way: Way
    connections: int
    gone: float
    returned: float
    log_likelihood: float
    marginal: float
    full: float
    matrices: float
    used: float
    variation: float
    parents: float
    precision: float
    recall: float
    conditions_precision: float
    conditions_recall: float
    modules: float
    seconds: float


@dataclass(frozen=True)
class Cell:
    """One game with one seed."""

    game: str
    seed: int
    settings: Settings


@dataclass(frozen=True)
class Outcome:
    """Results of a cell.

    Attributes:
        cell: the cell.
        names: names of the state variables.
        actions: names of the actions.
        rows: one for each share and method.
        returns: normalised return of each episode, with the same episodes for each share and method.
        influences: sums over all paths.
        linked: sums over the paths with an effect.
        modules, groups: a line for each module and each group of dependent variables.
        others: microseconds per next state for other networks, see ``measures.measure_others``.
    """

    cell: Cell
    names: tuple[str, ...]
    actions: tuple[str, ...]
    rows: list[Row] = field(default_factory=list)
    returns: dict[Key, Floats] = field(default_factory=dict)
    influences: dict[Key, Influence] = field(default_factory=dict)
    linked: dict[Key, Influence] = field(default_factory=dict)
    modules: dict[Key, list[str]] = field(default_factory=dict)
    groups: dict[Key, list[str]] = field(default_factory=dict)
    others: dict[str, float] = field(default_factory=dict)


def cells(settings: Settings) -> list[Cell]:
    """All cells."""
    seeds = range(settings.first_seed, settings.first_seed + settings.seeds)
    return [Cell(game, seed, settings) for seed in seeds for game in settings.games]


def run_cell(cell: Cell) -> Result[Cell]:
    """Learns once, and prunes the same learned agent to each share with each method; ``arrays["outcome"]`` is the ``Outcome``."""
    case = find_case(cell.game)
    env, settings = case.make_env(), cell.settings
    space, n_actions = FactoredSpace(env.observation_space), ActionEnumeration(env.action_space).n
    config = NeuralConfig() if settings.networks == "causal" else NeuralConfig.paper(len(space))
    model = NeuralTransitionModel(space.cardinalities, n_actions, config)
    agent = mbagent.ModelLearningAgent("MctsPolicy", env, model=model, seed=cell.seed)
    agent.learn(settings.timesteps, log_interval=None)
    learned, scale = agent.get_parameters(), scale_of(case.world) if settings.episodes else Scale(0.0, 1.0)
    game = case.game
    assert game is not None
    outcome = Outcome(cell, tuple(space.names), game.action_names)
    outcome.others.update(measure_others(model, *unseen_play(case, cell.seed)[:2], cell.seed))
    for fraction in settings.fractions:
        for way in settings.ways if fraction > 0.0 else settings.ways[:1]:
            agent.set_parameters(learned)
            if fraction > 0.0:
                agent.prune(fraction, config=PruningConfig(evidence=way == "by evidence"))
            _measure((fraction, way), case, scale, agent, model, outcome)
    rows = [asdict(row) for row in outcome.rows]
    return Result(cell, {"results": rows}, f"{cell.game}, seed {cell.seed}", {"outcome": outcome})


def _measure(
    key: Key, case: Case, scale: Scale, agent: mbagent.ModelLearningAgent, model: NeuralTransitionModel, outcome: Outcome
) -> None:
    """Measures one pruned agent and adds the results to the outcome."""
    cell, report, found, game = outcome.cell, agent.fit_report, influence(model, effective=True), case.game
    assert game is not None
    outcome.returns[key] = _play(cell, case, scale, agent)
    states, actions, following = unseen_play(case, cell.seed)
    connections = model.connections().values()
    left, possible = sum(part.left for part in connections), sum(part.total for part in connections)
    row = Row(
        cell.game,
        cell.seed,
        *key,
        left,
        1.0 - left / possible,
        float(outcome.returns[key].mean()) if len(outcome.returns[key]) else float("nan"),
        excess(case, model, states, actions, following),
        marginal_error(case, model, states[:300], actions[:300]),
        *measure_speeds(model, np.tile(states, (10, 1)), np.tile(actions, 10), cell.seed),
        *agreement(game, found),
        report.seconds if report is not None else float("nan"),
    )
    outcome.rows.append(row)
    outcome.influences[key], outcome.linked[key] = influence(model), found
    outcome.modules[key] = [module.text(outcome.names) for module in modules(found)]
    outcome.groups[key] = [module.text(outcome.names) for module in dependent_groups(found)]


def _play(cell: Cell, case: Case, scale: Scale, agent: mbagent.ModelLearningAgent) -> Floats:
    """Normalised returns of the episodes, which are the same for all agents."""
    episodes = cell.settings.episodes
    if not episodes:
        return np.zeros(0)
    policy = lambda obs: agent.predict(obs, deterministic=True)[0]  # noqa: E731
    returns = play(case, policy, episodes=episodes, seed=cell.seed, repeatable=True).default
    normal: Floats = (returns - scale.random) / (scale.reference - scale.random)
    return normal
