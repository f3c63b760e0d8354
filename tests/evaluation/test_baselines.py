import numpy as np
import pytest

from mbagent.evaluation.baselines import BASELINE_SETTINGS, BaselineName, as_policy, train_baseline
from mbagent.evaluation.evaluate import Policy
from worlds.games import find_case, play

CASE = find_case("geyser_low_cost")


def score(policy: Policy, repeatable: bool) -> float:
    return float(play(CASE, policy, episodes=10, seed=99, repeatable=repeatable).default.mean())


@pytest.mark.parametrize("name", ["PPO", "DQN", "A2C"])
def test_baselines_use_exactly_the_steps_they_are_given(name: BaselineName) -> None:
    reports: list[float] = []
    algorithm, curve = train_baseline(name, CASE.make_env, steps=2000, seed=0, evaluate=score, points=2, report=reports.append)
    assert algorithm.num_timesteps == 2000
    assert [steps for steps, _ in curve] == [0, 1000, 2000]
    assert all(0 <= share <= 1 for share in reports)
    obs = np.stack([CASE.make_env().reset(seed=s)[0] for s in range(3)])
    assert as_policy(algorithm)(obs).shape == (3,)


def test_a_baseline_learns_an_easy_game_in_a_few_thousand_steps() -> None:
    _, curve = train_baseline("A2C", CASE.make_env, steps=4000, seed=0, evaluate=score, points=2)
    assert curve[-1][1] > 60 > curve[0][1]


def test_longer_runs_of_all_baselines_stay_exact_too() -> None:
    for settings in BASELINE_SETTINGS.values():
        assert 10_000 % (settings["n_envs"] * settings.get("n_steps", 1)) == 0
