import numpy as np
import pytest
import torch
from gymnasium import spaces

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models import FactorCodec, NeuralConfig, NeuralTransitionModel, TrainingConfig
from mbagent.models.neural.networks import PlanePredictor
from mbagent.models.registry import build_networks
from mbagent.spaces import FactoredSpace
from mbagent_envs.maneuverer import Maneuverer
from mbagent_envs.random_keys import derive, uniforms

SPACES = {
    "bits": spaces.MultiBinary((2, 4, 5)),
    "bits, channels last": spaces.MultiBinary((5, 4, 2)),
    "values": spaces.Box(0, 3, (2, 3, 4), dtype=np.uint8),
    "values, channels last": spaces.Box(0, 2, (4, 3, 2), dtype=np.uint8),
    "one plane": spaces.Box(0, 1, (4, 4), dtype=np.uint8),
}


def body_for(space: FactoredSpace, seed: int = 0) -> PlanePredictor:
    assert space.planes is not None
    codec = FactorCodec(space.cardinalities, 3)
    return PlanePredictor(codec, space.planes, generator=torch.Generator().manual_seed(seed))


def states_of(space: FactoredSpace, n: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, space.cardinalities, size=(n, len(space)))


@pytest.mark.parametrize("name", SPACES)
def test_a_row_does_not_depend_on_other_rows(name: str) -> None:
    space = FactoredSpace(SPACES[name])
    model = build_networks(space, 3, 0.01)
    states, actions = states_of(space, 19), np.arange(19) % 3
    keys = derive(np.arange(19), 5)
    together = model.marginals(states, actions), *model.sample(states, actions, keys)
    for i in range(19):
        row = slice(i, i + 1)
        alone = model.marginals(states[row], actions[row]), *model.sample(states[row], actions[row], keys[row])
        for one, many in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], many[i])


def test_predictions_are_translation_equivariant() -> None:
    # Shared weights: far from the border, the prediction for a pattern shifted by a cell is shifted by a cell.
    space = FactoredSpace(spaces.MultiBinary((1, 12, 12)))
    body = body_for(space)
    plane = np.zeros((2, 1, 12, 12), dtype=np.int64)
    plane[0, 0, 5, 5] = plane[0, 0, 5, 6] = plane[1, 0, 6, 5] = plane[1, 0, 6, 6] = 1
    with torch.no_grad():
        logits = body(torch.from_numpy(plane.reshape(2, -1)), torch.zeros(2, dtype=torch.long))[:, :-1, 1]
    first, second = logits.numpy().reshape(2, 12, 12)
    np.testing.assert_allclose(first[3:8, 3:9], second[4:9, 3:9], atol=1e-5)


def explore(game: Maneuverer, n: int, seed: int) -> TransitionBatch:
    """Random play in ``n`` // 50 episodes of 50 steps."""
    episodes = np.arange(n // 50)
    keys = derive(np.full(len(episodes), seed), episodes)
    obs, steps = game.initial(keys), []
    for t in range(50):
        actions = (uniforms(derive(keys, 7, t), 1)[:, 0] * 4).astype(np.int64)
        following = game.transition(obs, actions, derive(keys, t))
        flat = (obs.reshape(len(obs), -1).astype(np.int64), following.reshape(len(obs), -1).astype(np.int64))
        none = np.zeros(len(obs))
        steps.append(TransitionBatch(flat[0], actions, flat[1], none.astype(bool), none, episodes))
        obs = following
    names = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
    return TransitionBatch(*(np.concatenate([getattr(step, name) for step in steps]) for name in names))


def test_the_effect_of_walls_generalises_to_new_layouts() -> None:
    game = Maneuverer(size=5)
    space = FactoredSpace(game.observation_space)
    data = TransitionDataset(space.cardinalities, 4)
    data.append(explore(game, 3000, seed=1))
    planes = space.planes
    assert planes is not None
    config = NeuralConfig(conditioner=None, training=TrainingConfig(batch_size=128, min_steps=700, max_steps=700))
    model = NeuralTransitionModel(
        space.cardinalities, 4, config, body=lambda codec, generator: PlanePredictor(codec, planes, generator=generator)
    )
    report = model.fit(data)
    unseen = explore(game, 2000, seed=2)
    cells = unseen.states.reshape(-1, 3, 25)
    quiet = ~(cells[:, 0] & cells[:, 2]).any(axis=1)  # where the target was reached, a new layout is drawn
    probabilities = model.probabilities(unseen.states, unseen.actions)
    right = (probabilities[:, :-1].argmax(axis=2) == unseen.next_states).all(axis=1)
    assert right[quiet].mean() > 0.95
    assert probabilities[:, -1, 1].max() < 0.01  # nothing ever terminates
    assert report.exact_match is not None
    assert report.exact_match > 0.85
