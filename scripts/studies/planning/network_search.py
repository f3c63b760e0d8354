"""The library's search with learned networks compared with mctx: speed, regret, and processor time to equal regret."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner
from mbagent.types import Ints
from studies.planning.networks import AT_ONCE, BUDGETS, SEEDS, NetworkTask, PairwiseGoal, PeerOnNetworks

MCTX = "mctx, Gumbel MuZero"
HORIZON, BATCH = 15, 256
"""Maximum steps of a simulation, as in mctx; maximum number of simulations between two calls of the model."""


class Effort(NamedTuple):
    """Search effort of a decision; see PlannerSettings.

    Attributes:
        lookahead_states, lookahead_samples: size of the lookahead that initialises the search.
        simulations: simulations of the search.
    """

    lookahead_states: int
    lookahead_samples: int
    simulations: int

    def of(self, task: NetworkTask) -> str:
        """Name of the search."""
        pruned = ", pruned" if task.pruned else ""
        return f"mbagent{pruned}, {self.lookahead_states} states, {self.lookahead_samples} draws"


EFFORTS = (
    Effort(2, 1, 4),
    Effort(4, 1, 8),
    Effort(8, 1, 16),
    Effort(16, 1, 64),
    Effort(64, 1, 64),
    Effort(32, 1, 1024),
    Effort(64, 4, 1024),
    Effort(160, 4, 1024),
)
"""The compared efforts; the last has the lookahead of the default settings."""


@dataclass(frozen=True)
class NetworkRow:
    """A search with networks and a budget; times are processor times, rates are over all roots.

    Attributes:
        search: its name.
        simulations: its budget.
        regret: mean over random goals, starts and seeds, relative to that of random actions: 0 is perfect.
        error: standard error over goals.
        regret_own: the same with the game's own goal.
        ms_1, ms_16: milliseconds per decision, for one root and for 16 at once.
        simulations_1, simulations_16: simulations per second.
        samples_1, samples_16: next states sampled from the networks per second; for mbagent, distinct ones only.
    """

    search: str
    simulations: int
    regret: float
    error: float
    regret_own: float
    ms_1: float
    ms_16: float
    simulations_1: float
    simulations_16: float
    samples_1: float
    samples_16: float


@dataclass(frozen=True)
class RatioRow:
    """mctx with a budget, and the cheapest effort of the library with no more regret.

    Attributes:
        roots: number of roots searched at once.
        simulations: budget of mctx.
        regret: regret of mctx.
        ms: milliseconds per decision of mctx.
        ours: the library's effort; empty if none has as little regret.
        ours_regret, ours_ms: regret and milliseconds per decision of this effort.
        ratio: processor time of mctx divided by that of this effort.
        simulations_ratio: largest ratio of simulations per second, at an equal number of simulations and no more regret; nan
            if not measured.
    """

    roots: int
    simulations: int
    regret: float
    ms: float
    ours: str
    ours_regret: float
    ours_ms: float
    ratio: float
    simulations_ratio: float


def planner_for(task: NetworkTask, goal: PairwiseGoal, effort: Effort, seed: int) -> MctsPlanner:
    """The library's search. It has no start states, so each decision includes the cost of all its expansions."""
    settings = PlannerSettings(
        num_simulations=effort.simulations,
        gamma=task.gamma,
        horizon=HORIZON,
        lookahead_states=effort.lookahead_states,
        lookahead_samples=effort.lookahead_samples,
        batch_size=BATCH,
        seed=seed,
    )
    planner = MctsPlanner(settings)
    planner.set_model(task.model, task.starts[:0])
    planner.set_goal(goal)
    return planner


def _shares(task: NetworkTask, actions: Sequence[Ints]) -> tuple[float, float, float]:
    """(regret over the random goals, its error, regret under the game's own goal) of actions [seeds, N_STARTS] for each goal."""
    own, *others = (task.regrets(goal, taken) for goal, taken in enumerate(actions))
    return float(np.mean(others)), float(np.std(others, ddof=1) / np.sqrt(len(others))), own


def _timed(task: NetworkTask, effort: Effort, n_roots: int, repetitions: int) -> tuple[float, float]:
    """(median seconds per call, mean number of distinct next states sampled in it), with the game's own goal."""
    roots, seconds = np.resize(task.roots, (n_roots, task.roots.shape[1])), []
    planner = planner_for(task, task.goals[0], effort, 0)
    for repetition in range(repetitions + 1):  # the first one includes compilation and memory allocation
        calls = max(1, 16 // n_roots)
        began = time.process_time()
        for call in range(calls):
            planner.plan(np.roll(roots, call, axis=0) if n_roots > 1 else task.roots[call % len(task.roots)][None])
        if repetition:
            seconds.append((time.process_time() - began) / calls)
    drawn = [planner.trace(root[None]).graph.n_edges for root in task.roots]
    return float(np.median(seconds)), n_roots * float(np.mean(drawn))


def measure_own(task: NetworkTask, effort: Effort, repetitions: int = 5) -> NetworkRow:
    """Regret and speed of the library's search."""
    chosen = [
        np.stack([planner_for(task, goal, effort, seed).plan(task.starts).actions for seed in SEEDS]) for goal in task.goals
    ]
    (one, drawn), (many, drawn_by_many) = (_timed(task, effort, n_roots, repetitions) for n_roots in AT_ONCE)
    n, roots = effort.simulations, AT_ONCE[1]
    speeds = n / one, roots * n / many, drawn / one, drawn_by_many / many
    return NetworkRow(effort.of(task), n, *_shares(task, chosen), 1e3 * one, 1e3 * many / roots, *speeds)


def rows_of_mctx(task: NetworkTask, found: PeerOnNetworks) -> list[NetworkRow]:
    """The same for mctx, which samples one next state per simulation."""
    rows = []
    for n in BUDGETS:
        one, many = (next(s for s in found.speeds if (s.roots, s.simulations) == (n_roots, n)) for n_roots in AT_ONCE)
        rates = one.simulations_per_second, many.simulations_per_second, one.samples_per_second, many.samples_per_second
        shares = _shares(task, list(found.choices[n]))
        rows.append(NetworkRow(MCTX, n, *shares, 1e3 * one.seconds, 1e3 * many.seconds / AT_ONCE[1], *rates))
    return rows


def ratios(own: Sequence[NetworkRow], peer: Sequence[NetworkRow]) -> list[RatioRow]:
    """Cost of the library's efforts compared with each of the peer's budgets."""
    rows = []
    for key in AT_ONCE:
        for row in peer:
            ms, rate = getattr(row, f"ms_{key}"), getattr(row, f"simulations_{key}")
            good = min((o for o in own if o.regret <= row.regret), key=lambda o: getattr(o, f"ms_{key}"), default=None)
            alike = (o for o in own if o.simulations == row.simulations and o.regret <= row.regret)
            best = max((getattr(o, f"simulations_{key}") for o in alike), default=float("nan"))
            ours = ("", float("nan"), float("nan"), float("nan"))
            if good is not None:
                cost = getattr(good, f"ms_{key}")
                ours = (f"{good.search}, {good.simulations} simulations", good.regret, cost, ms / cost)
            rows.append(RatioRow(key, row.simulations, row.regret, ms, *ours, best / rate))
    return rows
