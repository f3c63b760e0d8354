from pathlib import Path

from mbagent.evaluation.report import Card, Page, Section, Table, format_interval, format_number
from mbagent.evaluation.statistics import Interval


def test_numbers_are_written_for_readers() -> None:
    assert format_number(-0.001) == "0.00"
    assert format_number(-1234.5, 1) == "\N{MINUS SIGN}1,234.5"
    assert format_number(float("nan")) == "–"
    assert format_interval(Interval(0.5, 0.25, 0.75)) == "0.25 … 0.75"


def test_a_table_is_written_as_markdown() -> None:
    table = Table.of([{"": "a", "n": 1}, {"": "b", "n": 2}], str)
    assert table.markdown() == "| | n |\n| --- | ---: |\n| a | 1 |\n| b | 2 |"
    assert table.markdown(names=2).splitlines()[1] == "| --- | --- |"


def test_a_page_needs_no_other_file_and_shows_text_as_it_is(tmp_path: Path) -> None:
    card = Card("A card", b"png", "a figure", Table(["name"], [["<b>"]]), ["Set `n < 3`."], ["a line"])
    Page("Name", "Title", "Intro.", [Section("Results", [card])], "python x.py", {"Data": "Random play."}).write(
        tmp_path / "p.html"
    )
    page = (tmp_path / "p.html").read_text(encoding="utf-8")
    for part in (
        "<h1>Title</h1>",
        "<h2>Results</h2>",
        "<td>&lt;b&gt;</td>",
        "<code>n &lt; 3</code>",
        "<code>a line</code>",
        "<dt>Data</dt>",
    ):
        assert part in page
    assert 'alt="a figure"' in page
    assert "http" not in page
