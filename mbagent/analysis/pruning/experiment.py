"""Learns a game on flat variables, prunes to one share after another, and measures what is left."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

import mbagent
from mbagent.analysis.cases import Case, Scale, find_case, game_of, measure_scale, play
from mbagent.analysis.planning_benchmark.sampling import EVERYTHING, microseconds, using
from mbagent.analysis.pruning.truth import Agreement, agreement
from mbagent.models.config import NeuralConfig
from mbagent.models.modules import Influence, dependent_groups, influence, modules
from mbagent.models.neural import NeuralTransitionModel
from mbagent.models.simulator import SimulatorModel
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent_envs.random_keys import derive

Networks = Literal["causal", "paper"]
"""The default networks, or the paper's own: both on flat variables."""

GAMES = ("flier_catcher", "geyser_high_cost", "maneuverer")
FRACTIONS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        games: keys of ``cases``.
        fractions: shares of the connections to remove.
        networks: see Networks.
        timesteps: steps of random play to learn from.
        seeds: number of repetitions.
        first_seed: seed of the first.
        episodes: for each agent, the same for all shares; 0: none are played.

    Raises:
        ValueError: a setting is out of range.
    """

    games: tuple[str, ...] = GAMES[:1]
    fractions: tuple[float, ...] = FRACTIONS
    networks: Networks = "causal"
    timesteps: int = 20_000
    seeds: int = 1
    first_seed: int = 1000
    episodes: int = 10

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for key in self.games:
            if game_of(find_case(key)) is None:
                raise ValueError(f"{key} is none of this package's games, which have exact rules to compare with.")
        if not self.fractions or not all(0.0 <= fraction < 1.0 for fraction in self.fractions):
            raise ValueError(f"Shares of connections to remove are numbers from 0 up to but not 1, got {list(self.fractions)}.")
        for name, least in (("timesteps", 100), ("seeds", 1), ("episodes", 0), ("first_seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}.")


@dataclass(frozen=True)
class Row:
    """One agent, pruned to one share.

    Attributes:
        game, seed, fraction: which.
        connections: that are left.
        returned: normalised return; nan where none was played.
        log_likelihood: excess nats a transition over the true model's, on play that was not learned from; nan where the true
            one has none.
        marginal: total variation of single variables from the true ones, mean over variables and inputs.
        full: microseconds of processor time of a sampled next state, every variable asked of the conditioner.
        short: the same as ``sample`` does it, without what the predictor is sure of.
        parents: state variables that lead to a variable, mean.
        precision, recall: of the connections from state to next state that are left; nan where the truth is not written down.
        conditions_precision, conditions_recall: of those between next variables.
        seconds: of pruning and training.
    """

    game: str
    seed: int
    fraction: float
    connections: int
    returned: float
    log_likelihood: float
    marginal: float
    full: float
    short: float
    parents: float
    precision: float
    recall: float
    conditions_precision: float
    conditions_recall: float
    seconds: float


@dataclass(frozen=True)
class Task:
    """One game with one seed."""

    game: str
    seed: int
    settings: Settings


@dataclass(frozen=True)
class Outcome:
    """What a task found.

    Attributes:
        task: which.
        names: of the state variables.
        actions: names of the actions.
        rows: one for each share.
        influences: by share.
        modules, groups: a line for each module and each group of dependent variables, by share.
    """

    task: Task
    names: tuple[str, ...]
    actions: tuple[str, ...]
    rows: list[Row]
    influences: dict[float, Influence]
    modules: dict[float, list[str]]
    groups: dict[float, list[str]]


def plan(settings: Settings) -> list[Task]:
    """All tasks."""
    seeds = range(settings.first_seed, settings.first_seed + settings.seeds)
    return [Task(game, seed, settings) for seed in seeds for game in settings.games]


def run_task(task: Task) -> Outcome:
    """Learns once, and prunes the same learned agent to each share."""
    case = find_case(task.game)
    env, settings = case.make_env(), task.settings
    space, n_actions = FactoredSpace(env.observation_space), ActionEnumeration(env.action_space).n
    config = NeuralConfig() if settings.networks == "causal" else NeuralConfig.paper(len(space))
    model = NeuralTransitionModel(space.cardinalities, n_actions, config)
    agent = mbagent.ModelLearningAgent("MctsPolicy", env, model=model, seed=task.seed)
    agent.learn(settings.timesteps, log_interval=None)
    learned, scale = agent.get_parameters(), measure_scale(case) if settings.episodes else Scale(0.0, 1.0)
    game = game_of(case)
    assert game is not None
    outcome = Outcome(task, tuple(space.names), game.action_names, [], {}, {}, {})
    for fraction in settings.fractions:
        agent.set_parameters(learned)
        if fraction > 0.0:
            agent.prune(fraction)
        found = influence(model)
        outcome.rows.append(measure(task, case, scale, agent, model, fraction, agreement(game, found)))
        outcome.influences[fraction] = found
        outcome.modules[fraction] = [module.text(space.names) for module in modules(found)]
        outcome.groups[fraction] = [module.text(space.names) for module in dependent_groups(found)]
    return outcome


def measure(
    task: Task,
    case: Case,
    scale: Scale,
    agent: mbagent.ModelLearningAgent,
    model: NeuralTransitionModel,
    fraction: float,
    dependencies: Agreement,
) -> Row:
    """Everything about one pruned agent."""
    settings, returned, report = task.settings, float("nan"), agent.fit_report
    if settings.episodes:
        policy = lambda obs: agent.predict(obs, deterministic=True)[0]  # noqa: E731
        returns = play(case, policy, episodes=settings.episodes, seed=task.seed, repeatable=True).default
        returned = float((returns.mean() - scale.random) / (scale.reference - scale.random))
    states, actions, following = unseen_play(case, task.seed)
    keys = derive(task.seed, np.arange(1024))
    call = partial(model.sample, states[:1024], actions[:1024], keys)
    with using(model, EVERYTHING, model.config.sweeps):
        full = microseconds(call, 1024)
    return Row(
        task.game,
        task.seed,
        fraction,
        sum(part.left for part in model.connections().values()),
        returned,
        excess(case, model, states, actions, following),
        marginal_error(case, model, states[:300], actions[:300]),
        full,
        microseconds(call, 1024),
        *dependencies,
        report.seconds if report is not None else float("nan"),
    )


def unseen_play(case: Case, seed: int, n: int = 2000) -> tuple[Any, Any, Any]:
    """States, actions and next states int64 of random play that no agent learns from."""
    game, rng = game_of(case), np.random.default_rng([seed, 77])
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
    """Nats a transition that the model loses on the true distribution; nan where either has no exact probabilities."""
    game, alive = game_of(case), np.zeros(len(states), dtype=np.bool_)
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
    """Total variation of single variables between draws of the model and of the game, mean over inputs and variables."""
    game = game_of(case)
    assert game is not None
    row = np.repeat(np.arange(len(states)), n_draws)
    means = []
    for which, one in ((1, model), (2, SimulatorModel(game))):
        drawn, _ = one.sample(states[row], actions[row], derive(which, np.arange(len(row))))
        means.append(drawn.reshape(len(states), n_draws, -1).mean(axis=1))
    return float(np.abs(means[0] - means[1]).mean())
