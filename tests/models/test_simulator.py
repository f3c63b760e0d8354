import numpy as np
import pytest

from mbagent.data import TransitionDataset
from mbagent.models import SimulatorModel, TransitionModel
from mbagent_envs import FlierCatcher, Game, GeyserRunner, Maneuverer
from mbagent_envs.random_keys import derive
from tests.models.helpers import played

GAMES = [GeyserRunner(), GeyserRunner(mode="deterministic"), FlierCatcher(height=4, width=5), Maneuverer(size=4)]


def played_pairs(game: Game, n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rows = played(game, 5 * n, 15).rows()
    return rows.states[-n:], rows.actions[-n:]


@pytest.mark.parametrize("game", GAMES, ids=str)
def test_it_steps_as_the_game_does(game: Game) -> None:
    model = SimulatorModel(game)
    assert isinstance(model, TransitionModel)
    states, actions = played_pairs(game)
    keys = derive(np.arange(len(states)), 5)
    following, ends = model.sample(states, actions, keys)
    observations = model.space.decode(states)
    assert np.array_equal(model.space.decode(following), game.transition(observations, actions, keys))
    assert not ends.any()
    assert following.dtype == np.int64


@pytest.mark.parametrize("game", GAMES, ids=str)
def test_successors_are_what_sampling_gives(game: Game) -> None:
    model = SimulatorModel(game)
    states, actions = played_pairs(game)
    found = model.successors(states, actions, 16, seed=0)
    assert np.bincount(found.rows, weights=found.probabilities) == pytest.approx(np.ones(len(states)))
    for row in range(10):
        span = slice(found.offsets[row], found.offsets[row + 1])
        if isinstance(game, Maneuverer) and span.stop - span.start > 1:
            continue  # a new layout: too many to list
        shares = dict.fromkeys(map(bytes, found.states[span]), 0.0)
        drawn, _ = model.sample(np.tile(states[row], (4000, 1)), np.full(4000, actions[row]), np.random.default_rng(row))
        for one in drawn:
            shares[bytes(one)] += 1 / 4000
        assert list(shares.values()) == pytest.approx(found.probabilities[span].tolist(), abs=0.04)


def test_marginals_and_log_probabilities_are_exact() -> None:
    game = GeyserRunner(width=10)
    model = SimulatorModel(game)
    states, actions = played_pairs(game)
    assert model.marginals(states, actions).reshape(len(states), -1, 2)[:, 10:, 1] == pytest.approx(
        np.full((len(states), 5), 0.2)
    )
    following, ends = model.sample(states, actions, np.random.default_rng(0))
    assert model.log_prob(states, actions, following, ends) == pytest.approx(np.full(len(states), np.log(0.2)))
    assert np.isneginf(model.log_prob(states, actions, following, ~ends)).all()


def test_there_is_nothing_to_learn_and_nothing_to_save() -> None:
    model = SimulatorModel(GeyserRunner())
    assert model.fit(TransitionDataset(model.cardinalities, model.n_actions)).epochs == 0
    assert model.state_dict() == {}
    model.load_state_dict({})
    with pytest.raises(ValueError, match="no weights"):
        model.load_state_dict({"x": np.zeros(1)})
    none = model.successors(np.zeros((0, 15), dtype=np.int64), np.zeros(0, dtype=np.int64), 8, 0)
    assert none.offsets.tolist() == [0]


def test_moments_of_the_true_geyser_runner_are_exact_within_sampling_error() -> None:
    model, n_samples = SimulatorModel(GeyserRunner()), 4000
    states = np.repeat(model.reachable_mdp(model.start_states(64)).states, 3, axis=0)
    actions = np.tile(np.arange(3), 50)
    mean, variance = model.moments(states, actions, n_samples=n_samples)
    p = model.marginals(states, actions)[:, 1::2]  # exact probability that each bit is 1
    assert abs(mean - p).max() < 6 * np.sqrt(0.25 / n_samples)
    assert abs(variance - p * (1 - p)).max() < 6 * np.sqrt(0.25 / n_samples)
    # Moments of a function: the position of the next eruption, uniform over five columns.
    mean, variance = model.moments(states, actions, of=lambda s: s[:, 10:].argmax(axis=1).astype(np.float64), n_samples=n_samples)
    assert mean.shape == (150,)
    assert abs(mean - 2.0).max() < 6 * np.sqrt(2.0 / n_samples)
    assert abs(variance - 2.0).max() < 0.25


def test_a_single_draw_has_no_moments() -> None:
    model = SimulatorModel(GeyserRunner())
    with pytest.raises(ValueError, match="at least 2 draws"):
        model.moments(model.start_states(2), np.zeros(2, dtype=np.int64), n_samples=1)
