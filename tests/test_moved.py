"""Module paths of the previous version still work, with a warning that names the new ones."""

import importlib
import sys
import warnings
from typing import Any

import pytest

import mbagent
from mbagent.models.tabular import TabularMDP
from mbagent.moved import MOVED


def imported(old: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module at an old path, imported for the first time, which must warn."""
    for name in [name for name in sys.modules if name in MOVED]:
        monkeypatch.delitem(sys.modules, name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module = importlib.import_module(old)
    assert any(issubclass(w.category, DeprecationWarning) and MOVED[old][0] in str(w.message) for w in caught)
    return module


@pytest.mark.parametrize("old", sorted(MOVED))
def test_an_old_path_leads_to_the_new_one(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = imported(old, monkeypatch)
    place = importlib.import_module(MOVED[old][0])
    for name in [name for name in vars(place) if not name.startswith("_")]:
        assert getattr(module, name) is getattr(place, name)
    with pytest.raises(AttributeError, match="has moved to"):
        _ = module.no_such_name


def test_names_come_from_old_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    assert imported("mbagent.transitions", monkeypatch).TransitionDataset is mbagent.TransitionDataset
    assert imported("mbagent.models.table", monkeypatch).TableModel is TabularMDP


def test_other_paths_are_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("mbagent.models.nothing")
