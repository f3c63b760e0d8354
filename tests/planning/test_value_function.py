from dataclasses import replace

import numpy as np
import pytest

from mbagent.planning.value_iteration import LOWEST_KNOWN, LeafValues, evaluate, leaf_value

PAIRS = np.array([[0.0, 5.0, 0.0], [5.0, 0.0, 0.25], [0.0, 0.25, 0.0]])
"""Features: the first factor is 1; the second is 0; the second is 2. (Value 3 of the second was never observed.)"""


def leaf(pairs: np.ndarray) -> LeafValues:
    column = np.array([-1, 0, 1, -1, 2, -1])
    return LeafValues(np.array([0, 1]), np.array([0, 2]), column, 0.5, np.array([1.0, 10.0, 20.0]), pairs, 0.0, 22.0)


@pytest.mark.parametrize(
    ("state", "alone", "together"),
    [((0, 1), 0.5, 0.5), ((1, 1), 1.5, 1.5), ((1, 0), 11.5, 16.5), ((1, 2), 21.5, 21.5), ((0, 3), 0.5, 0.5), ((1, 3), 1.5, 1.5)],
)
def test_values_are_sums_over_features_and_pairs(state: tuple[int, int], alone: float, together: float) -> None:
    assert leaf_value(leaf(np.zeros((0, 0))), np.array(state)) == alone
    assert leaf_value(leaf(PAIRS), np.array(state)) == together


def test_values_stay_within_bounds() -> None:
    assert leaf_value(replace(leaf(PAIRS), high=3.0), np.array([1, 0])) == 3.0
    assert leaf_value(replace(leaf(PAIRS), low=2.0), np.array([0, 1])) == 2.0


def test_skipped_states_keep_their_values() -> None:
    states, v = np.array([[0, 1], [1, 0], [1, 1]]), np.full(3, -1.0)
    evaluate(leaf(PAIRS), states, np.array([False, True, False]), v)
    np.testing.assert_array_equal(v, [0.5, -1.0, 1.5])
    evaluate(LOWEST_KNOWN, states, np.zeros(3, dtype=np.bool_), v)
    np.testing.assert_array_equal(v, [0.5, -1.0, 1.5])
