"""Rules for the whole repository that no linter rule covers."""

import ast
import statistics
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(p for folder in ("mbagent", "envs", "scripts", "tests") for p in (ROOT / folder).rglob("*.py"))
MAX_FILE_LINES = 600
MAX_FUNCTION_LINES = 60
MAX_ARGUMENTS = 8
MEDIAN_FILE_LINES, MEDIAN_FUNCTION_LINES = 200, 10
MOST_LIBRARY_FILES, MOST_FILES_IN_A_FOLDER = 90, 20
LIBRARY = [p for p in SOURCES if p.relative_to(ROOT).parts[0] == "mbagent"]
FORMER_NAMES = {
    *(
        "Acts",
        "Asking",
        "Foresight",
        "GivenReward",
        "GoalBook",
        "Habit",
        "Head",
        "Imagined",
        "LAWLESS",
        "Laws",
        "Lean",
        "Machine",
    ),
    *("MachinePlanner", "Manner", "Partner", "Seen", "Steered", "View", "Way", "acts_of", "ask_in", "begin_wave", "best_askings"),
    *(
        "couple",
        "coupled_layout",
        "coupling",
        "coupling_of",
        "couplings",
        "end_wave",
        "find_couplings",
        "find_laws",
        "find_steered",
    ),
    *(
        "flag_events",
        "foresee",
        "foresight",
        "foretell",
        "foretold",
        "habit",
        "habit_of",
        "hangs_on_action",
        "has_event",
        "is_late",
    ),
    *("laws", "lean", "luck", "manner", "manners", "meeting", "meetings", "nothing_late", "novelty", "partner", "partners"),
    *("rehearse", "still_true_since", "told_by", "typical", "zoom"),
}
"""Names that were replaced by standard terms, see docs/glossary.md."""


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


def n_arguments(function: ast.FunctionDef) -> int:
    """Number of arguments, without ``self`` or ``cls``."""
    names = [argument.arg for argument in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len(names) - int(names[:1] in (["self"], ["cls"]))


def test_functions_have_few_arguments() -> None:
    """But for constructors."""
    functions = (
        (f"{path.relative_to(ROOT)}: {node.name}", n_arguments(node))
        for path in SOURCES
        if path.relative_to(ROOT).parts[0] in ("mbagent", "envs")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and node.name != "__init__"
    )
    assert not {name: n for name, n in functions if n > MAX_ARGUMENTS}


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


def imports_of(path: Path) -> Iterator[tuple[str, str]]:
    """(module, name) of all absolute imports from a file, also within functions and TYPE_CHECKING; the name is "" for modules."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield from ((node.module, alias.name) for alias in node.names)


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_no_imports_are_circular() -> None:
    modules = {module_of(p) for p in LIBRARY}
    graph = {
        module_of(p): {name for pair in imports_of(p) for name in (".".join(pair), pair[0]) if name in modules} - {module_of(p)}
        for p in LIBRARY
        if p.name != "__init__.py"
    }
    while free := [module for module, needed in graph.items() if not needed & graph.keys()]:
        for module in free:
            del graph[module]
    assert not graph


def test_underscore_modules_are_used_by_their_own_package_only() -> None:
    for path in SOURCES:
        for module, name in imports_of(path):
            package, _, last = module.rpartition(".")
            if last.startswith("_") and not last.startswith("__"):
                assert module_of(path).startswith(package), f"{path}: {module} {name}"


def top_level_names(path: Path) -> Iterator[str]:
    """Names of the variables that a module defines."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in targets:
            for name in ast.walk(target):
                if isinstance(name, ast.Name):
                    yield name.id


def test_constants_and_type_aliases_are_defined_once() -> None:
    found = defaultdict(list)
    for path in LIBRARY:
        for name in top_level_names(path):
            constant = name.isupper() and len(name) > 2
            if constant or (name[0].isupper() and name in {"Ints", "Floats", "Bools", "Keys", "States", "Actions", "Words"}):
                found[name].append(module_of(path))
    assert {name: where for name, where in found.items() if len(where) > 1} == {}


def test_names_that_were_replaced_do_not_come_back() -> None:
    for path in LIBRARY:
        with path.open("rb") as file:
            names = {token.string for token in tokenize.tokenize(file.readline) if token.type == tokenize.NAME}
        assert not names & FORMER_NAMES, path


def test_files_are_short_in_the_median() -> None:
    assert statistics.median(len(path.read_text(encoding="utf-8").splitlines()) for path in LIBRARY) <= MEDIAN_FILE_LINES


def test_functions_are_short_in_the_median() -> None:
    lengths = [
        lines_without_docstring(node)
        for path in LIBRARY
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    ]
    assert statistics.median(lengths) <= MEDIAN_FUNCTION_LINES


def test_the_library_has_few_files() -> None:
    assert len(LIBRARY) <= MOST_LIBRARY_FILES
    folders = Counter(path.parent for path in LIBRARY)
    assert {str(folder): n for folder, n in folders.items() if n > MOST_FILES_IN_A_FOLDER} == {}
