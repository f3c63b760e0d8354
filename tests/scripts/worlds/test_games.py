import pytest

from worlds.games import find_case, goals_of
from worlds.known_rules import scale_of


def test_scales_are_those_known_for_the_games() -> None:
    scale = scale_of(find_case("geyser_high_cost").world, episodes=300)
    assert scale.random == pytest.approx(4.8, abs=1.5)
    assert scale.reference == pytest.approx(43.8, abs=0.5)


def test_unknown_cases_are_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="choose from geyser_deterministic"):
        find_case("geyser")
    assert goals_of(find_case("frozen_lake")) == ["default"]
    assert len(goals_of(find_case("maneuverer"))) >= 4
