"""Properties of every game, with every argument."""

import copy
import pickle

import numpy as np
import pytest

from mbagent_envs import FlierCatcher, Game, GeyserRunner, InvalidActionError, Maneuverer
from mbagent_envs.random_keys import derive
from tests.envs.helpers import DEFAULTS, GAMES, Lottery, returns, start_states, wandered_states

each_game = pytest.mark.parametrize("game", GAMES, ids=repr)


@each_game
def test_every_reachable_state_is_valid(game: Game) -> None:
    for obs in (start_states(game, 300), wandered_states(game, 300)):
        assert obs.dtype == np.int8
        assert obs.shape == (300, *game.observation_space.shape)
        np.testing.assert_array_equal(game.check_observations(obs), obs)
        assert all(game.observation_space.contains(row) for row in obs[:20])


@each_game
def test_rows_do_not_depend_on_each_other_and_arguments_stay_as_they_are(game: Game) -> None:
    obs = wandered_states(game, 64)
    keys, actions = derive(7, np.arange(64)), np.arange(64) % len(game.action_names)
    before = obs.copy()
    together = game.transition(obs, actions, keys)
    np.testing.assert_array_equal(obs, before)
    assert not np.shares_memory(together, obs)
    alone = [game.transition(obs[b : b + 1], actions[b : b + 1], keys[b : b + 1])[0] for b in range(64)]
    np.testing.assert_array_equal(together, alone)
    np.testing.assert_array_equal(game.transition(obs[::-1], actions[::-1], keys[::-1]), together[::-1])


@each_game
def test_goals_are_pure_and_take_any_integer_type(game: Game) -> None:
    obs = wandered_states(game, 200)
    actions = np.arange(200) % len(game.action_names)
    next_obs = game.transition(obs, actions, derive(8, np.arange(200)))
    assert len(game.reward_functions) >= 4
    assert next(iter(game.reward_functions)) == "default"
    np.testing.assert_array_equal(game.reward_functions["default"](obs, actions, next_obs), game.reward(obs, actions, next_obs))
    for name, goal in game.reward_functions.items():
        earned = goal(obs, actions, next_obs)
        assert earned.dtype == np.float64, name
        assert earned.shape == (200,), name
        wide = goal(obs.astype(np.int64), actions, next_obs.astype(np.int64))
        np.testing.assert_array_equal(wide, earned, name)
        alone = goal(obs[5:6], actions[5:6], next_obs[5:6])
        np.testing.assert_array_equal(alone, earned[5:6], name)
    assert not game.terminated(obs, actions, next_obs).any()


@each_game
def test_listed_successors_have_the_frequencies_of_sampled_ones(game: Game) -> None:
    for state in wandered_states(game, 6):
        for action in range(len(game.action_names)):
            try:
                following, probabilities = game.transition_distribution(state, action)
            except NotImplementedError:
                assert isinstance(game, Maneuverer)
                assert (state[0] & state[2]).any()
                continue
            assert probabilities.sum() == pytest.approx(1)
            assert (probabilities > 0).all()
            assert len(np.unique(following.reshape(len(following), -1), axis=0)) == len(following)
            n = 4000
            sampled = game.transition(np.repeat(state[None], n, axis=0), np.full(n, action), derive(3, np.arange(n)))
            counts = np.array([(sampled == row).reshape(n, -1).all(axis=1).sum() for row in following])
            assert counts.sum() == n
            error = np.sqrt(n * probabilities * (1 - probabilities))
            assert (np.abs(counts - n * probabilities) <= 5 * error + 1e-9).all()


@each_game
def test_a_game_can_be_built_again_copied_and_pickled(game: Game) -> None:
    again = type(game)(**game.arguments)
    assert repr(again) == repr(game)
    obs = wandered_states(game, 20)
    actions, keys = np.zeros(20, dtype=np.int64), derive(1, np.arange(20))
    for other in (again, copy.deepcopy(game), pickle.loads(pickle.dumps(game))):
        np.testing.assert_array_equal(other.transition(obs, actions, keys), game.transition(obs, actions, keys))
        assert other.reward_functions.keys() == game.reward_functions.keys()


@pytest.mark.parametrize("game", DEFAULTS, ids=repr)
def test_goals_cannot_be_replaced_by_accident(game: Game) -> None:
    with pytest.raises(TypeError):
        game.reward_functions["default"] = game.reward  # type: ignore[index]


@pytest.mark.parametrize(("game", "score"), [(GeyserRunner(), 24.2), (Maneuverer(), 1.1), (FlierCatcher(), 12.75)], ids=repr)
def test_scores_of_random_play_have_not_changed(game: Game, score: float) -> None:
    earned = returns(game, None, game.reward, episodes=2000, seed=0)
    assert abs(earned.mean() - score) < 4 * earned.std() / np.sqrt(2000)


@pytest.mark.parametrize("game", DEFAULTS, ids=repr)
def test_observations_that_are_no_state_are_refused(game: Game) -> None:
    obs = start_states(game, 4)
    with pytest.raises(ValueError, match="must have shape"):
        game.check_observations(obs[0])
    with pytest.raises(ValueError, match="only 0 and 1"):
        game.check_observations(obs * 2)
    with pytest.raises(ValueError, match=f"not a state of {type(game).__name__}"):
        game.check_observations(np.zeros_like(obs))
    with pytest.raises(ValueError, match=f"not a state of {type(game).__name__}"):
        game.check_observations(np.ones_like(obs))
    assert game.check_observations(obs.astype(np.float64)).dtype == np.int8
    assert game.check_observations(obs[:0]).shape == (0, *game.observation_space.shape)


@pytest.mark.parametrize("actions", [[0, -1], [0, 99], [0.0, 1.0], [True, False], [0], 0, [[0, 0]], ["up", "up"]])
def test_actions_outside_the_space_are_refused(actions: object) -> None:
    for game in DEFAULTS:
        with pytest.raises(InvalidActionError, match="actions must be 2 integers from 0 to"):
            game.check_actions(actions, 2)  # type: ignore[arg-type]


def test_a_game_that_cannot_list_its_successors_says_so() -> None:
    with pytest.raises(NotImplementedError, match="sample them with transition"):
        Lottery().transition_distribution(start_states(Lottery(), 1)[0], 0)
