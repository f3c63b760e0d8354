"""Forecasts several steps ahead, iterated and direct, and their training data."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models import NeuralConfig, NeuralTransitionModel, SimulatorModel
from mbagent.models.neural.forecasts import (
    DirectForecastModel,
    iterate,
    longest_string,
    number_strings,
    random_strings,
    steps_apart,
)
from mbagent.models.neural.networks import FactorCodec
from mbagent.models.registry import build_direct, build_string
from mbagent.spaces import FactoredSpace
from mbagent_envs import FlierCatcher, GeyserRunner, Maneuverer
from mbagent_envs.random_keys import derive
from tests.models.helpers import QUICK, dataset, played
from tests.worlds import TableWorld

WORLD = TableWorld(np.eye(5)[(np.arange(5)[:, None] + np.array([1, 2])) % 5])
"""A ring of five states: action 0 moves by one state, action 1 by two."""


def ring_data(n: int = 600, episode_length: int = 20) -> TransitionDataset:
    rng = np.random.default_rng(0)
    actions = rng.integers(2, size=n)
    states = np.zeros(n, dtype=np.int64)
    for t in range(1, n):
        states[t] = rng.integers(5) if t % episode_length == 0 else (states[t - 1] + 1 + actions[t - 1]) % 5
    following = (states + 1 + actions) % 5
    return dataset((5,), 2, states[:, None], actions, following[:, None], episode_length=episode_length)


def ring_model(steps: tuple[int, ...] = (2, 4)) -> DirectForecastModel:
    config = NeuralConfig(hidden=(32,), training=QUICK)
    return DirectForecastModel(
        NeuralTransitionModel((5,), 2, config),
        lambda n: NeuralTransitionModel((5,), 2, config, n_steps=n),
        steps,
    )


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_strings_are_numbered_as_the_networks_read_them(n: int) -> None:
    strings = random_strings(derive(3, np.arange(50)), n, 4)
    assert strings.min() >= 0
    assert strings.max() < 4
    steps = FactorCodec((2, 2), 4, n).action_steps(torch.from_numpy(number_strings(strings, 4)))
    np.testing.assert_array_equal(torch.stack(steps, dim=1).numpy(), strings)


def test_strings_too_long_to_be_numbered_are_refused() -> None:
    assert longest_string(4) == 31
    with pytest.raises(ValueError, match="at most 31"):
        number_strings(np.zeros((1, 32), dtype=np.int64), 4)
    with pytest.raises(ValueError, match="up to 62"):
        ring_model((63,))
    with pytest.raises(ValueError, match=r"actions 0 ... 3, got 2 ... 4"):
        number_strings(np.array([[2, 4]]), 4)
    with pytest.raises(ValueError, match="2 or more"):
        ring_model((1,))


def test_states_several_steps_apart_are_from_one_episode() -> None:
    # Two episodes, their rows interleaved as two environments give them: 0 1 2 3 (cut off) and 5 6 7 (terminated at 7).
    rows = [(0, 0, 1, 0, 0), (5, 1, 6, 0, 1), (1, 1, 2, 0, 0), (6, 1, 7, 1, 1), (2, 0, 3, 0, 0)]
    states, actions, following, ends, episodes = np.array(rows).T
    data = TransitionDataset((8,), 2)
    given = (states[:, None], actions, following[:, None], ends.astype(np.bool_), np.zeros(5), episodes)
    data.append(TransitionBatch(*given))
    apart = steps_apart(data, 2).rows()
    found = {
        int(s): (int(a), int(t), bool(e))
        for s, a, t, e in zip(apart.states[:, 0], apart.actions, apart.next_states[:, 0], apart.terminated, strict=True)
    }
    assert found[0] == (0 + 2 * 1, 2, False)
    assert found[1] == (1 + 2 * 0, 3, False)
    assert found[5] == (1 + 2 * 1, 7, True)
    assert found[6][0] % 2 == 1  # its first action; the one after termination is random
    assert found[6][1:] == (7, True)
    assert 2 not in found  # truncated: the outcome is unknown
    np.testing.assert_array_equal(steps_apart(data, 1).rows().next_states, data.rows().next_states[[0, 2, 4, 1, 3]])
    with pytest.raises(ValueError, match="n = 0"):
        steps_apart(data, 0)


def test_termination_near_the_limit_of_episodes_is_not_overestimated() -> None:
    # An episode ends with probability 0.1 at each step and is cut off after 10; strings of 5 end with 1 - 0.9^5 = 0.41.
    lengths = np.random.default_rng(0).geometric(0.1, size=4000)
    ended, lengths = lengths <= 10, np.minimum(lengths, 10)
    n = int(lengths.sum())
    index = np.arange(n) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    last = index == np.repeat(lengths, lengths) - 1
    states = index[:, None]
    data = TransitionDataset((12,), 2)
    episodes = np.repeat(np.arange(4000), lengths)
    zeros = np.zeros(n, dtype=np.int64)
    data.append(TransitionBatch(states, zeros, states + 1, last & np.repeat(ended, lengths), np.zeros(n), episodes))
    share = steps_apart(data, 5).rows().terminated
    assert abs(share.mean() - (1 - 0.9**5)) < 0.02
    assert len(steps_apart(data, 11)) == 0


def test_iterated_forecasts_equal_single_steps_and_stay_in_terminal_states() -> None:
    strings = random_strings(derive(1, np.arange(40)), 6, 2)
    starts = np.arange(40)[:, None] % 5
    reached, over = iterate(WORLD, starts, strings, derive(2, np.arange(40)))
    np.testing.assert_array_equal(reached[:, 0], (starts[:, 0] + 6 + strings.sum(axis=1)) % 5)
    assert not over.any()
    ending = TableWorld(WORLD.table, ends=(4,))
    reached, over = iterate(ending, np.array([[3], [2]]), np.array([[0, 0, 0], [0, 0, 1]]), derive(2, np.arange(2)))
    assert reached.tolist() == [[4], [4]]
    assert over.all()
    same, nothing = iterate(WORLD, starts, strings[:, :0], derive(2, np.arange(40)))
    np.testing.assert_array_equal(same, starts)
    assert not nothing.any()


def test_models_of_several_steps_learn_a_ring_exactly() -> None:
    model = ring_model()
    progress: list[float] = []
    report = model.fit(ring_data(), seed=1, progress=progress.append)
    assert {"seconds_1_steps", "seconds_2_steps", "seconds_4_steps"} <= set(report.log)
    assert progress == sorted(progress)
    starts = np.arange(60)[:, None] % 5
    for n in (0, 1, 2, 3, 4, 6):  # with a separate model, one step after one, several steps after one
        strings = random_strings(derive(4, np.arange(60), n), n, 2)
        reached, _ = model.forecast(starts, strings, derive(5, np.arange(60)))
        hit = reached[:, 0] == (starts[:, 0] + n + strings.sum(axis=1)) % 5
        assert hit.mean() > 0.9, n


def test_episodes_too_short_for_a_model_leave_it_out() -> None:
    model = ring_model((2, 30))
    model.fit(ring_data(), seed=1)
    strings = random_strings(derive(4, np.arange(30)), 30, 2)
    reached, _ = model.forecast(np.zeros((30, 1), dtype=np.int64), strings, derive(5, np.arange(30)))
    assert (reached[:, 0] == (30 + strings.sum(axis=1)) % 5).mean() > 0.8  # two steps, and 28 single ones


def test_weights_are_kept_and_foreign_ones_refused() -> None:
    model, other = ring_model(), ring_model()
    model.fit(ring_data(200), seed=1)
    other.load_state_dict(model.state_dict())
    strings, keys = random_strings(derive(4, np.arange(30)), 4, 2), derive(5, np.arange(30))
    starts = np.arange(30)[:, None] % 5
    np.testing.assert_array_equal(other.forecast(starts, strings, keys)[0], model.forecast(starts, strings, keys)[0])
    before = other.state_dict()
    for wrong in (ring_model((2,)).state_dict(), {"known": np.array([9])}, {**before, "steps2.predictor.out.bias": np.zeros(3)}):
        with pytest.raises(ValueError, match="weights"):
            other.load_state_dict(wrong)
        after = other.state_dict()
        assert all(np.array_equal(after[name], value) for name, value in before.items())


def test_a_default_fits_any_number_of_actions() -> None:
    space = FactoredSpace(GeyserRunner(width=6).observation_space)
    assert sorted(build_direct(space, 3, 0.02).direct) == list(range(2, 16))
    assert sorted(build_direct(space, 4096, 0.02).direct) == [2, 3, 4, 5]


def test_compiled_networks_of_strings_are_the_trained_ones() -> None:
    space = FactoredSpace(GeyserRunner(width=6).observation_space)
    model = build_string(space, 3, 0.02, n_steps=3)
    model.config = replace(model.config, training=QUICK)
    data = steps_apart(played(GeyserRunner(width=6), 400, 40), 3)
    model.fit(data)
    rows = data.rows().select(np.arange(50))
    with torch.no_grad():
        logits = model.predictor(torch.from_numpy(rows.states), torch.from_numpy(rows.actions))
        expected = torch.softmax(logits, dim=2).numpy()
    np.testing.assert_allclose(model.probabilities(rows.states, rows.actions), expected, atol=1e-5)
    # The probabilities of all joint outcomes sum to one: the conditioner also depends on the string.
    outcomes = (np.arange(2**9)[:, None] >> np.arange(9)) & 1
    many = np.repeat(rows.states[:1], 2 * len(outcomes), axis=0)
    ends = np.repeat([False, True], len(outcomes))
    logs = model.log_prob(many, np.repeat(rows.actions[:1], len(many)), np.tile(outcomes, (2, 1)), ends)
    assert np.exp(logs).sum() == pytest.approx(1.0, abs=1e-6)


def test_on_planes_every_action_of_a_string_has_an_effect() -> None:
    game = Maneuverer(size=4)
    space = FactoredSpace(game.observation_space)
    model = build_string(space, 4, 0.02, n_steps=3)
    states = SimulatorModel(game).start_states(8)
    base = model.probabilities(states, number_strings(np.zeros((8, 3), dtype=np.int64), 4))
    for step in range(3):
        strings = np.zeros((8, 3), dtype=np.int64)
        strings[:, step] = 2
        assert abs(model.probabilities(states, number_strings(strings, 4)) - base).max() > 1e-6, step


@pytest.mark.parametrize("game", [GeyserRunner(), FlierCatcher(height=4, width=5)])
def test_the_direct_model_is_built_for_either_kind_of_observation(game: GeyserRunner | FlierCatcher) -> None:
    space = FactoredSpace(game.observation_space)
    model = build_direct(space, 3, 0.02, steps=(2,))
    states, strings = SimulatorModel(game).start_states(5), random_strings(derive(0, np.arange(5)), 3, 3)
    assert model.forecast(states, strings, derive(1, np.arange(5)))[0].shape == states.shape
    assert model.marginals(states, strings[:, 0]).shape == (5, 2 * len(space))
