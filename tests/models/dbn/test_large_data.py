"""More transitions than can be searched at once: all are counted in parts, and contexts with both outcomes are searched."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import data as data_module
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel, large_data
from mbagent.models.dbn import model as graph_model
from mbagent.models.dbn.plane_features import NEXT, NEXT_ADJACENCY, Reach, feature_values, relative_features, values_at
from mbagent.spaces import FactoredSpace
from mbagent.wrappers import History
from mbagent_envs import Maneuverer
from tests.models.helpers import played


def test_features_of_some_cells_equal_those_of_all_cells() -> None:
    rng = np.random.default_rng(0)
    planes, actions = rng.integers(2, size=(6, 2, 3, 5)).astype(np.uint8), rng.integers(3, size=6)
    features = relative_features((2, 2), (3,), Reach(1, wrap=True))
    features = features[~np.isin(features[:, 0], (NEXT, NEXT_ADJACENCY))]
    cells = rng.permutation(6 * 15)[:40]
    found = values_at(features, planes, actions, cells // 15, cells % 15 // 5, cells % 5)
    assert np.array_equal(found, feature_values(features, planes, actions)[cells])


@pytest.fixture
def small_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MOST_TABLE_ENTRIES", "QUICK_CELLS"):
        monkeypatch.setattr(large_data, name, 60_000)
    monkeypatch.setattr(large_data, "ENTRIES_PER_CHUNK", 100_000)


def likeliest(data: TransitionDataset, tests: TransitionBatch) -> tuple[LocalGraphModel, Any]:
    space = FactoredSpace(Maneuverer(size=4).observation_space)
    model = LocalGraphModel(space, 4, Reach(1))
    report = model.fit(data, seed=0)
    assert 0 < report.log["searched"] <= len(data)
    assert report.log["left out"] == 0
    return model, model.likeliest(tests.states, tests.actions)


def test_small_tables_give_the_same_predictions(request: pytest.FixtureRequest) -> None:
    game = Maneuverer(size=4)
    data, tests = played(game, 2000, 100), played(game, 1000, 100, seed=1).rows()
    model, (states, _) = likeliest(data, tests)
    assert model.fitted.found[0].target.counts.sum() == 2000 * 16
    request.getfixturevalue("small_tables")
    smaller, (others, _) = likeliest(data, tests)
    assert smaller.fitted.found[0].target.counts.sum() == 2000 * 16  # all were counted, although few were searched
    assert (states == others).all(axis=1).mean() > 0.99
    again, _ = likeliest(data, tests)
    assert all(np.array_equal(again.state_dict()[name], part) for name, part in smaller.state_dict().items())


class Drift(gym.Env[Any, Any]):
    """A dot that moves one column to the right every third step, with wrap-around; only the past shows when it moves next."""

    observation_space = spaces.MultiBinary((1, 5, 5))
    action_space = spaces.Discrete(2)

    def _shown(self) -> Any:
        shown = np.zeros((1, 5, 5), dtype=np.int8)
        shown[0, 1, self.time // 3 % 5] = 1
        return shown

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return self._shown(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        return self._shown(), 0.0, False, False, {}


@pytest.mark.usefixtures("small_tables")
def test_past_channels_are_copied_and_predict_moves() -> None:
    env = History(Drift(), 3)
    space, rng, rows = FactoredSpace(env.observation_space), np.random.default_rng(0), []
    for episode in range(20):
        obs, _ = env.reset()
        for _ in range(40):
            action = int(rng.integers(2))
            following, *_ = env.step(action)
            rows.append((obs, action, following, episode))
            obs = following
    now, actions, then, episodes = (np.asarray(part) for part in zip(*rows, strict=True))
    data = TransitionDataset(space.cardinalities, 2)
    states, after = space.encode(now), space.encode(then)
    data.append(TransitionBatch(states, actions, after, np.zeros(len(rows), np.bool_), np.zeros(len(rows)), episodes))
    model = LocalGraphModel(space, 2, Reach(1, wrap=True))
    model.fit(data, seed=0)
    found, _ = model.likeliest(states, actions)
    full_history = np.arange(len(rows)) % 40 >= 3  # before, the past repeats the first observation
    assert (found == after).all(axis=1)[full_history].all()


@pytest.mark.parametrize("flat", [False, True])
def test_rows_in_files_give_the_same_model(flat: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_module, "_MAPPED", 1000)
    space = FactoredSpace(Maneuverer(size=3).observation_space)
    rows, fitted = played(Maneuverer(size=3), 400, 20).rows(), []
    for folder in (None, tmp_path):
        data = TransitionDataset(space.cardinalities, 4, folder)
        for part in rows.parts(150):
            data.append(part)
        model = DecisionGraphModel(space.cardinalities, 4) if flat else LocalGraphModel(space, 4, Reach(1))
        model.fit(data, seed=0)
        fitted.append(model.state_dict())
    assert all(np.array_equal(fitted[0][name], fitted[1][name]) for name in fitted[0])


def test_number_of_ignored_rows_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_model, "MOST_VALUES", 27 * 200)
    monkeypatch.setattr(large_data, "MOST_CELLS_COUNTED", 27 * 150)
    space, data = FactoredSpace(Maneuverer(size=3).observation_space), played(Maneuverer(size=3), 400, 20)
    report = DecisionGraphModel(space.cardinalities, 4).fit(data, seed=0)
    assert report.log["left out"] == 200
    assert report.n_train == 200
    report = LocalGraphModel(space, 4, Reach(1)).fit(data, seed=0)
    assert report.log["left out"] == 250
    assert report.n_train == 400
