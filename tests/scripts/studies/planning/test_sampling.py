import numpy as np
import pytest

from mbagent_envs.random_keys import derive
from studies.planning.sampling import (
    EVERYTHING,
    TRUSTED,
    compare_short_cut,
    naive_sample,
    pair_variations,
    total_variation,
    upper_limit,
    using,
)
from worlds.synthetic_dbn import PAIRS_REDRAWN, build_sampler, following, random_inputs


def test_actions_leave_as_many_bits_open_as_they_say() -> None:
    rng = np.random.default_rng(0)
    state, _ = random_inputs(32, 1, rng)
    for action, pairs in enumerate(PAIRS_REDRAWN):
        drawn = following(np.tile(state, (400, 1)), np.full(400, action), 0, rng)
        assert (np.ptp(drawn, axis=0) > 0).sum() == 2 * pairs


def test_total_variation_of_known_samples() -> None:
    first = np.array([[0, 0], [0, 0], [1, 1], [1, 1]])
    second = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    assert total_variation(first, first) == 0.0
    assert total_variation(first, second) == pytest.approx(0.5)
    assert pair_variations(first, second) == pytest.approx([0.5])
    assert pair_variations(first, 1 - first) == pytest.approx([0.0])


@pytest.mark.parametrize("sampler", ["networks", "sweeps"])
def test_naive_and_compiled_samplers_draw_from_the_same_distribution(sampler: str) -> None:
    model = build_sampler("networks" if sampler == "networks" else "sweeps", 6, 1)
    assert model.conditioner is not None
    with using(model, EVERYTHING, 6):
        states, actions = np.tile([0, 1, 0, 1, 1, 0], (6000, 1)), np.full(6000, 2)
        fast = np.column_stack(model.sample(states, actions, derive(0, np.arange(6000)))).astype(np.int64)
    slow = naive_sample(model, states, actions, 0)
    assert total_variation(fast, slow) < 0.08


def test_the_short_cut_is_measured_on_equal_terms() -> None:
    model = build_sampler("sweeps", 6, 1)
    before = model.config
    found = compare_short_cut(model, 1, 0, 2, 200)
    assert model.config == before
    assert 0.0 <= found.same_luck <= found.bound <= 1.0
    assert 0.0 <= found.pairs <= found.joint <= 1.0
    assert 0.0 <= found.pairs_floor <= found.floor <= 1.0


def test_the_limit_of_a_share_covers_it_as_often_as_it_says() -> None:
    shares = np.random.default_rng(0).binomial(200, 0.03, size=2000) / 200
    covered = np.mean([upper_limit(share, 200) >= 0.03 for share in shares])
    assert 0.94 < covered <= 1.0
    assert upper_limit(0.0, 1000) == pytest.approx(3.0 / 1000, rel=0.01)  # the rule of three
    assert upper_limit(1.0, 10) == 1.0


@pytest.mark.parametrize("sweeps", [1, 3])
def test_the_short_cut_draws_what_the_full_sweep_draws_where_the_conditioner_agrees(sweeps: int) -> None:
    model = build_sampler("sweeps", 8, 1)  # the untrained conditioner has no effect
    weights = {name: array * 4.0 if name == "predictor.stay" else array for name, array in model.state_dict().items()}
    model.load_state_dict(weights)
    states, actions = random_inputs(8, 3000, np.random.default_rng(0))
    assert (model.probabilities(states, actions).max(axis=2) >= TRUSTED).mean() > 0.5
    draws = []
    for certain in (EVERYTHING, TRUSTED):
        with using(model, certain, sweeps):
            draws.append(np.column_stack(model.sample(states, actions, derive(0, np.arange(3000)))))
    np.testing.assert_array_equal(draws[0], draws[1])
