"""Coverage of exploration and model error against environment steps, in worlds with known rules."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from exact import FiniteHorizonMDP
from harness import Result, Row, Run, grouped
from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.figures import Line, Panel, draw_panels
from mbagent.models.protocol import Successors, TransitionModel
from mbagent.spaces import FactoredSpace
from mbagent.types import Actions, States
from worlds.distractors import DistractorWorld
from worlds.known_rules import exact_world, true_model
from worlds.registry import World

MAX_PAIRS = 400
"""Number of reachable (state, action), drawn once, on which model error is measured."""

MAX_OUTCOMES = 1 << 14
"""Upper bound on the number of outcomes of a (state, action) in these worlds."""


@dataclass(frozen=True)
class Cell:
    """One exploration in one world with one seed.

    Attributes:
        world: the world; its rules must be known.
        exploration: the agent's argument.
        seed: seed of the agent and the world.
        marks: environment steps after which to measure, ascending; the model is refitted at each.
    """

    world: World | DistractorWorld
    exploration: str
    seed: int
    marks: tuple[int, ...]


def reachable(exact: FiniteHorizonMDP) -> NDArray[np.int64]:
    """Numbers of the non-terminal states that an episode can reach."""
    steps = (exact.transitions > 0).any(axis=1)
    reached = exact.start > 0
    while (more := reached | (reached @ steps)).sum() > reached.sum():
        reached = more
    return np.flatnonzero(reached)


def outcomes(world: World, exact: FiniteHorizonMDP, numbers: NDArray[np.int64], actions: Actions) -> Successors:
    """All outcomes with their true probabilities, for states [N], given by their numbers, and actions [N].

    Raises:
        ValueError: the world's rules are not known.
    """
    space = FactoredSpace(world.make().observation_space)
    states = space.encode(exact.observations)
    if world.kind == "rddl":  # no episode ends before its time limit
        rows, following = np.nonzero(exact.transitions[numbers, actions])
        offsets = np.searchsorted(rows, np.arange(len(numbers) + 1)).astype(np.int64)
        chances = exact.transitions[numbers, actions][rows, following]
        return Successors(offsets, states[following], np.zeros(len(rows), dtype=np.bool_), chances)
    known = true_model(world)
    if known is None:
        raise ValueError(f"The true rules of {world.name} are not available.")
    return known[0].successors(states[numbers], actions, MAX_OUTCOMES, 0)


def wrongness(model: TransitionModel, truth: Successors, states: States, actions: Actions) -> float:
    """Mean total variation between a model's predictions for (state, action) [N] and their true outcomes."""
    rows = truth.rows
    said = np.exp(model.log_prob(states[rows], actions[rows], truth.states, truth.terminated))
    shared = np.bincount(rows, weights=np.minimum(said, truth.probabilities), minlength=len(states))
    return float(1.0 - shared.mean())


def run_cell(cell: Cell) -> Result[Cell]:
    """Explores and fits up to each mark, with a row for each. Worlds without reward have no return.

    Raises:
        ValueError: the world's rules are not known.
    """
    agent = ModelLearningAgent("MctsPolicy", cell.world.make(), seed=cell.seed, exploration=cell.exploration)
    figures = _with_distractors(cell.world, agent) if isinstance(cell.world, DistractorWorld) else _exactly(cell.world, agent)
    rows: list[Row] = []
    for mark in cell.marks:
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a learned or missing reward
            agent.learn(mark - agent.num_timesteps, log_interval=None, reset_num_timesteps=False)
        row = {"world": cell.world.name, "exploration": cell.exploration, "seed": cell.seed, "steps": mark}
        rows.append(row | figures() | {"learn_seconds": time.process_time() - began})
    label = f"{cell.world.name}, {cell.exploration}, seed {cell.seed}: {100 * rows[-1]['tried']:.1f}% tried"
    return Result(cell, {"coverage": rows}, label)


def _exactly(world: World, agent: ModelLearningAgent) -> Callable[[], Row]:
    """Returns a function that measures an agent in a world given as tables."""
    exact = exact_world(world)
    if exact is None:
        raise ValueError(f"The true rules of {world.name} are not available.")
    n_actions, states = agent.policy.actions.n, agent.policy.factored.encode(exact.observations)
    pairs = _pairs(reachable(exact), n_actions)
    some = pairs[np.random.default_rng(0).permutation(len(pairs))[:MAX_PAIRS]]
    truth = outcomes(world, exact, some[:, 0], some[:, 1])

    def figures() -> Row:
        observed = agent.transitions.rows()
        tried = np.unique(np.column_stack([observed.before, observed.actions]), axis=0)
        span = exact.optimal_return() - exact.random_return()
        actions = agent.predict(exact.observations, deterministic=True)[0]
        return {
            "tried": len(tried) / len(pairs),
            "error": wrongness(agent.model, truth, states[some[:, 0]], some[:, 1]),
            "normalised": (exact.policy_return(agent.policy.actions.encode(actions)) - exact.random_return()) / span,
        }

    return figures


def _with_distractors(world: DistractorWorld, agent: ModelLearningAgent) -> Callable[[], Row]:
    """Returns a function that measures an agent in a world with distractors."""
    pairs = _pairs(world.known.reachable(), agent.policy.actions.n)
    some = pairs[np.random.default_rng(0).permutation(len(pairs))[:MAX_PAIRS]]

    def figures() -> Row:
        observed = agent.transitions.rows()
        error = world.wrongness(agent.model, some[:, 0], some[:, 1])
        return {"tried": world.tried(observed.states, observed.actions), "error": error, "normalised": float("nan")}

    return figures


def _pairs(numbers: NDArray[np.int64], n_actions: int) -> NDArray[np.int64]:
    """Every (state, action), int64 [N, 2]."""
    return np.stack([part.ravel() for part in np.meshgrid(numbers, np.arange(n_actions), indexing="ij")], axis=1)


def show(rows: Sequence[Row], run: Run) -> None:
    """Prints means over seeds."""
    lines = []
    for (world, steps, exploration), own in sorted(grouped(rows, ("world", "steps", "exploration")).items()):
        tried, error, value = (float(np.mean([row[name] for row in own])) for name in ("tried", "error", "normalised"))
        lines.append([world, exploration, f"{steps:,}", f"{100 * tried:.1f}%", f"{error:.4f}", f"{value:.3f}"])
    run.show("Exploration", ("world", "exploration", "steps", "tried", "model error", "normalised return"), lines)


def draw_coverage(rows: Sequence[Row]) -> bytes:
    """Plots the share of tried pairs and model error against steps: a column per world, a line per seed. Returns a PNG."""
    worlds, kinds = grouped(rows, ("world",)), list(grouped(rows, ("exploration",)))
    panels = []
    for figure, label in (("tried", "share of (state, action) tried"), ("error", "model error (total variation)")):
        for number, ((world,), mine) in enumerate(worlds.items()):
            lines = [
                Line([row["steps"] for row in own], [row[figure] for row in own], f"C{kinds.index((kind,))}", kind, marker=".")
                for (kind, _), own in sorted(grouped(mine, ("exploration", "seed")).items())
            ]
            first, x_label = figure == "tried", "" if figure == "tried" else "environment steps"
            panels.append(Panel(world if first else "", lines, x_label, "" if number else label, "log", y_limits=(0.0, None)))
    return draw_panels(panels, size=(2.6, 2.5), columns=len(worlds), legend="below")
