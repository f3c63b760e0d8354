import numpy as np

from mbagent_envs.random_keys import derive
from worlds.nonstationary import mirrored_control, other_fliers, other_geysers


def test_changed_games_follow_other_rules_in_the_same_states() -> None:
    before, after = other_geysers()
    obs = before.initial(derive(1, np.arange(4)))
    stay = np.ones(4, dtype=np.int64)
    place = [game.transition(obs, stay, derive(2, np.arange(4)))[:, 10:].argmax(axis=1) for game in (before, after)]
    start = obs[:, 10:].argmax(axis=1)
    np.testing.assert_array_equal((place[0] - start) % 5, 2)
    np.testing.assert_array_equal((start - place[1]) % 5, 2)
    before, after = other_fliers()
    obs = np.zeros((1, 2, 6, 10), dtype=np.int8)
    obs[0, 0, 3, 0] = obs[0, 1, 2, 5] = 1
    moved = after.transition(obs, np.ones(1, dtype=np.int64), derive(2, np.arange(1)))
    assert moved[0, 1, 2, 6] == 1
    assert moved[0, 0].sum() == 1
    before, after = mirrored_control()
    obs = before.initial(derive(5, np.arange(50)))
    up, down = np.zeros(50, dtype=np.int64), np.full(50, 2)
    np.testing.assert_array_equal(
        after.transition(obs, up, derive(1, np.arange(50))), before.transition(obs, down, derive(1, np.arange(50)))
    )
