import numpy as np
import pytest

from mbagent.analysis.planning_benchmark.noise import PAIRS_REDRAWN, build_sampler, following, random_inputs
from mbagent.analysis.planning_benchmark.sampling import (
    EVERYTHING,
    compare_short_cut,
    naive_sample,
    pair_variations,
    total_variation,
    using,
)
from mbagent_envs.random_keys import derive


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
    assert 0.0 <= found.pairs <= found.worst_pair <= found.joint <= found.same_luck <= 1.0
