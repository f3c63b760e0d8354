"""Search in a game with learned networks: the task, and its export as plain arrays for the peers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from exact import optimal_q
from mbagent import files
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.neural.export import pack_dense, pack_groups
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.types import Floats, Ints
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.random_keys import derive
from studies.planning.peers import Speed, run_script

WIDTH = 20
"""Columns of the GeyserRunner that is learned: d = 30 bits."""

BUDGETS = (16, 64, 256, 1024)
"""Budgets of mctx; each is timed with one root and with 16 at once."""

AT_ONCE = (1, 16)
"""Numbers of roots for timing."""

N_GOALS, N_STARTS, SEEDS = 8, 24, (0, 1, 2)
"""Number of random goals, of states in which an action is chosen, and of searches in each."""

HIT_COST = 2.0


class PairwiseGoal:
    """A reward that depends only on the next state y: ``linear @ y + y @ pairs @ y``.

    Args:
        linear: float64 [F].
        pairs: float64 [F, F].
    """

    def __init__(self, linear: Floats, pairs: Floats) -> None:
        """See the class."""
        self.linear, self.pairs = linear, pairs
        self._first, self._second = np.nonzero(pairs)
        self._weights = pairs[self._first, self._second]

    def __call__(self, states: Ints, actions: Ints, next_states: Ints) -> Floats:
        """Rewards [B] of transitions to ``next_states`` int64 [B, F]."""
        del states, actions
        both = next_states.take(self._first, axis=1) & next_states.take(self._second, axis=1)
        rewards: Floats = next_states @ self.linear + both @ self._weights
        return rewards


@dataclass(frozen=True)
class NetworkTask:
    """A learned game and its goals.

    Attributes:
        data: random play.
        model: predictor and causal conditioner, trained on this data.
        goals: the game's own reward, and random ones.
        q: exact action values in the starts under each goal, in the true game, [goals, N_STARTS, A].
        starts: states in which an action is chosen, int64 [N_STARTS, F].
        roots: states of random play from which searches are timed, int64 [R, F].
        gamma: discount factor; leaf values are 0.
        pruned: whether the model is pruned.
    """

    data: TransitionDataset
    model: NeuralTransitionModel
    goals: tuple[PairwiseGoal, ...]
    q: Floats
    starts: Ints
    roots: Ints
    gamma: float = 0.95
    pruned: bool = False

    def regrets(self, goal: int, actions: Ints) -> float:
        """Mean regret of ``actions`` [..., N_STARTS] under a goal, relative to that of random actions."""
        best, places = self.q[goal].max(axis=1), np.arange(len(self.starts))
        return float((best - self.q[goal][places, actions]).mean() / (best - self.q[goal].mean(axis=1)).mean())


def random_play(game: GeyserRunner, n: int, seed: int, episode: int = 50) -> TransitionDataset:
    """Transitions of random play, int64, with ``episode`` steps per episode."""
    n_bits, n_actions = int(np.prod(game.observation_space.shape)), len(game.action_names)
    n_games, rng = max(1, n // episode), np.random.default_rng(seed)
    data, obs = TransitionDataset((2,) * n_bits, n_actions), game.initial(derive(seed, np.arange(n_games)))
    for step in range(episode):
        actions = rng.integers(0, n_actions, size=n_games)
        after = game.transition(obs, actions, derive(seed, np.arange(n_games), step))
        before, reached = obs.astype(np.int64), after.astype(np.int64)
        nothing = np.zeros(n_games)
        data.append(TransitionBatch(before, actions, reached, nothing.astype(np.bool_), nothing, np.arange(n_games)))
        obs = after
    return data


def goals_of(n: int) -> tuple[PairwiseGoal, ...]:
    """The game's own goal, and ``n`` with standard normal rewards of the columns instead; hits cost the same in all."""
    d, half = WIDTH + WIDTH // 2, WIDTH // 2
    pairs = np.zeros((d, d))
    pairs[np.arange(WIDTH - half, WIDTH), np.arange(WIDTH, d)] = -HIT_COST
    incomes = [np.arange(WIDTH) / (WIDTH - 1), *(np.random.default_rng([seed, WIDTH]).normal(size=WIDTH) for seed in range(n))]
    return tuple(PairwiseGoal(np.concatenate([income, np.zeros(half)]), pairs) for income in incomes)


def exact_values(goal: PairwiseGoal, gamma: float) -> tuple[Ints, Floats]:
    """All states int64 [S, F] of the true game, and their exact action values [S, A] under a goal."""
    game, half = GeyserRunner(width=WIDTH, hit_cost=HIT_COST), WIDTH // 2
    states = np.zeros((WIDTH * half, WIDTH + half), dtype=np.int64)
    number = np.arange(len(states))
    states[number, number // half], states[number, WIDTH + number % half] = 1, 1
    following, probabilities = [], []
    for action in range(len(game.action_names)):
        after, chance = game.transition_distributions(states.astype(np.int8), np.full(len(states), action))
        following.append(after[:, :, :WIDTH].argmax(axis=2) * half + after[:, :, WIDTH:].argmax(axis=2))
        probabilities.append(chance)
    leads_to, likely = np.stack(following, axis=1), np.stack(probabilities, axis=1)
    return states, optimal_q(leads_to, likely, goal(states, number, states), None, gamma, tolerance=1e-12)


def build_task(seed: int, n_steps: int = 5000) -> NetworkTask:
    """Learns GeyserRunner from random play.

    Args:
        seed: seed of play, fit and starts.
        n_steps: steps of random play.
    """
    data = random_play(GeyserRunner(width=WIDTH, hit_cost=HIT_COST), n_steps, seed)
    model = NeuralTransitionModel(data.cardinalities, data.n_actions)
    model.fit(data, seed=seed)
    observed = data.rows().states
    distinct = np.unique(observed, axis=0)
    starts = distinct[np.random.default_rng(seed).permutation(len(distinct))[:N_STARTS]]
    goals, values = goals_of(N_GOALS), []
    for goal in goals:
        states, q = exact_values(goal, NetworkTask.gamma)
        place = {state.tobytes(): i for i, state in enumerate(states)}
        values.append(q[[place[state.tobytes()] for state in starts]])
    return NetworkTask(data, model, goals, np.stack(values), starts, observed[:: max(1, len(observed) // 16)][:16])


def pruned(task: NetworkTask, fraction: float, seed: int) -> NetworkTask:
    """The same task with a pruned copy of the model."""
    model = NeuralTransitionModel(task.data.cardinalities, task.data.n_actions)
    model.load_state_dict(task.model.state_dict())
    model.prune(task.data, fraction, seed=seed)
    return replace(task, model=model, pruned=True)


def exported(task: NetworkTask) -> dict[str, NDArray[np.generic]]:
    """All arrays that a sampler needs; see ``DenseWeights`` and ``GroupWeights`` for their meaning.

    Raises:
        ValueError: the peers' script cannot sample the model: it needs bits, one hidden layer, a causal conditioner.
    """
    model = task.model
    config, codec = model.config, model.codec
    if config.conditioner != "causal" or not config.correction or len(config.hidden) != 1 or not codec.all_binary:
        raise ValueError("The networks script needs bits, one hidden layer, and a causal conditioner that corrects.")
    if config.activation != "silu" or model.conditioner is None:
        raise ValueError(f"The networks script needs silu nodes, not {config.activation}.")
    dense, group = pack_dense(task.model.predictor), pack_groups(model.conditioner)  # type: ignore[arg-type]
    arrays = {f"dense_{name}": getattr(dense, name) for name in ("first", "bias", "last", "last_bias", "stay")}
    arrays |= {f"group_{name}": getattr(group, name) for name in ("inputs", "others", "bias", "readout", "offset")}
    return {
        **arrays,
        "members": model.conditioner.members.numpy(),
        "certain": np.asarray(config.certain),
        "linear": task.goals[0].linear,
        "pairs": task.goals[0].pairs,
        "linear_goals": np.stack([goal.linear for goal in task.goals]),
        "pairs_goals": np.stack([goal.pairs for goal in task.goals]),
        "starts": task.starts,
        "roots": task.roots,
        "gamma": np.asarray(task.gamma),
    }


class PeerOnNetworks(NamedTuple):
    """Results of mctx.

    Attributes:
        speeds: speeds with each budget, from one root and from 16.
        choices: budget -> actions int64 [goals, seeds, N_STARTS].
        mean_next_state: mean of its samples from the first root under action 0, [F], as a check.
    """

    speeds: list[Speed]
    choices: dict[int, Ints]
    mean_next_state: Floats


def run_networks_in_mctx(python: Path, task: NetworkTask, repetitions: int = 5) -> PeerOnNetworks:
    """Runs searches with the networks in mctx.

    Raises:
        PeerError: the script failed.
    """
    speeds = np.array([(n_roots, budget) for budget in BUDGETS for n_roots in AT_ONCE])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "networks.npz"
        query = {"speeds": speeds, "repetitions": np.asarray(repetitions), "budgets": np.array(BUDGETS), "seeds": np.array(SEEDS)}
        files.write_arrays(path, {**exported(task), **query})
        output = run_script(python, "mctx_networks", [str(path)])
    choices = {int(n): np.array(actions, dtype=np.int64) for n, actions in output["choices"].items()}
    return PeerOnNetworks([Speed(**speed) for speed in output["speeds"]], choices, np.array(output["mean_next_state"]))
