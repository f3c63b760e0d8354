"""What the documentation shows works."""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "environments.md"
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted((ROOT / "docs").glob("*.md"))


def blocks(page: Path = PAGE) -> list[str]:
    """The page's Python, but for what is marked not to be run."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def optional_packages() -> set[str]:
    """Packages that only extras install, by the names that are imported."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    return {re.split(r"[^A-Za-z0-9_-]", line)[0].replace("-", "_") for lines in extras.values() for line in lines} - {
        "mbagent",
        "pytest",
    }


def mean_return(agent: Any, env: gym.Env[Any, Any], episodes: int) -> float:
    total = 0.0
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        done = False
        while not done:
            obs, reward, terminated, truncated, _ = env.step(agent.predict(obs)[0])
            total += float(reward)
            done = terminated or truncated
    return total / episodes


def test_what_the_readme_shows_first_needs_no_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in optional_packages():
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    first, why, *_ = blocks(ROOT / "README.md")
    exec(first.replace("50_000", "1_500"), names)
    exec(why, names)
    assert (tmp_path / "maneuverer.zip").exists()


@pytest.mark.filterwarnings("ignore:.*History", "ignore:.*reward_fn")  # bins are not the whole state, and the agent says so
def test_continuous_variables_are_cut_into_bins() -> None:
    cart_pole, mountain_car = blocks()
    names: dict[str, Any] = {}
    exec(cart_pole.replace("20_000", "4_000"), names)
    assert mean_return(names["agent"], names["cart_pole"](), 3) > 60  # random play: 22
    exec(mountain_car.replace("20_000", "8_000").replace("(30, 30)", "(20, 20)"), names)
    assert names["agent"].transitions.rows().terminated.any()
    assert mean_return(names["agent"], names["mountain_car"](), 2) > -200  # it gets there in time


@pytest.mark.parametrize("link", re.findall(r"`mbagent\.([a-z_.]+\.[A-Za-z_]+)", PAGE.read_text(encoding="utf-8")))
def test_every_name_exists(link: str) -> None:
    module, _, name = link.rpartition(".")
    assert hasattr(pytest.importorskip(f"mbagent.{module}"), name)


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_resolves(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            linked = page.parent / path if path else page
            assert linked.exists(), target
            assert not anchor or anchor in anchors(linked), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_is_named_exists(page: Path) -> None:
    named = re.findall(r"`((?:mbagent|scripts|tests|envs|docs)/[A-Za-z0-9_/.]+)`", page.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_glossary_is_in_order_and_names_a_source_for_every_term() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| ")][2:]
    terms = ["".join(c for c in row[0].strip().lower() if c.isalnum() or c == " ") for row in rows]
    assert terms == sorted(set(terms))
    assert all(len(row) == 3 and all(cell.strip() for cell in row) for row in rows)
