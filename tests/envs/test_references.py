import numpy as np
import pytest

from mbagent.types import Ints
from mbagent_envs import FlierCatcher, Game, GeyserRunner, Maneuverer, RewardFn
from mbagent_envs.references import geyser_states, geyser_values, reference_policy
from mbagent_envs.types import Bits
from tests.envs.helpers import DEFAULTS, GAMES, Lottery, returns, wandered_states
from tests.envs.test_maneuverer import board


@pytest.mark.parametrize(
    ("game", "reference"),
    [
        (GeyserRunner(mode="deterministic"), 93.6),
        (GeyserRunner(hit_cost=1.0), 76.8),
        (GeyserRunner(hit_cost=5.0), 43.8),
        (Maneuverer(), 18.9),
        (FlierCatcher(), 57.4),
    ],
    ids=repr,
)
def test_references_reach_the_known_scores(game: Game, reference: float) -> None:
    policy = reference_policy(game)
    assert policy is not None
    earned = returns(game, policy, game.reward, episodes=200, seed=1)
    assert abs(earned.mean() - reference) < 3 * earned.std() / np.sqrt(200) + 0.06


@pytest.mark.parametrize(
    ("game", "name"),
    [(game, name) for game in (GeyserRunner(mode="deterministic"), *DEFAULTS) for name in game.reward_functions],
    ids=str,
)
def test_every_goal_separates_good_play_from_random_play(game: Game, name: str) -> None:
    goal = game.reward_functions[name]
    policy = reference_policy(game, name)
    assert policy is not None
    good, random = returns(game, policy, goal, 100, seed=2), returns(game, None, goal, 400, seed=3)
    error = np.sqrt((good.var() + random.var()) / 20)  # of the difference of two means over 20 episodes
    assert good.mean() - random.mean() > 10 * error


def test_stochastic_geysers_are_crossed_only_at_a_low_cost() -> None:
    for cost, resting in ((1.0, 9), (25 / 9 - 0.1, 9), (25 / 9 + 0.1, 4), (5.0, 4)):
        game = GeyserRunner(hit_cost=cost)
        policy = reference_policy(game, gamma=0.999)
        assert policy is not None
        states = geyser_states(game)
        for obs in states[:5]:  # the start states, one for each eruption
            position = 0
            for _ in range(30):
                move = int(policy(obs[None])[0]) - 1
                position = min(max(position + move, 0), 9)
                obs = states[position * 5]
            assert position == resting


def test_deterministic_geysers_are_passed_without_a_hit() -> None:
    game = GeyserRunner(mode="deterministic", hit_cost=100.0)
    policy = reference_policy(game)
    assert policy is not None
    assert returns(game, policy, game.reward, episodes=5, seed=0).min() > 90


def test_geyser_values_satisfy_bellmans_equation() -> None:
    game = GeyserRunner(width=6, hit_cost=1.5)
    values = geyser_values(game, game.reward, gamma=0.9)
    states = geyser_states(game)
    assert values.shape == (18, 3)
    index = {state.tobytes(): i for i, state in enumerate(states)}
    for i, state in enumerate(states):
        for action in range(3):
            following, chance = game.transition_distribution(state, action)
            rewards = [game.reward(state[None], np.array([action]), row[None])[0] for row in following]
            later = [values[index[row.tobytes()]].max() for row in following]
            assert values[i, action] == pytest.approx(chance @ (np.array(rewards) + 0.9 * np.array(later)))


def distances(obs: Bits) -> Ints:
    """Return steps from each cell to the target, by relaxation."""
    size = obs.shape[1]
    steps = np.where(obs[2] == 1, 0, 10_000)
    for _ in range(size * size):
        padded = np.pad(steps, 1, constant_values=10_000)
        near = np.minimum.reduce([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]) + 1
        steps = np.where(obs[1] == 1, 10_000, np.minimum(steps, near))
    return steps


@pytest.mark.parametrize("game", [Maneuverer(), Maneuverer(size=8, wall_density=0.35)], ids=repr)
def test_maneuverer_always_approaches_the_target(game: Maneuverer) -> None:
    policy = reference_policy(game)
    assert policy is not None
    states = wandered_states(game, 200)
    states = states[~(states[:, 0] & states[:, 2]).any(axis=(1, 2))]
    after = game.transition(states, policy(states), np.zeros(len(states), dtype=np.uint64))
    for obs, next_obs in zip(states, after, strict=True):
        steps = distances(obs)
        assert steps[next_obs[0] == 1] == steps[obs[0] == 1] - 1


def test_maneuverer_seeks_a_new_layout_if_the_goal_is_unreachable() -> None:
    policy = reference_policy(Maneuverer(size=3), "corner")
    assert policy is not None
    assert policy(board("#..", "@..", "*..")[None]).tolist() == [2]  # the corner is a wall, so a new layout is needed
    assert policy(board("...", "@..", "*..")[None]).tolist() == [0]


def test_flier_catcher_takes_the_path_with_more_fliers() -> None:
    game = FlierCatcher(height=5, width=6)
    obs = np.zeros((1, 2, 5, 6), dtype=np.int8)
    obs[0, 0, 2, 0] = 1
    obs[0, 1, 0, 4] = 1  # one above, reachable
    obs[0, 1, 4, 2] = obs[0, 1, 4, 3] = 1  # two below, reachable, but not after the one above
    for name, action in (("default", 2), ("catch low", 2), ("top row", 0)):
        policy = reference_policy(game, name)
        assert policy is not None
        assert policy(obs).tolist() == [action]


@pytest.mark.parametrize("game", GAMES, ids=repr)
def test_every_game_and_goal_has_a_reference_that_does_not_depend_on_the_batch(game: Game) -> None:
    states = wandered_states(game, 12)
    for name in game.reward_functions:
        policy = reference_policy(game, name)
        assert policy is not None
        actions = policy(states)
        assert actions.dtype == np.int64
        assert actions.tolist() == [int(policy(state[None])[0]) for state in states]
        game.check_actions(actions, 12)


@pytest.mark.parametrize("game", DEFAULTS, ids=repr)
def test_custom_goals_are_solved_too(game: Game) -> None:
    last: RewardFn = lambda obs, action, next_obs: (action == 1).astype(np.float64)  # noqa: E731
    policy = reference_policy(game, last)
    assert policy is not None
    states = wandered_states(game, 30)
    assert (policy(states) == 1).all()


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="there is no goal 'win'; take one of default, corner"):
        reference_policy(Maneuverer(), "win")
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\)"):
        reference_policy(Maneuverer(), gamma=1.0)
    assert reference_policy(Lottery()) is None
