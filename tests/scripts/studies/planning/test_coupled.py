import pytest

from studies.planning import coupled
from studies.planning.coupled import compare_values
from worlds.coupled import corridor


def test_the_comparison_has_a_row_for_each_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coupled, "STEPS", 2)
    monkeypatch.setattr(coupled, "EPISODES", 2)
    rows = compare_values(corridor(n_lights=2, cells=4), 0)
    assert [row["planner"] for row in rows] == ["random", "lookahead", "learned values"]
