"""Regret of searches against the number of simulations, and their speed, in the same MDPs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from mbagent.types import Ints
from studies.planning.ours import OWN_SEARCHES, Prepare, time_search
from studies.planning.peers import PEERS, SPEEDS, PeerError, PeerResult, Speed, run_peer
from worlds.random_mdps import N_STATES, Kind, RandomMDP, choose_roots, random_mdp, side_by_side


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison.

    Attributes:
        worlds: number of MDPs of each kind.
        roots: number of roots in each MDP.
        seeds: searches per root and budget.
        first_seed: first seed of the MDPs and searches.
        budgets: numbers of simulations.
        peers_python: Python interpreter of the peers' environment; None skips the peers.
        repetitions: number of timed calls.
    """

    worlds: int = 10
    roots: int = 8
    seeds: int = 3
    first_seed: int = 0
    budgets: tuple[int, ...] = (16, 64, 256, 1024, 4096)
    peers_python: Path | None = None
    repetitions: int = 5


@dataclass(frozen=True)
class RegretRow:
    """Regret of a search with a budget in MDPs of one kind.

    Attributes:
        kind: kind of the MDPs.
        search: name of the search.
        simulations: budget of the search.
        regret: mean over MDPs, roots and seeds, relative to that of a random action: 0 is perfect.
        error: standard error of the mean over MDPs; roots and seeds of one MDP are not independent.
        right: share of optimal choices.
    """

    kind: str
    search: str
    simulations: int
    regret: float
    error: float
    right: float


@dataclass(frozen=True)
class SpeedRow:
    """Speed of a search: the fields of ``Speed``, in milliseconds, and its name."""

    search: str
    roots: int
    simulations: int
    milliseconds: float
    simulations_per_second: float
    samples_per_second: float


@dataclass(frozen=True)
class Arena:
    """The MDPs of one kind combined into one, with the roots.

    Attributes:
        world: the MDPs, combined by ``side_by_side``.
        roots: roots int64 [W * roots], ordered by MDP.
        n_worlds: number of MDPs W.
    """

    world: RandomMDP
    roots: Ints
    n_worlds: int


def build_arena(kind: Kind, settings: Settings) -> Arena:
    """Creates the MDPs of one kind."""
    seeds = range(settings.first_seed, settings.first_seed + settings.worlds)
    worlds = [random_mdp(kind, seed) for seed in seeds]
    roots = [i * N_STATES + choose_roots(world, settings.roots, i) for i, world in enumerate(worlds)]
    if any(len(some) < settings.roots for some in roots):
        raise ValueError(f"Some MDP has fewer than {settings.roots} roots; choose fewer.")
    return Arena(side_by_side(worlds), np.concatenate(roots), settings.worlds)


def score(kind: str, search: str, simulations: int, arena: Arena, actions: Ints) -> RegretRow:
    """The row of actions int64 [seeds, R] taken in an arena."""
    lost = arena.world.regrets(arena.roots, actions)
    by_world = lost.reshape(len(lost), arena.n_worlds, -1).mean(axis=(0, 2))
    random = arena.world.random_regrets(arena.roots).reshape(arena.n_worlds, -1).mean(axis=1)
    shares = by_world / random
    error = shares.std(ddof=1) / np.sqrt(len(shares)) if len(shares) > 1 else float("nan")
    return RegretRow(kind, search, simulations, float(shares.mean()), float(error), float((lost <= 1e-9).mean()))


def compare(
    settings: Settings, own: Mapping[str, Prepare] = OWN_SEARCHES, say: Callable[[str], None] = print
) -> tuple[list[RegretRow], list[SpeedRow]]:
    """Runs all searches in all MDPs.

    Args:
        settings: settings of the comparison.
        own: the library's searches by name.
        say: called with progress messages and failures of peers.
    """
    regrets: list[RegretRow] = []
    speeds: list[SpeedRow] = []
    seeds = list(range(settings.first_seed, settings.first_seed + settings.seeds))
    if settings.peers_python is None:
        say("Peers are left out: --peers-python is not given.")
    for number, kind in enumerate(get_args(Kind)):
        arena = build_arena(kind, settings)
        # Times do not depend on the rewards, so they are measured once.
        timed = SPEEDS if number == 0 else ()
        for name, prepare in own.items():
            say(f"{kind} worlds: {name}")
            search = prepare(arena.world)
            for n in settings.budgets:
                actions = np.stack([search(arena.roots, n, seed)[0] for seed in seeds])
                regrets.append(score(kind, name, n, arena, actions))
            speeds += _rows(name, time_search(search, arena.roots, timed, settings.repetitions))
        for result in _peers(settings, kind, arena, seeds, timed, say):
            regrets += [score(kind, result.name, n, arena, actions) for n, actions in result.choices.items()]
            speeds += _rows(result.name, result.speeds)
    return regrets, speeds


def _peers(
    settings: Settings,
    kind: str,
    arena: Arena,
    seeds: Sequence[int],
    timed: Sequence[tuple[int, int]],
    say: Callable[[str], None],
) -> Iterator[PeerResult]:
    if settings.peers_python is None:
        return
    for script in PEERS:
        say(f"{kind} worlds: {script}")
        try:
            yield from run_peer(
                settings.peers_python, script, arena.world, arena.roots, settings.budgets, seeds, timed, settings.repetitions
            )
        except PeerError as error:
            say(f"Left out: {error}")


def _rows(name: str, speeds: Sequence[Speed]) -> list[SpeedRow]:
    return [
        SpeedRow(name, s.roots, s.simulations, 1e3 * s.seconds, s.simulations_per_second, s.samples_per_second) for s in speeds
    ]
