"""Pictures of scenes: pixels, characters, or a window. Independent of the rules of the games.

Shapes are signed distances (negative inside) in units of a cell, which gives smooth edges without supersampling.
The tile of each kind of object is painted once and then copied, so a frame takes a few dozen microseconds per
object.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from mbagent_envs.game import Scene

Picture = npt.NDArray[np.uint8]
_Plane = npt.NDArray[np.float64]
_Colour = tuple[int, int, int]

INK: _Colour = (52, 58, 74)
WHITE: _Colour = (255, 255, 255)
CORAL, CORAL_DARK = (240, 100, 73), (196, 70, 50)
GOLD, GOLD_DARK = (247, 190, 60), (205, 140, 30)
BLUE, BLUE_DARK = (64, 120, 200), (42, 84, 150)
WATER, WATER_LIGHT = (86, 178, 232), (214, 240, 252)
GRASS, EARTH, EARTH_DARK = (122, 180, 96), (164, 124, 88), (120, 86, 60)
WALL, WALL_LIGHT, WALL_DARK = (86, 98, 122), (116, 130, 156), (60, 69, 90)
BACKGROUNDS: dict[str, tuple[_Colour, _Colour]] = {
    "board": ((250, 246, 238), (243, 237, 226)),
    "sky": ((232, 243, 251), (226, 239, 249)),
}
"""The two colours of each background's chequered cells."""

SYMBOLS: dict[str, tuple[str, str]] = {
    "player": ("@", "player"),
    "player scoring": ("&", "player, scoring"),
    "player hit": ("X", "player, hit"),
    "wall": ("#", "wall"),
    "target": ("*", "target"),
    "flier": ("<", "flier"),
    "flag": (".", ""),
    "ground": ("=", "safe ground"),
    "vent": ("o", "geyser at rest"),
    "open vent": ("O", "geyser erupting"),
    "geyser": ("|", "water"),
    "geyser top": ("'", "water"),
}
"""For each kind its character and its name in the legend; a cell with nothing on it is a dot."""


class _Tile:
    """One cell being painted: colour and opacity, float64 in [0, 1].

    ``x``, ``y`` are the pixel centres in cells from the middle, y downwards.
    """

    def __init__(self, cell: int) -> None:
        centres = (np.arange(cell) + 0.5) / cell - 0.5
        self.cell = cell
        self.x, self.y = np.meshgrid(centres, centres)
        self.colour = np.zeros((cell, cell, 3))
        self.opacity = np.zeros((cell, cell))

    def fill(self, distance: _Plane, colour: _Colour, opacity: float = 1.0) -> None:
        """Paint where ``distance`` is negative, over earlier colours."""
        cover = np.clip(0.5 - distance * self.cell, 0.0, 1.0) * opacity
        total = cover + self.opacity * (1 - cover)
        share = np.divide(cover, total, out=np.zeros_like(cover), where=total > 0)[..., None]
        self.colour = self.colour * (1 - share) + np.array(colour) / 255 * share
        self.opacity = total

    def circle(self, x: float, y: float, radius: float) -> _Plane:
        """Return the signed distance of each pixel from a circle, in cells; negative inside."""
        distance: _Plane = np.hypot(self.x - x, self.y - y) - radius
        return distance

    def ellipse(self, x: float, y: float, across: float, down: float) -> _Plane:
        """Return the approximate distance from an ellipse with these half axes."""
        distance: _Plane = (np.hypot((self.x - x) / across, (self.y - y) / down) - 1) * min(across, down)
        return distance

    def box(self, x: float, y: float, across: float, down: float, corner: float = 0.0) -> _Plane:
        """Return the distance from a box with these half sides and rounded corners."""
        dx, dy = abs(self.x - x) - across + corner, abs(self.y - y) - down + corner
        distance: _Plane = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0) - corner
        return distance

    def star(self, points: int, outer: float, inner: float, turn: float = 0.0) -> _Plane:
        """Return the distance from the sides of a star around the middle, pointing up when ``turn`` is 0."""
        sector = math.pi / points
        angle = np.arctan2(self.x, -self.y) + turn
        angle = np.abs((angle + sector) % (2 * sector) - sector)
        along, aside = np.hypot(self.x, self.y) * np.cos(angle), np.hypot(self.x, self.y) * np.sin(angle)
        tip, dent = np.array([outer, 0.0]), inner * np.array([math.cos(sector), math.sin(sector)])
        normal = np.array([dent[1] - tip[1], tip[0] - dent[0]])
        normal /= np.linalg.norm(normal)
        distance: _Plane = (along - tip[0]) * normal[0] + (aside - tip[1]) * normal[1]
        return distance


def _player(tile: _Tile) -> None:
    tile.fill(tile.ellipse(0, 0.33, 0.24, 0.05), INK, 0.18)
    tile.fill(tile.circle(0, 0, 0.31), CORAL_DARK)
    tile.fill(tile.circle(0, -0.012, 0.28), CORAL)
    tile.fill(tile.ellipse(-0.09, -0.15, 0.1, 0.06), WHITE, 0.35)
    for x in (-0.1, 0.1):
        tile.fill(tile.ellipse(x, -0.04, 0.058, 0.078), WHITE)
        tile.fill(tile.circle(x + 0.012, -0.025, 0.034), INK)
    smile = np.maximum(np.abs(tile.circle(0, 0.05, 0.105)) - 0.017, 0.085 - tile.y)
    tile.fill(smile, INK)


def _player_scoring(tile: _Tile) -> None:
    tile.fill(tile.star(10, 0.5, 0.36), GOLD_DARK)
    tile.fill(tile.star(10, 0.465, 0.345), GOLD)
    tile.fill(tile.circle(0, 0, 0.345), (255, 240, 200))
    _player(tile)


def _player_hit(tile: _Tile) -> None:
    tile.fill(tile.star(9, 0.5, 0.34), BLUE_DARK)
    tile.fill(tile.star(9, 0.45, 0.32), WATER_LIGHT)
    tile.fill(tile.circle(0, 0, 0.31), CORAL_DARK)
    tile.fill(tile.circle(0, -0.012, 0.28), CORAL)
    for x in (-0.1, 0.1):  # crossed-out eyes
        dx, dy = tile.x - x, tile.y + 0.05
        for slope in (1, -1):
            tile.fill(np.maximum(np.abs(dx + slope * dy) / math.sqrt(2) - 0.016, np.hypot(dx, dy) - 0.07), INK)
    tile.fill(tile.ellipse(0, 0.13, 0.06, 0.075), INK)


def _wall(tile: _Tile) -> None:
    tile.fill(tile.box(0, 0, 0.5, 0.5, 0.06), WALL_DARK)
    tile.fill(tile.box(0, -0.02, 0.475, 0.455, 0.05), WALL)
    for y, shift in ((-0.31, 0.0), (0.0, 0.5), (0.31, 0.0)):  # three courses of bricks
        for x in (-0.5, 0.0, 0.5):
            brick = tile.box(x + shift / 2, y - 0.02, 0.225, 0.125, 0.03)
            tile.fill(np.maximum(brick, tile.box(0, -0.02, 0.45, 0.43, 0.05)), WALL_LIGHT)


def _target(tile: _Tile) -> None:
    tile.fill(tile.circle(0, 0, 0.45), GOLD_DARK)
    tile.fill(tile.circle(0, 0, 0.42), (255, 240, 200))
    tile.fill(tile.star(5, 0.36, 0.155), GOLD_DARK)
    tile.fill(tile.star(5, 0.31, 0.132), GOLD)


def _flier(tile: _Tile) -> None:
    for y, x, length in (
        (-0.1, 0.41, 0.07),
        (0.02, 0.43, 0.06),
        (0.13, 0.4, 0.08),
    ):  # the air it leaves behind
        tile.fill(tile.box(x, y, length, 0.014, 0.014), BLUE, 0.5)
    nose = np.maximum(np.abs(tile.y) * 0.86 - (tile.x + 0.47) * 0.75, tile.x)
    for grow, colour in ((0.0, BLUE_DARK), (0.03, BLUE)):
        body = np.minimum(tile.box(0.06, 0, 0.27, 0.2, 0.06), np.maximum(nose, np.abs(tile.y) - 0.2))
        tile.fill(body + grow, colour)
    tile.fill(tile.box(0.1, -0.09, 0.17, 0.035, 0.03), WHITE, 0.4)
    tile.fill(tile.circle(-0.15, -0.03, 0.055), WHITE)
    tile.fill(tile.circle(-0.165, -0.03, 0.03), INK)


def _ground(tile: _Tile) -> None:
    tile.fill(tile.box(0, 0, 0.6, 0.6), EARTH)
    tile.fill(tile.y + 0.5 - 0.17 - 0.025 * np.cos(tile.x * 6 * math.pi), GRASS)
    for x, y, radius in ((-0.28, 0.08, 0.05), (0.2, 0.25, 0.06), (0.3, -0.08, 0.04), (-0.1, 0.33, 0.04)):
        tile.fill(tile.ellipse(x, y, radius, radius * 0.7), EARTH_DARK, 0.45)


def _vent(tile: _Tile, inside: _Colour = INK) -> None:
    stone, stone_dark = (150, 150, 158), (112, 112, 122)
    tile.fill(tile.box(0, 0, 0.6, 0.6), EARTH)
    tile.fill(tile.y + 0.5 - 0.12, stone_dark)
    tile.fill(tile.y + 0.5 - 0.09, stone)
    shaft = 0.1 + 0.12 * np.clip(-tile.y - 0.1, 0, 1) ** 2
    tile.fill(np.maximum(np.abs(tile.x) - shaft - 0.05, tile.y - 0.5), stone_dark)
    tile.fill(np.abs(tile.x) - shaft, inside)


def _open_vent(tile: _Tile) -> None:
    _vent(tile, WATER)
    tile.fill(np.abs(tile.x + 0.02 * np.sin(tile.y * 12)) - 0.045, WATER_LIGHT)


def _column(tile: _Tile, half: _Plane) -> None:
    """Paint rising water with half width ``half`` around the middle of the tile."""
    wave = 0.02 * np.sin(tile.y * 4 * math.pi)
    tile.fill(np.abs(tile.x + wave) - half, BLUE)
    tile.fill(np.abs(tile.x + wave) - half + 0.03, WATER)
    for x, width in ((-0.1, 0.03), (0.03, 0.045), (0.14, 0.02)):
        tile.fill(np.abs(tile.x - x + 1.5 * wave) - width, WATER_LIGHT, 0.9)


def _geyser(tile: _Tile) -> None:
    _column(tile, 0.22 + 0.04 * np.clip(-tile.y, -0.5, 0.5))


def _geyser_top(tile: _Tile) -> None:
    column = _Tile(tile.cell)
    _column(column, np.full_like(column.x, 0.24))
    below = np.clip((column.y + 0.12) * column.cell, 0, 1)  # the column ends in the crown of foam
    tile.colour, tile.opacity = column.colour, column.opacity * below
    foam = (
        (-0.27, -0.02, 0.15),
        (0.27, -0.02, 0.15),
        (-0.13, -0.14, 0.17),
        (0.14, -0.14, 0.17),
        (0.0, -0.06, 0.18),
    )
    for grow, colour in ((0.03, BLUE), (0.0, WATER_LIGHT)):
        for x, y, radius in foam:
            tile.fill(tile.circle(x, y, radius + grow), colour)
    for x, y, radius in ((-0.36, -0.3, 0.045), (0.3, -0.4, 0.04), (0.02, -0.41, 0.05), (0.41, -0.25, 0.035)):
        tile.fill(tile.ellipse(x, y, radius, radius * 1.3), WATER)


def _flag(tile: _Tile) -> None:
    tile.fill(tile.box(-0.2, 0.05, 0.022, 0.45, 0.02), INK)
    cloth = np.maximum(-0.19 - tile.x, np.abs(tile.y + 0.22) - 0.18 + (tile.x + 0.18) * 0.33)
    tile.fill(cloth, GOLD_DARK)
    tile.fill(cloth + 0.025, GOLD)


_PAINTERS: dict[str, Callable[[_Tile], None]] = {
    "player": _player,
    "player scoring": _player_scoring,
    "player hit": _player_hit,
    "wall": _wall,
    "target": _target,
    "flier": _flier,
    "flag": _flag,
    "ground": _ground,
    "vent": _vent,
    "open vent": _open_vent,
    "geyser": _geyser,
    "geyser top": _geyser_top,
}


@functools.lru_cache(maxsize=256)
def _tile(kind: str, cell: int) -> tuple[_Plane, _Plane]:
    """Return a kind's colour times opacity in 0 ... 255, ``[cell, cell, 3]``, and 1 - opacity."""
    tile = _Tile(cell)
    _PAINTERS[kind](tile)
    opacity = tile.opacity[..., None]
    return tile.colour * opacity * 255, 1 - opacity


@functools.lru_cache(maxsize=16)
def _background(kind: str, rows: int, columns: int, cell: int) -> Picture:
    light, dark = BACKGROUNDS[kind]
    chequers = np.indices((rows, columns)).sum(axis=0) % 2
    cells = np.where(chequers[..., None] == 0, np.array(light), np.array(dark)).astype(np.uint8)
    return cells.repeat(cell, axis=0).repeat(cell, axis=1)


def cell_pixels(scene: Scene) -> int:
    """Return the side of a cell in pixels: 64, less for large boards, always a multiple of 8."""
    return int(np.clip(960 // max(scene.rows, scene.columns) // 8 * 8, 8, 64))


def draw_rgb(scene: Scene) -> Picture:
    """Draw a scene as a new uint8 array ``[rows * cell, columns * cell, 3]``, ``cell`` from `cell_pixels`."""
    cell = cell_pixels(scene)
    picture = _background(scene.background, scene.rows, scene.columns, cell).copy()
    for sprite in scene.sprites:
        colour, rest = _tile(sprite.kind, cell)
        top, left = sprite.row * cell, sprite.column * cell
        place = picture[top : top + cell, left : left + cell]
        place[...] = colour + place * rest + 0.5
    return picture


def draw_ansi(scene: Scene) -> str:
    """Draw a scene as text: a character for each cell, and a last line that explains them."""
    cells = np.full((scene.rows, scene.columns), ".")
    for sprite in scene.sprites:
        cells[sprite.row, sprite.column] = SYMBOLS[sprite.kind][0]
    shown = {SYMBOLS[s.kind]: None for s in scene.sprites if SYMBOLS[s.kind][1] and SYMBOLS[s.kind][0] in cells}
    legend = "  ".join([f"{symbol} {name}" for symbol, name in shown] + [". free"])
    return "\n".join(["".join(row) for row in cells] + [legend]) + "\n"


class Window:
    """A window on the screen that shows pictures at a steady rate.

    Args:
        title: text of the title bar.
        fps: pictures per second; `show` waits accordingly.

    Raises:
        gymnasium.error.DependencyNotInstalled: if pygame is missing.
    """

    def __init__(self, title: str, fps: int) -> None:
        try:
            import pygame  # noqa: PLC0415 -- an optional dependency, needed for windows only
        except ImportError as error:
            raise gym.error.DependencyNotInstalled('render_mode="human" needs pygame: pip install "mbagent[drawing]"') from error
        self._pygame: Any = pygame
        self._title, self._fps = title, fps
        self._clock = pygame.time.Clock()

    def show(self, picture: Picture) -> None:
        """Show ``picture``, uint8 ``[height, width, 3]``, opening the window the first time."""
        pygame, size = self._pygame, (picture.shape[1], picture.shape[0])
        screen = pygame.display.get_surface()
        if screen is None or screen.get_size() != size:  # pygame has only one window, which another Window may be using
            pygame.display.init()
            screen = pygame.display.set_mode(size)
        pygame.display.set_caption(self._title)
        screen.blit(pygame.surfarray.make_surface(picture.transpose(1, 0, 2)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
