import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from mbagent_envs import Game, GameEnv
from mbagent_envs.drawing import _PAINTERS, BACKGROUNDS, SYMBOLS, Window, cell_pixels, draw_ansi, draw_rgb
from mbagent_envs.game import Scene, Sprite
from tests.envs.helpers import GAMES, wandered_states


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.mark.parametrize("game", GAMES, ids=repr)
def test_different_states_look_different(game: Game) -> None:
    states = np.unique(wandered_states(game, 60).reshape(60, -1), axis=0)
    pictures, texts = [], []
    for flat in states:
        scene = game.scene(flat.reshape(game.observation_space.shape))
        picture = draw_rgb(scene)
        assert picture.dtype == np.uint8
        assert picture.shape == (scene.rows * cell_pixels(scene), scene.columns * cell_pixels(scene), 3)
        pictures.append(picture.tobytes())
        texts.append(draw_ansi(scene))
    assert len(set(pictures)) == len(states)
    assert len(set(texts)) == len(states)


def test_text_shows_each_cell_and_explains_itself() -> None:
    scene = Scene("board", 2, 3, (Sprite("wall", 0, 1), Sprite("target", 1, 2), Sprite("player", 1, 0)))
    assert draw_ansi(scene) == ".#.\n@.*\n# wall  * target  @ player  . free\n"


@pytest.mark.parametrize("kind", SYMBOLS)
def test_every_kind_can_be_seen_on_every_background(kind: str) -> None:
    assert SYMBOLS.keys() == _PAINTERS.keys()
    for background in BACKGROUNDS:
        empty = draw_rgb(Scene(background, 2, 2, ())).astype(int)
        full = draw_rgb(Scene(background, 2, 2, (Sprite(kind, 1, 0),))).astype(int)
        changed = np.abs(full - empty).max(axis=2) > 60
        assert changed[64:, :64].mean() > 0.08
        assert not changed[:64].any()
        assert not changed[:, 64:].any()


def test_the_player_is_where_the_observation_says() -> None:
    """The player is the only coral object."""
    for game in GAMES:
        for obs in wandered_states(game, 5):
            scene = game.scene(obs)
            player = next(s for s in scene.sprites if s.kind.startswith("player"))
            coral = np.argwhere(np.abs(draw_rgb(scene).astype(int) - (240, 100, 73)).max(axis=2) < 12)
            cell = cell_pixels(scene)
            np.testing.assert_allclose(coral.mean(axis=0) / cell, (player.row + 0.5, player.column + 0.5), atol=0.2)


def test_large_boards_stay_of_a_size_for_screens() -> None:
    assert draw_rgb(Scene("sky", 40, 60, ())).shape == (640, 960, 3)
    assert cell_pixels(Scene("sky", 3, 10, ())) == 64


def test_drawing_never_changes_what_was_drawn_before() -> None:
    scene = Scene("board", 2, 2, (Sprite("player", 0, 0),))
    first = draw_rgb(scene)
    kept = first.copy()
    first[:] = 0
    np.testing.assert_array_equal(draw_rgb(scene), kept)


def test_a_window_shows_the_picture_upright() -> None:
    import pygame  # noqa: PLC0415 -- the test of a module that must be optional

    window = Window("test", fps=1000)
    picture = np.zeros((32, 48, 3), dtype=np.uint8)
    picture[3, 40] = (255, 0, 0)
    window.show(picture)
    window.show(picture)
    surface = pygame.display.get_surface()
    assert surface is not None
    assert surface.get_size() == (48, 32)
    assert tuple(surface.get_at((40, 3)))[:3] == (255, 0, 0)
    window.close()
    window.close()


def test_environments_open_their_window_late_and_close_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(GameEnv.metadata, "render_fps", 1000)
    env = gym.make("mbagent/FlierCatcher-v0", render_mode="human")
    env.reset(seed=0)
    env.step(0)
    assert env.render() is None
    env.close()
    env.close()


def test_a_missing_pygame_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    missing: Any = None
    monkeypatch.setitem(sys.modules, "pygame", missing)
    env = gym.make("mbagent/Maneuverer-v0", render_mode="human")
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'pip install "mbagent\[drawing\]"'):
        env.reset(seed=0)
    gym.make("mbagent/Maneuverer-v0", render_mode="rgb_array").reset(seed=0)
