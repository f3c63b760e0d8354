"""Which packages may import which."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FORBIDDEN = {
    "envs/mbagent_envs": ("mbagent",),
    "mbagent/models": ("mbagent.planning", "mbagent.agent", "mbagent.policies", "mbagent.evaluation"),
    "mbagent/planning": ("mbagent.agent", "mbagent.policies", "mbagent.evaluation"),
}


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("folder", FORBIDDEN)
def test_imports_go_one_way(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")):
        for name in imported(path):
            assert not any(name == other or name.startswith(f"{other}.") for other in FORBIDDEN[folder]), f"{path}: {name}"


def test_the_agent_and_all_below_it_name_no_environment() -> None:
    for path in sorted((ROOT / "mbagent").rglob("*.py")):
        if "evaluation" in path.parts or path.name == "__init__.py":
            continue
        text = path.read_text(encoding="utf-8")
        for name in ("GeyserRunner", "Maneuverer", "FlierCatcher", "FrozenLake", "Taxi"):
            assert name not in text, f"{path} names {name}"
