"""Habits of the whole repository that no linter rule covers."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(p for folder in ("mbagent", "envs", "scripts", "tests") for p in (ROOT / folder).rglob("*.py"))
MAX_FILE_LINES = 600
MAX_FUNCTION_LINES = 60


def lines_without_docstring(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    first, last = function.lineno, function.end_lineno
    assert last is not None
    lines = last - first + 1
    statement = function.body[0]
    is_docstring = ast.get_docstring(function, clean=False) is not None
    if is_docstring and statement.end_lineno is not None:
        lines -= statement.end_lineno - statement.lineno + 1
    return lines


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_functions_stay_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_FILE_LINES
    too_long = {
        node.name: lines_without_docstring(node)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and lines_without_docstring(node) > MAX_FUNCTION_LINES
    }
    assert not too_long


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("envs", ("mbagent",)),
        ("mbagent", ("exact", "harness", "peers", "scripts", "studies", "worlds")),
        ("mbagent/models", ("mbagent.planning", "mbagent.agent", "mbagent.evaluation")),
        ("mbagent/planning", ("mbagent.agent", "mbagent.evaluation")),
        ("mbagent/adapters", ("mbagent.models", "mbagent.planning", "mbagent.agent", "mbagent.evaluation")),
        ("scripts/worlds", ("studies",)),
    ],
)
def test_data_flows_one_way(folder: str, forbidden: tuple[str, ...]) -> None:
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            imported: list[str] = []
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                imported = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            for name in imported:
                assert not any(name == f or name.startswith(f + ".") for f in forbidden), f"{path}: {name}"
