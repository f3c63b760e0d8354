"""The documentation's table: worlds in order, later files before earlier ones, shares where no optimum is known."""

from pathlib import Path

from harness import write_csv
from studies.external.summary import markdown_table


def rows(world: str, agent: str, normalised: list[float], positive: float = 0.5) -> list[dict[str, object]]:
    more = {"positive": positive, "learn_seconds": 2.0, "milliseconds": 0.5}
    return [{"world": world, "agent": agent, "normalised": value, **more} for value in normalised]


def test_the_table_holds_the_last_of_each(tmp_path: Path) -> None:
    nan = float("nan")
    first = [
        *rows("Taxi", "mbagent", [0.1, 0.2]),
        *rows("MiniGrid Empty", "mbagent", [nan, nan], 0.998),
        *rows("Taxi", "PPO", [0.3]),
    ]
    write_csv(tmp_path / "first.csv", first)
    second = rows("Taxi", "mbagent", [0.5, 0.7, 0.9])
    second[0] |= {"learn_seconds": 40.0, "milliseconds": 60.0}
    write_csv(tmp_path / "second.csv", second)
    lines = markdown_table([tmp_path / "first.csv", tmp_path / "second.csv"]).splitlines()
    assert lines[0] == "| | mbagent | PPO | learning, s | decision, ms |"
    assert lines[2:] == ["| Taxi | 0.700 | 0.300 | 2.0 | 0.50 |", "| MiniGrid Empty | 99.8% | – | 2.0 | 0.50 |"]
