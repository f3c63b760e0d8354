"""Learns worlds from random play and measures predictions on new random play."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from gymnasium.spaces import MultiBinary

from harness import Result, Row, check_at_least, check_known, grouped
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.protocol import TransitionModel
from mbagent.models.registry import build_model
from mbagent.models.simulator import SimulatorModel
from mbagent.spaces import FactoredSpace
from mbagent.types import Bools, Floats, States
from mbagent_envs import FlierCatcher, Game, GeyserRunner, Maneuverer
from mbagent_envs.random_keys import derive
from studies.model_accuracy import bayesnet
from worlds.board_games import PushedBox, Switch, TwoPlayers

NAN = float("nan")

EPISODE = 100
"""Number of steps of an episode of random play."""

MOST_UNCERTAIN = 0.25
"""Transitions with a larger share of random factors, such as new layouts, are excluded from the exactness measure."""

SECOND_DRAWS = 64
"""Number of true samples that must agree on a factor for it to count as certain, in worlds that do not list successors."""

LEARNING_RATE = 0.02


@dataclass(frozen=True)
class Case:
    """A world and its representation.

    Attributes:
        name: its name.
        game: creates it.
        flat: whether its bits are observed as one row in a random order, without information on neighbours.
    """

    name: str
    game: Callable[[], Game]
    flat: bool = True


CASES: tuple[Case, ...] = (
    Case("GeyserRunner, stochastic", GeyserRunner),
    Case("GeyserRunner, deterministic", lambda: GeyserRunner(mode="deterministic")),
    Case("Maneuverer, planes", Maneuverer, flat=False),
    Case("Maneuverer, flat", Maneuverer),
    Case("FlierCatcher, planes", FlierCatcher, flat=False),
    Case("FlierCatcher, flat", FlierCatcher),
    Case("two players, flat", TwoPlayers),
    Case("pushed box, flat", PushedBox),
    Case("switch, flat", Switch),
)


@dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        cases: names of the worlds.
        models: names of the models.
        steps: numbers of steps to learn from.
        seeds: repetitions.
        first_seed: seed of the first repetition.
        n_tests: number of test transitions.

    Raises:
        ValueError: a setting is out of range.
    """

    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    models: tuple[str, ...] = ("graphs", "networks")
    steps: tuple[int, ...] = (2000, 5000, 20_000)
    seeds: int = 5
    first_seed: int = 1000
    n_tests: int = 100_000

    def __post_init__(self) -> None:
        """Checks the ranges."""
        names = [case.name for case in CASES]
        check_known("case", self.cases, names)
        if not self.models:
            raise ValueError("There is nothing to measure: name at least one model.")
        if "bayesnet" in self.models:
            if importlib.util.find_spec("pyagrum") is None:
                raise ValueError('The baseline bayesnet needs pyAgrum: pip install "mbagent[yardsticks]".')
            bayesnet.register()
        for name in self.models:
            build_model(name, FactoredSpace(MultiBinary(1)), 1, LEARNING_RATE)  # refuses unknown names before the work starts
        if not self.steps or min(self.steps) < EPISODE:
            raise ValueError(f"Steps to learn from must be {EPISODE} or more, got {list(self.steps)}.")
        check_at_least(self, seeds=1, first_seed=0, n_tests=EPISODE)


@dataclass(frozen=True)
class Score:
    """One model on one world, with one seed.

    Attributes:
        case, model, seed, steps: identification.
        likeliest: share of the included transitions whose most likely next state agrees with the observed one in all certain
            factors; NaN if none is included.
        sampled: the same for a sampled next state.
        joint: exact total variation of the joint distribution of next states; NaN if the world does not list it or the
            model has no probabilities.
        log_likelihood: mean log-probability of the observed transitions, nats; impossible ones count as -200.
        fit_seconds: processor time of the fit.
        sample_microseconds: processor time per sampled next state, in a large batch.
    """

    case: str
    model: str
    seed: int
    steps: int
    likeliest: float
    sampled: float
    joint: float
    log_likelihood: float
    fit_seconds: float
    sample_microseconds: float


@dataclass(frozen=True)
class Cell:
    """One world with one seed and one number of steps, for all models."""

    case: Case
    seed: int
    steps: int
    settings: Settings


def cells(settings: Settings) -> list[Cell]:
    """All cells, largest first."""
    chosen = [case for case in CASES if case.name in settings.cases]
    found = [
        Cell(case, settings.first_seed + i, steps, settings)
        for steps in dict.fromkeys(settings.steps)
        for case in chosen
        for i in range(settings.seeds)
    ]
    return sorted(found, key=lambda cell: (cell.case.flat, -cell.steps))


def random_play(game: Game, n_steps: int, seed: int, order: States) -> TransitionBatch:
    """Transitions of consecutive episodes of random play, with the bits in the given order."""
    true, n_episodes = SimulatorModel(game), -(-n_steps // EPISODE)
    rng, states, parts = np.random.default_rng(seed), true.start_states(n_episodes, seed), []
    for _ in range(EPISODE):
        actions = rng.integers(true.n_actions, size=n_episodes)
        following, ends = true.sample(states, actions, rng)
        parts.append((states, actions, following, ends))
        states = following
    states, actions, following, ends = (
        np.stack(column, axis=1).reshape(n_episodes * EPISODE, -1) for column in zip(*parts, strict=True)
    )
    episodes = np.repeat(np.arange(n_episodes), EPISODE)
    rows = TransitionBatch(states[:, order], actions[:, 0], following[:, order], ends[:, 0], np.zeros(len(states)), episodes)
    return rows.select(np.arange(n_steps))


def run_cell(cell: Cell) -> Result[Cell]:
    """Learns and measures; the rows are those of ``Score``."""
    if "bayesnet" in cell.settings.models:
        bayesnet.register()
    torch.set_num_threads(1)
    game, seed = cell.case.game(), cell.seed
    true, space = SimulatorModel(game), FactoredSpace(game.observation_space)
    order = np.arange(len(space))
    if cell.case.flat:
        order, space = np.random.default_rng(seed).permutation(len(space)), FactoredSpace(MultiBinary(len(space)))
    data = TransitionDataset(space.cardinalities, true.n_actions)
    data.append(random_play(game, cell.steps, seed, order))
    tests = random_play(game, cell.settings.n_tests, seed + 10_000, order)
    certain = certain_factors(true, tests, order, seed)
    scores = []
    for name in cell.settings.models:
        model = build_model(name, space, true.n_actions, LEARNING_RATE)
        began = time.process_time()
        model.fit(data, seed=seed)
        seconds = time.process_time() - began
        scores.append(replace(_score(model, true, tests, certain, order), fit_seconds=seconds, case=cell.case.name, model=name))
    rows = [asdict(replace(score, seed=seed, steps=cell.steps)) for score in scores]
    return Result(cell, {"results": rows}, f"{cell.case.name}, {cell.steps} steps, seed {cell.seed}")


def certain_factors(true: SimulatorModel, rows: TransitionBatch, order: States, seed: int) -> Bools:
    """Whether each factor of a transition's outcome is not random, bool [N, F]; all False if too many are random."""
    back = np.argsort(order)
    certain = np.ones(rows.states.shape, dtype=np.bool_)
    if true.lists:
        for begin in range(0, len(rows), 10_000):
            part = rows.select(np.arange(begin, min(begin + 10_000, len(rows))))
            listed = true.successors(part.states[:, back], part.actions, 10_000, 0)
            other = listed.states[:, order] != part.next_states[listed.rows]
            certain[begin : begin + 10_000] = ~np.logical_or.reduceat(other, listed.offsets[:-1], axis=0)
    else:
        for draw in range(SECOND_DRAWS):
            again, _ = true.sample(rows.states[:, back], rows.actions, derive(seed, draw, np.arange(len(rows))))
            certain &= again[:, order] == rows.next_states
    certain[(~certain).mean(axis=1) > MOST_UNCERTAIN] = False
    return certain


def _score(model: TransitionModel, true: SimulatorModel, rows: TransitionBatch, certain: Bools, order: States) -> Score:
    judged = certain.any(axis=1)
    began = time.process_time()
    drawn, _ = model.sample(rows.states, rows.actions, derive(1, np.arange(len(rows))))
    each = 1e6 * (time.process_time() - began) / len(rows)
    hit, right = (
        float(((found == rows.next_states) | ~certain).all(axis=1)[judged].mean()) if judged.any() else NAN
        for found in (drawn, likeliest_states(model, rows))
    )
    logs = np.maximum(model.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated), -200.0).mean()
    joint = joint_variation(model, true, rows, order)
    return Score("", "", 0, 0, right, hit, joint, float(logs), NAN, each)


def likeliest_states(model: TransitionModel, rows: TransitionBatch, chunk: int = 10_000) -> States:
    """Most likely value of each factor, int64 [N, F]."""
    starts = np.concatenate([[0], np.cumsum(model.cardinalities)])[:-1]
    parts = []
    for begin in range(0, len(rows), chunk):
        probs = model.marginals(rows.states[begin : begin + chunk], rows.actions[begin : begin + chunk])
        columns = [probs[:, s : s + c].argmax(axis=1) for s, c in zip(starts, model.cardinalities, strict=True)]
        parts.append(np.stack(columns, axis=1))
    return np.concatenate(parts)


def joint_variation(
    model: TransitionModel, true: SimulatorModel, rows: TransitionBatch, order: States, most: int = 2000
) -> float:
    """Total variation of the joint distribution of next states, mean over the first transitions; NaN if not listed."""
    back, few = np.argsort(order), rows.select(np.arange(min(most, len(rows))))
    if not true.lists:
        return NAN
    listed = true.successors(few.states[:, back], few.actions, 10_000, 0)
    which = listed.rows
    logs = model.log_prob(few.states[which], few.actions[which], listed.states[:, order], listed.terminated)
    q: Floats = np.exp(logs)
    missing = 1.0 - np.bincount(which, weights=q, minlength=len(few))
    apart = np.bincount(which, weights=np.abs(q - listed.probabilities), minlength=len(few))
    return float((0.5 * (apart + missing)).mean())


def means(scores: Sequence[Row]) -> dict[tuple[str, str, int], dict[str, float]]:
    """Means over seeds of each measure, by (case, model, steps)."""
    figures = ("likeliest", "sampled", "joint", "log_likelihood", "fit_seconds", "sample_microseconds")
    return {
        (case, model, steps): {name: float(np.mean([row[name] for row in group])) for name in figures}
        for (case, model, steps), group in grouped(scores, ("case", "model", "steps")).items()
    }
