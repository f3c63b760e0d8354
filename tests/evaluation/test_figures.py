import io

import matplotlib as mpl
import numpy as np
import pytest

from mbagent.evaluation.figures import Line, Panel, draw_panels


def shows(png: bytes, colour: str) -> bool:
    """Whether a picture has pixels of nearly that colour: thin lines are blended with the background."""
    pixels = np.asarray(mpl.image.imread(io.BytesIO(png), format="png"))[..., :3].reshape(-1, 3)
    return bool((np.abs(pixels - mpl.colors.to_rgb(colour)).max(axis=1) < 0.15).any())


def test_every_line_is_drawn_in_its_colour() -> None:
    curve = Line([1, 2, 4], [0.1, 0.5, 0.4], "#d1495b", "a curve", error=[0.1, 0.1, 0.1])
    level = Line((), [0.3], "#00798c")
    both = draw_panels([Panel("a title", [curve, level], "x", "y", "log2", x_ticks={1: "one", 4: "four"})])
    assert shows(both, "#d1495b")
    assert shows(both, "#00798c")
    assert not shows(draw_panels([Panel("a title", [curve])]), "#00798c")


@pytest.mark.parametrize(("n", "columns"), [(1, None), (2, 3), (5, 2)])
def test_panels_fill_a_grid(n: int, columns: int | None) -> None:
    line = Line([1.0, 10.0], [1.0, 2.0], "C0", "same", band=([0.5, 1.5], [1.5, 2.5]))
    panels = [Panel(f"panel {i}", [line], y_scale="log", y_limits=(0.1, None)) for i in range(n)]
    assert draw_panels(panels, columns=columns, legend="below").startswith(b"\x89PNG")
