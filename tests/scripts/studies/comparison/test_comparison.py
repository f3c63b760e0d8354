"""The comparison, with a fast stand-in for the agent that has two weights and a poor policy."""

import io
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from harness import CellsFailedError, Recorder, run_recorded
from studies.comparison.jobs import Job, RewardOnly, run_job
from studies.comparison.page import write_report
from studies.comparison.plan import FULL, QUICK, Settings, load, plan_jobs, run
from studies.comparison.records import (
    AGENT,
    LEARNED_REWARD,
    RANDOM,
    TRUE_MODEL,
    Record,
    hash_weights,
    read_records,
    write_records,
)
from studies.comparison.summary import save_csv, summarise
from worlds.games import find_case

TINY = Settings(
    steps=1000,
    seeds=2,
    episodes=3,
    goal_episodes=2,
    curve_steps=(500,),
    goal_seeds=2,
    scale_episodes=60,
    cases=("geyser_low_cost", "frozen_lake"),
)


def quiet() -> Console:
    return Console(file=io.StringIO())


def test_the_plan_holds_every_agent_of_every_case_and_no_file_twice() -> None:
    for settings in (QUICK, FULL):
        plan = plan_jobs(settings)
        names = [job.file_name for job in plan]
        assert len(set(names)) == len(names)
        for case in settings.cases:
            agents = {job.agent for job in plan if job.case == case}
            assert {"PPO", "DQN", "A2C", RANDOM} <= agents
            assert agents >= ({LEARNED_REWARD} if case == "frozen_lake" else {AGENT, TRUE_MODEL})


def test_full_trains_longer_baselines_and_at_least_five_seeds_with_a_hundred_episodes() -> None:
    ppo = [job for job in plan_jobs(FULL) if job.agent == "PPO" and job.case == "maneuverer"]
    assert sorted({job.steps for job in ppo}) == [50_000, 500_000]
    assert len({job.seed for job in ppo}) >= 5
    assert FULL.seeds * FULL.episodes >= 100


@pytest.mark.usefixtures("fake_agents")
def test_a_whole_comparison_becomes_one_page_and_one_table(tmp_path: Path) -> None:
    records = run(TINY, tmp_path, workers=1, console=quiet())
    results = summarise(records, TINY)
    save_csv(tmp_path / "results.csv", records, results)
    write_report(tmp_path / "report.html", results, TINY, command="make compare", minutes=1.0)

    rows = {row.agent: row for row in results[0].rows}
    assert set(rows) == {AGENT, LEARNED_REWARD, TRUE_MODEL, "PPO", "DQN", "A2C", RANDOM}
    assert rows["PPO"].steps == rows[AGENT].steps == 1000
    assert rows[AGENT].seeds == 2
    assert rows[AGENT].episodes == 2 * 3 * 5
    assert abs(rows[RANDOM].score.estimate) < 0.3
    assert all(row.weights_unchanged for row in results[0].goals)
    assert len(results[0].goals) >= 3

    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "http" not in page  # no external resources
    assert page.count("data:image/png;base64,") == 4  # bars, curves, two environments
    table = (tmp_path / "results.csv").read_text(encoding="utf-8").splitlines()
    assert table[0].startswith("case,agent,goal,seed,environment_steps")
    assert len({line.count(",") for line in table}) == 2  # the one agent with a comma in its name is quoted


@pytest.mark.usefixtures("fake_agents")
def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = replace(TINY, seeds=1, cases=("geyser_low_cost",), curve_steps=())
    first = run(settings, tmp_path, workers=1, console=quiet())
    calls: list[Job] = []

    def noted(job: Job, report: Any) -> list[Record]:
        calls.append(job)
        return []

    monkeypatch.setattr("studies.comparison.plan.run_job", noted)
    (tmp_path / "records" / plan_jobs(settings)[0].file_name).unlink()
    run(settings, tmp_path, workers=1, console=quiet(), resume=True)
    assert calls == plan_jobs(settings)[:1]
    kept, records = load(tmp_path)
    assert kept == settings
    assert len(records) < len(first)
    with pytest.raises(ValueError, match="other settings"):
        run(replace(settings, steps=7), tmp_path, workers=1, console=quiet(), resume=True)


def test_a_failing_job_is_named_and_the_others_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = (Job(RANDOM, "geyser_low_cost", seed, 0, 2) for seed in (0, 1))

    def sometimes(job: Job, report: Any) -> list[Record]:
        if job is bad:
            raise ZeroDivisionError("too small")
        return run_job(job, report)

    recorder = Recorder(sometimes, write_records, read_records, lambda records: "")
    with pytest.raises(CellsFailedError, match=r"1 of 2 jobs failed(.|\n)*seed 1: ZeroDivisionError: too small"):
        run_recorded(recorder, [bad, good], tmp_path, workers=1, console=quiet())
    assert (tmp_path / good.file_name).exists()
    assert "Traceback" in (tmp_path / "errors.log").read_text(encoding="utf-8")
    assert not list(tmp_path.glob("*.progress"))


def test_the_real_planner_plays_the_true_rules_perfectly_through_a_job() -> None:
    records = run_job(Job(TRUE_MODEL, "geyser_high_cost", 0, 0, 5, ("default", "left"), 5))
    assert [r.goal for r in records] == ["default", "left"]
    assert records[0].mean == pytest.approx(43.78, abs=0.3)
    assert records[1].mean == 100
    assert records[0].decision_ms > 0


def test_records_survive_the_disk(tmp_path: Path) -> None:
    record = Record("c", AGENT, "default", 1, 10, (1.0, 2.5), 3.0, 0.25, ((5, 1.0), (10, 2.0)), "x", "x")
    write_records(tmp_path / "r.json", [record])
    assert read_records(tmp_path / "r.json") == [record]


def test_a_changed_weight_name_shape_or_type_changes_the_hash() -> None:
    base = {"w": np.arange(4.0)}
    others: list[dict[str, Any]] = [
        {"w": np.arange(4.0) + np.array([0, 0, 0, 1e-12])},
        {"v": np.arange(4.0)},
        {"w": np.arange(4.0).reshape(2, 2)},
        {"w": np.arange(4.0).astype(np.float32)},
    ]
    hashes = [hash_weights(state) for state in (base, *others)]
    assert hash_weights({"w": np.arange(4.0)}) == hashes[0]
    assert all(a != b for a, b in itertools.combinations(hashes, 2))


def test_an_environment_without_its_reward_function_hides_it_everywhere() -> None:
    env = RewardOnly(find_case("geyser_low_cost").make_env())
    assert not hasattr(env.unwrapped, "reward_fn")
    assert not hasattr(env.unwrapped, "game")
    env.reset(seed=0)
    assert env.step(2)[1] == pytest.approx(1 / 9)
