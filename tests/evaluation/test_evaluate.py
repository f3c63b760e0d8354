from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.evaluation.evaluate import evaluate_env, evaluate_game, milliseconds_per_decision, random_policy
from mbagent_envs.game import Game
from worlds.games import find_case, play


def runner(case: str = "geyser_low_cost") -> Game:
    game = find_case(case).game
    assert game is not None
    return game


def rightwards(obs: Any) -> NDArray[np.int64]:
    return np.full(len(obs), 2)


def test_equal_seeds_give_equal_episodes_and_other_seeds_others() -> None:
    game = runner()
    first, again, other = (evaluate_game(game, rightwards, episodes=20, seed=s).default for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_an_episode_does_not_depend_on_how_many_are_played_beside_it() -> None:
    game = runner()
    few, many = (evaluate_game(game, rightwards, episodes=n, seed=5).default for n in (3, 30))
    assert np.array_equal(few, many[:3])


def test_asking_once_about_equal_observations_changes_nothing_but_the_count() -> None:
    game = runner()
    always = evaluate_game(game, rightwards, episodes=10)
    once = evaluate_game(game, rightwards, episodes=10, repeatable=True)
    assert np.array_equal(always.default, once.default)
    assert always.decisions == 10 * game.max_episode_steps
    assert once.decisions <= 50  # GeyserRunner has 50 states


def test_several_goals_are_scored_from_the_same_episodes() -> None:
    game = runner()
    goals = dict(game.reward_functions)
    together = evaluate_game(game, rightwards, episodes=5, goals=goals)
    for name, goal in goals.items():
        alone = evaluate_game(game, rightwards, episodes=5, goals={name: goal})
        assert np.array_equal(together.returns[name], alone.returns[name])


def test_batched_episodes_score_like_episodes_of_the_environment() -> None:
    # Different episodes, so only the means can agree: a runner that always runs right has a mean return of 76.9.
    case = find_case("geyser_low_cost")
    batched = play(case, rightwards, episodes=200, seed=0).default
    single = evaluate_env(case.make_env, rightwards, episodes=40).default
    error = np.hypot(batched.std() / np.sqrt(200), single.std() / np.sqrt(40))
    assert abs(batched.mean() - single.mean()) < 4 * error


def test_nothing_is_earned_after_termination() -> None:
    # FrozenLake has at most one reward, with which the episode ends.
    returns = play(find_case("frozen_lake"), random_policy(4), episodes=200, seed=0).default
    assert set(np.unique(returns)) <= {0.0, 1.0}


def test_decisions_are_timed_one_by_one() -> None:
    sizes: list[int] = []

    def policy(obs: Any) -> NDArray[np.int64]:
        sizes.append(len(obs))
        return np.zeros(len(obs), dtype=np.int64)

    assert milliseconds_per_decision(policy, np.zeros((5, 15), dtype=np.int8)) > 0
    assert set(sizes) == {1}
