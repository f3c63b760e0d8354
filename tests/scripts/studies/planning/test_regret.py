from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from mbagent.types import Floats, Ints
from studies.planning.ours import OWN_SEARCHES, TableSearch, as_model
from studies.planning.page import write_page
from studies.planning.peers import PeerError, run_peer
from studies.planning.regret import Settings, build_arena, compare, score
from tests.worlds import optimal_q
from worlds.random_mdps import Kind, RandomMDP, choose_roots, random_mdp, side_by_side


@pytest.mark.parametrize("kind", get_args(Kind))
def test_exact_values_are_those_of_value_iteration_written_another_way(kind: Kind) -> None:
    world = random_mdp(kind, 3)
    assert np.allclose(world.table.sum(axis=2), 1.0)
    ends = tuple(int(s) for s in np.flatnonzero(world.ends))
    assert np.allclose(world.q, optimal_q(world.table, world.rewards, world.gamma, ends), atol=1e-9)
    roots = choose_roots(world, 8, 0)
    assert len(set(roots)) == 8
    assert not world.ends[roots].any()
    assert np.array_equal(world.regrets(roots, world.q[roots].argmax(axis=1)), np.zeros(8))
    assert (world.random_regrets(roots) > 0.0).all()
    assert (world.leaf_values[world.ends] == 0.0).all()


def test_worlds_side_by_side_do_not_touch() -> None:
    worlds = [random_mdp("dense", seed) for seed in (0, 1)]
    both = side_by_side(worlds)
    assert np.array_equal(both.table[:25, :, :25], worlds[0].table)
    assert np.array_equal(both.table[25:, :, 25:], worlds[1].table)
    assert both.table[:25, :, 25:].sum() == 0.0
    assert np.array_equal(both.q[25:], worlds[1].q)


def test_a_perfect_search_has_no_regret_and_random_choice_a_regret_of_one() -> None:
    arena = build_arena("dense", Settings(worlds=3, roots=4))
    best = arena.world.q[arena.roots].argmax(axis=1)[None]
    assert score("dense", "best", 1, arena, best).regret == 0.0
    assert score("dense", "best", 1, arena, best).right == 1.0
    every = np.repeat(np.arange(4)[:, None], len(arena.roots), axis=1)
    assert score("dense", "every", 1, arena, every).regret == pytest.approx(1.0)


def test_the_planner_on_a_table_needs_no_luck_where_one_action_is_far_better() -> None:
    world = random_mdp("dense", 0)
    model = as_model(world)
    states, actions = np.full((4000, 1), 3), np.zeros(4000, dtype=np.int64)
    drawn, ended = model.sample(states, actions, np.random.default_rng(0))
    assert np.abs(np.bincount(drawn[:, 0], minlength=25) / 4000 - world.table[3, 0]).max() < 0.04
    assert np.array_equal(ended, world.ends[drawn[:, 0]])
    roots = choose_roots(world, 4, 0)
    for name, prepare in OWN_SEARCHES.items():
        taken, samples = prepare(world)(roots, 512, 0)
        assert world.regrets(roots, taken).mean() < 0.5 * world.random_regrets(roots).mean()
        assert samples == (0 if name == "mbagent" else 4 * 512)
    assert not world.regrets(roots, OWN_SEARCHES["mbagent"](world)(roots, 1, 0)[0]).any()


def greedy_in_leaf_values(world: RandomMDP) -> TableSearch:
    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        worth: Floats = world.table[roots] @ (world.rewards + world.gamma * world.leaf_values)
        return worth.argmax(axis=1), 0

    return search


def test_without_peers_one_line_says_so_and_the_page_shows_the_rest(tmp_path: Path) -> None:
    messages: list[str] = []
    settings = Settings(worlds=2, roots=2, seeds=1, budgets=(4, 8), repetitions=1)
    regrets, speeds = compare(settings, {"greedy": greedy_in_leaf_values}, messages.append)
    assert messages[0] == "Peers are left out: --peers-python is not given."
    assert len(regrets) == 4
    assert [(row.roots, row.simulations) for row in speeds] == [(1, 256), (1, 1024), (16, 1024)]
    pictures = write_page(tmp_path / "report.html", {"regret": [vars(row) for row in regrets], "speed": []}, "a command")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Regret of searches against the number of simulations" in page
    assert "Speed of searches in tabular MDPs" not in page
    assert pictures["regret"].startswith(b"\x89PNG")


def test_a_peer_that_does_not_run_is_an_error_that_says_why() -> None:
    world = random_mdp("dense", 0)
    with pytest.raises(PeerError, match="mctx_search"):
        run_peer(Path("no-such-python"), "mctx_search", world, np.array([0]), [16], [0])
