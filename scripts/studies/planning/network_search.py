"""The library's search through learned networks beside mctx's: speed, regret, and processor time to equal regret."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbagent.planning.graph_search import GraphSearch
from mbagent.planning.planner import PlannerSettings
from mbagent.types import Ints
from studies.planning.networks import AT_ONCE, BUDGETS, SEEDS, NetworkTask, PairwiseGoal, PeerOnNetworks

MCTX = "mctx, Gumbel MuZero"
HORIZON, WAVE = 15, 256
"""Steps of a simulation, as in mctx; simulations between two calls of the model, at most."""


class Effort(NamedTuple):
    """How much is spent on a decision; see PlannerSettings.

    Attributes:
        lookahead_states, lookahead_samples: of the machine that the search starts from.
        simulations: of the search.
    """

    lookahead_states: int
    lookahead_samples: int
    simulations: int

    def of(self, task: NetworkTask) -> str:
        """What the search is called."""
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
"""What is compared; the last one's machine is that of the default settings."""


@dataclass(frozen=True)
class NetworkRow:
    """A search through networks with a budget; times are processor time, rates are over all roots.

    Attributes:
        search: its name.
        simulations: its budget.
        regret: mean over random goals, starts and seeds, as a share of what random actions lose: 0 is perfect.
        error: standard error over goals.
        regret_own: the same with the game's own goal.
        ms_1, ms_16: milliseconds of a decision from one root, and of each of 16 at once.
        simulations_1, simulations_16: simulations a second.
        samples_1, samples_16: next states drawn from the networks a second; of mbagent distinct ones only.
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
    """mctx with a budget, and the cheapest of the library's efforts that loses no more.

    Attributes:
        roots: searched at once.
        simulations: mctx's budget.
        regret: mctx's.
        ms: mctx's, of a decision.
        ours: the library's effort; empty where none loses as little.
        ours_regret, ours_ms: its figures.
        ratio: times less processor time to regret as low.
        simulations_ratio: times as many simulations a second, with as many simulations and no more regret, at most; nan where
            that was not measured.
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


def planner_for(task: NetworkTask, goal: PairwiseGoal, effort: Effort, seed: int) -> GraphSearch:
    """The library's search. It is shown no start states: every decision pays for all that it imagines."""
    settings = PlannerSettings(
        num_simulations=effort.simulations,
        gamma=task.gamma,
        horizon=HORIZON,
        lookahead_states=effort.lookahead_states,
        lookahead_samples=effort.lookahead_samples,
        wave=WAVE,
        seed=seed,
    )
    planner = GraphSearch(settings)
    planner.set_model(task.model, task.starts[:0])
    planner.set_goal(goal)
    return planner


def _shares(task: NetworkTask, actions: Sequence[Ints]) -> tuple[float, float, float]:
    """(regret over the random goals, its error, regret under the game's own) of actions [seeds, N_STARTS] for each goal."""
    own, *others = (task.regrets(goal, taken) for goal, taken in enumerate(actions))
    return float(np.mean(others)), float(np.std(others, ddof=1) / np.sqrt(len(others))), own


def _timed(task: NetworkTask, effort: Effort, n_roots: int, repetitions: int) -> tuple[float, float]:
    """(seconds of a call, the median, and distinct next states drawn in it, the mean), the game's own goal."""
    roots, seconds, drawn = np.resize(task.roots, (n_roots, task.roots.shape[1])), [], 0.0
    planner = planner_for(task, task.goals[0], effort, 0)
    for repetition in range(repetitions + 1):  # the first one compiles and makes room
        calls, before = max(1, 16 // n_roots), planner.expanded
        began = time.process_time()
        for call in range(calls):
            planner.plan(np.roll(roots, call, axis=0) if n_roots > 1 else task.roots[call % len(task.roots)][None])
        if repetition:
            seconds.append((time.process_time() - began) / calls)
            drawn = (planner.expanded - before) / calls
    return float(np.median(seconds)), drawn


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
    """The same of mctx; it draws a next state in every simulation."""
    rows = []
    for n in BUDGETS:
        one, many = (next(s for s in found.speeds if (s.roots, s.simulations) == (n_roots, n)) for n_roots in AT_ONCE)
        rates = one.simulations_per_second, many.simulations_per_second, one.samples_per_second, many.samples_per_second
        shares = _shares(task, list(found.choices[n]))
        rows.append(NetworkRow(MCTX, n, *shares, 1e3 * one.seconds, 1e3 * many.seconds / AT_ONCE[1], *rates))
    return rows


def ratios(own: Sequence[NetworkRow], peer: Sequence[NetworkRow]) -> list[RatioRow]:
    """What the library's efforts cost beside each of the peer's budgets."""
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
