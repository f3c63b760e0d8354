import numpy as np
import pytest

from mbagent.models.dbn import reward_graphs
from mbagent.models.dbn.reward_graphs import class_chances, fit_classes
from tests.models.helpers import dataset


def test_a_class_that_occurs_once_is_learned_from_a_sample_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reward_graphs, "MOST_REWARD_ENTRIES", 200)
    rng, n = np.random.default_rng(0), 400
    states = rng.integers(2, size=(n, 3))
    classes = states[:, 0] & states[:, 1]
    classes[201] = 2
    rows = dataset((2, 2, 2), 1, states, np.zeros(n, dtype=np.int64), states).rows()
    graphs = fit_classes(rows, classes, (2, 2, 2), (1,), None)
    assert graphs.classes.tolist() == [1, 2]
    chances = class_chances(graphs, 3, states, np.zeros(n, dtype=np.int64), states)
    np.testing.assert_array_equal(chances[:, 1] > 0.5, (states[:, 0] & states[:, 1]) == 1)
