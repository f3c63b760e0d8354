"""Play and scores of agents on environments of other packages."""

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from external_benchmark import Args, cells, main
from harness import write_csv
from studies.external import IN_LEARNED_ENV, OURS, TRUE, Cell, markdown_table, run_cell
from worlds.known_rules import scale_of
from worlds.registry import CONTINUOUS, WORLDS, World, find_world, for_networks

LAKE = find_world("FrozenLake 4x4")


@pytest.mark.parametrize("agent", [OURS, TRUE, "PPO", IN_LEARNED_ENV, "random"])
def test_agents_are_scored_on_one_scale(agent: str) -> None:
    (row,) = run_cell(Cell(LAKE, agent, seed=0, steps=10_000, episodes=5, baseline_steps=1000)).rows
    assert row["optimum"] == pytest.approx(0.744, abs=0.001)
    assert row["random"] == pytest.approx(0.0139, abs=0.001)
    assert row["episodes"] == 5
    assert 0.0 <= row["return"] <= 1.0
    assert row["steps"] == {OURS: 10_000, TRUE: 0, "random": 0}.get(agent, 1000)
    if agent == TRUE:
        assert row["normalised"] > 0.98
    if agent == OURS:
        assert row["normalised"] > 0.8
        assert row["exact"] == pytest.approx(row["random"] + row["normalised"] * (row["optimum"] - row["random"]))


def test_continuous_worlds_are_clipped_and_cut_into_bins() -> None:
    for world in CONTINUOUS:
        env = world.make()
        assert env.observation_space == gym.spaces.MultiDiscrete(list(world.bins))
        env.reset(seed=0)
        for _ in range(5):
            assert env.observation_space.contains(env.step(1)[0])
    scale = scale_of(World("x", "binned", "CartPole-v1", bins=(2, 2, 2, 2), bounds=(1.0, 1.0, 1.0, 1.0)))
    assert 15 < scale.random < 30
    assert np.isnan(scale.reference)


def test_images_are_shown_to_networks_as_small_numbers() -> None:
    class Image(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(0, 255, (2, 2, 3), np.uint8)
        action_space = gym.spaces.Discrete(2)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return np.full((2, 2, 3), 7, dtype=np.uint8), {}

    env = for_networks(Image())
    obs, _ = env.reset()
    assert obs.shape == env.observation_space.shape == (12,)
    assert env.observation_space.contains(obs)
    np.testing.assert_allclose(obs, 0.7)
    assert for_networks(LAKE.make()).observation_space == gym.spaces.Discrete(16)


def test_what_is_asked_for_is_planned() -> None:
    todo = cells(Args(worlds=("FrozenLake 8x8",), agents=(OURS, "PPO"), seeds=2, first_seed=5, baseline_steps=100))
    assert [(cell.agent, cell.seed, cell.steps, cell.baseline_steps) for cell in todo] == [
        (agent, seed, 50_000, 100) for agent in (OURS, "PPO") for seed in (5, 6)
    ]
    full = cells(Args(full=True, agents=(OURS,)))
    here = [world for world in WORLDS if world.missing is None]
    assert len(full) == 5 * len(here)
    assert {cell.episodes for cell in full} == {100}
    for wrong, message in (
        (Args(worlds=("Nowhere",)), "no world 'Nowhere'"),
        (Args(agents=("Nobody",)), "no agent 'Nobody'"),
        (Args(seeds=0), "--seeds"),
    ):
        with pytest.raises(ValueError, match=message):
            cells(wrong)


def test_the_command_writes_a_line_for_each_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--worlds", "CliffWalking", "--agents", TRUE, "random", "--episodes", "2", "--workers", "1"]
    assert main([*options, "--output", str(tmp_path)]) == 0
    lines = (tmp_path / "results.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 3
    assert "-13.000" in capsys.readouterr().out
    assert main(["--worlds", "Nowhere"]) == 1


@pytest.mark.skipif(importlib.util.find_spec("pyRDDLGym") is None, reason="needs the extra rddl")
@pytest.mark.parametrize("name", ["Navigation", "CrossingTraffic", "SkillTeaching"])
def test_rddl_tables_are_the_domains_rules(name: str) -> None:
    from mbagent.adapters.rddl import RddlEnv  # noqa: PLC0415 - an optional dependency
    from worlds.known_rules import exact_world, tables_of, true_model  # noqa: PLC0415

    world = find_world(name)
    tables, env, rng = tables_of(world.target), RddlEnv(world.target), np.random.default_rng(0)
    known, model = exact_world(world), true_model(world)
    assert known is not None
    assert model is not None
    np.testing.assert_allclose(tables.transitions().sum(axis=2), 1.0)  # all transitions stay within the tables
    state, _ = env.reset(seed=0)
    off = []
    for _ in range(1500):
        action = int(rng.integers(len(env.assignments)))
        row = tables.rows_of(state[None].astype(np.int64))[0]
        following, reward, _, over, _ = env.step(action)
        p = tables.chances[row, action]
        assert reward == tables.rewards[row, action]
        assert (p[following == 1] > 0).all()
        assert (p[following == 0] < 1).all()
        off.append(following - p)
        state = env.reset()[0] if over else following
    assert np.abs(np.mean(off, axis=0)).max() < 0.02
    states = tables.states[:20]
    actions = np.arange(len(states)) % len(env.assignments)
    found = model[0].successors(states, actions, 64, 0)
    np.testing.assert_allclose(np.add.reduceat(found.probabilities, found.offsets[:-1]), 1.0)


def rows(world: str, agent: str, normalised: list[float], positive: float = 0.5) -> list[dict[str, object]]:
    more = {"positive": positive, "learn_seconds": 2.0, "milliseconds": 0.5}
    return [{"world": world, "agent": agent, "normalised": value, **more} for value in normalised]


def test_the_documentations_table_holds_the_last_of_each(tmp_path: Path) -> None:
    nan = float("nan")
    first = [
        *rows("Taxi", "mbagent", [0.1, 0.2]),
        *rows("MiniGrid Empty", "mbagent", [nan, nan], 0.998),
        *rows("Taxi", "PPO", [0.3]),
    ]
    write_csv(tmp_path / "first.csv", first)
    second = rows("Taxi", "mbagent", [0.5, 0.7, 0.9])
    second[0] |= {"learn_seconds": 40.0, "milliseconds": 60.0}
    write_csv(tmp_path / "second.csv", second)
    lines = markdown_table([tmp_path / "first.csv", tmp_path / "second.csv"]).splitlines()
    assert lines[0] == "| | mbagent | PPO | learning, s | decision, ms |"
    assert lines[2:] == ["| Taxi | 0.700 | 0.300 | 2.0 | 0.50 |", "| MiniGrid Empty | 99.8% | – | 2.0 | 0.50 |"]
