"""Fitted value iteration for MDPs too large to solve: values linear in active features and in pairs of them.

States come from simulated play: random at first, then greedy with respect to the values fitted so far, except for a share of
random actions. Backups through the model's successors alternate with kernel ridge regression (Gordon 1995; for sums of functions
of few factors, Guestrin, Koller, Parr and Venkataraman 2003). The values apply to one reward function and are dropped with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbagent.models.mdp import GraphArrays, StateGraph
from mbagent.models.protocol import TransitionModel
from mbagent.planning.pair_regression import PairRegression
from mbagent.planning.value_iteration import LOWEST_KNOWN, LeafValues, bellman, evaluate, score_edges
from mbagent.types import Actions, Floats, Ints, Reward, States
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive

ITERATIONS = 3
"""Number of rounds, each of simulated play and a fit."""

STATES_A_ROUND = 600
"""Maximum number of states that are taken from each round of play."""

EPISODES = 64
"""Number of episodes simulated in parallel."""

EPISODE_STEPS = 40
"""Number of steps of each simulated episode."""

RANDOM_ACTION = 0.2
"""Share of random actions in play that is greedy on fitted values."""

FEWEST_SAMPLES, MOST_ROW_SAMPLES = 4, 32
"""Minimum and maximum number of samples for each (state, action)."""

SAMPLES_IN_ALL = 8000
"""Approximate number of samples for each action over all states: fewer states get more samples each."""

SAMPLED_TOGETHER = 4
"""Number of states that share random numbers. Small, so that values are averaged over many different random numbers."""

SWEEPS = 150
"""Maximum number of backups and fits in a round."""

CONVERGED = 1e-4
"""They end when no value changes by more than this share of the largest absolute reward."""

_PLAY_SALT, _EXPAND_SALT, _SAMPLE_SALT = 0xF1A1, 0xF1A2, 0xF1A3


@dataclass(frozen=True)
class Task:
    """The problem for which values are learned.

    Attributes:
        model: transition model for simulations.
        goal: reward function.
        start: int64 [S, F], start states.
        gamma: discount.
        seed: of the random numbers.
    """

    model: TransitionModel
    goal: Reward
    start: States
    gamma: float
    seed: int


@compiled
def _back_up(graph: GraphArrays, rewards: Floats, gamma: float, nodes: Ints, v: Floats, q: Floats, out: Floats) -> None:
    for i in range(len(nodes)):
        out[i] = bellman(nodes[i], graph, rewards, gamma, v, q)


def learn_values(task: Task) -> tuple[LeafValues, States]:
    """Values of states under the best policy found in simulated play.

    Returns:
        (values, or ``LOWEST_KNOWN`` if all rewards are equal; distinct states int64 [N, F] that were visited).
    """
    leaf, visited = LOWEST_KNOWN, np.zeros((0, len(task.model.cardinalities)), dtype=np.int64)
    for number in range(ITERATIONS):
        played = _play(task, leaf, number)
        rng = np.random.default_rng([task.seed, number])
        chosen = rng.choice(len(played), size=min(len(played), STATES_A_ROUND), replace=False)
        visited = np.unique(np.concatenate([visited, played[np.sort(chosen)]]), axis=0)
        leaf = _fit(task, visited, leaf, number)
    return leaf, visited


def _play(task: Task, leaf: LeafValues, number: int) -> States:
    """States int64 [N, F] visited by play that is greedy for the values, or random if none exist yet."""
    rng = np.random.default_rng([task.seed, number, _PLAY_SALT])
    states, visited = task.start[rng.integers(len(task.start), size=EPISODES)], []
    for step in range(EPISODE_STEPS):
        visited.append(states)
        actions = rng.integers(task.model.n_actions, size=EPISODES)
        if len(leaf.common):
            is_random = rng.random(EPISODES) < RANDOM_ACTION
            actions = np.where(is_random, actions, greedy_actions(task, leaf, states, number * EPISODE_STEPS + step))
        keys = derive(task.seed, _SAMPLE_SALT, number * EPISODE_STEPS + step, np.arange(EPISODES))
        after, terminated = task.model.sample(states, actions, keys)
        restarts = task.start[rng.integers(len(task.start), size=EPISODES)]
        states = np.where(terminated[:, None], restarts, after)
    return np.concatenate(visited)


def greedy_actions(task: Task, leaf: LeafValues, states: States, step: int) -> Actions:
    """Greedy actions [B] in states int64 [B, F], by one-step lookahead."""
    graph = StateGraph(task.model)
    nodes = graph.add(states, np.zeros(len(states), dtype=np.int64))
    distinct, v, _, q, rewards = _expanded(task, graph, leaf, step)
    _back_up(graph.arrays, rewards, task.gamma, distinct, v, q, np.empty(len(distinct)))
    best: Actions = q.argmax(axis=1)[nodes]
    return best


def _expanded(task: Task, graph: StateGraph, leaf: LeafValues, step: int) -> tuple[Ints, Floats, Floats, Floats, Floats]:
    """Expands all nodes of a graph.

    Returns:
        (expanded nodes, values of all nodes, arrays to fill with the backed-up values and with q, rewards of the edges).
    """
    nodes = np.arange(len(graph))
    samples = min(max(SAMPLES_IN_ALL // len(nodes), FEWEST_SAMPLES), MOST_ROW_SAMPLES)
    for begin in range(0, len(nodes), SAMPLED_TOGETHER):
        graph.expand(nodes[begin : begin + SAMPLED_TOGETHER], samples, int(derive(task.seed, _EXPAND_SALT, step, begin)[0]))
    v, q = np.zeros(len(graph)), np.zeros((len(graph), task.model.n_actions))
    evaluate(leaf, graph.states, np.zeros(len(graph), dtype=np.bool_), v)
    return nodes, v, np.empty(len(nodes)), q, score_edges(graph, task.goal)


def _fit(task: Task, states: States, leaf: LeafValues, number: int) -> LeafValues:
    """Values fitted on distinct states int64 [N, F], starting from the values ``leaf``."""
    graph = StateGraph(task.model)
    graph.add(states, np.zeros(len(states), dtype=np.int64))
    nodes, v, targets, q, rewards = _expanded(task, graph, leaf, (ITERATIONS + number) * EPISODE_STEPS)
    if rewards.min() == rewards.max():
        return LOWEST_KNOWN
    low, high = (float(end) / (1.0 - task.gamma) for end in (min(rewards.min(), 0.0), max(rewards.max(), 0.0)))
    regression = PairRegression(graph.states[nodes], task.model.cardinalities, graph.states, low, high)
    tolerance = CONVERGED * float(np.abs(rewards).max())
    for _ in range(SWEEPS):
        _back_up(graph.arrays, rewards, task.gamma, nodes, v, q, targets)
        leaf, before = regression.fit(targets), v
        v = regression.values(leaf)
        if np.abs(v - before).max() <= tolerance:
            break
    return leaf if np.isfinite(leaf.mean) and np.isfinite(leaf.weights).all() else LOWEST_KNOWN
