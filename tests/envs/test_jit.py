"""Compiled functions work, with one warning, if nothing can be cached on disk."""

import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import util
from pathlib import Path
from typing import Any

import pytest
from numba.core import event
from numba.core.caching import NullCache

from mbagent_envs import jit

ROOT = Path(__file__).parents[2]
DOUBLE = """
from mbagent_envs.jit import compiled

@compiled
def double(x):
    return 2 * x
"""


def run(package: str, installed: Path, cache: str) -> subprocess.CompletedProcess[str]:
    """Imports a package and calls a compiled function in a process without a writable home folder."""
    # Not even root can create a folder below a file, or one with the name of a file.
    home = {"HOME": os.devnull, "XDG_CACHE_HOME": f"{os.devnull}/cache", "PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": cache}
    code = f"import numpy, {package}; from mbagent_envs.random_keys import mix; print({package}.__file__, mix(numpy.uint64(1)))"
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env={**os.environ, **home}, cwd=installed, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the packages in folders in which no compiled function can be cached."""
    folder = tmp_path_factory.mktemp("installed")
    for package in (ROOT / "mbagent", ROOT / "envs" / "mbagent_envs"):
        shutil.copytree(package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for inside in [path for path in folder.rglob("*") if path.is_dir()]:
        (inside / "__pycache__").write_text("")
    return folder


@pytest.mark.parametrize(("package", "cache"), [("mbagent", ""), ("mbagent_envs", f"{os.devnull}/numba")])
def test_packages_work_without_writable_folders_with_one_warning(installed: Path, package: str, cache: str) -> None:
    done = run(package, installed, cache)
    assert done.returncode == 0, done.stderr
    assert str(installed) in done.stdout
    assert done.stderr.count("Warning") == 1
    assert "set the environment variable NUMBA_CACHE_DIR to a writable folder" in done.stderr


def test_a_writable_folder_for_numba_is_used_without_a_warning(installed: Path, tmp_path: Path) -> None:
    done = run("mbagent_envs", installed, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert list(tmp_path.rglob("*.nbi"))


def test_two_processes_share_an_empty_folder(tmp_path: Path) -> None:
    code = "from mbagent_envs.random_keys import derive, uniforms; print(uniforms(derive(3, range(4)), 2).sum())"
    settings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    started = [subprocess.Popen([sys.executable, "-c", code], env=settings, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = {process.communicate()[0] for process in started}
    assert [process.returncode for process in started] == [0, 0]
    assert len(outputs) == 1
    assert list(tmp_path.rglob("*.nbi"))


@pytest.fixture
def double(tmp_path: Path) -> Iterator[Callable[[Any], Any]]:
    """A compiled function in a separate folder."""
    (tmp_path / "doubling.py").write_text(DOUBLE)
    spec = util.spec_from_file_location("doubling", tmp_path / "doubling.py")
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    jit._warn_uncached.cache_clear()
    yield module.double
    jit._warn_uncached.cache_clear()


def test_a_folder_that_is_no_longer_writable_raises_no_error(double: Callable[[Any], Any], tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "__pycache__")
    (tmp_path / "__pycache__").write_text("")
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert double(2) == 4
    assert double(0.5) == 1.0  # no second warning


def test_a_full_disk_raises_no_error(double: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert double(2) == 4


def test_damaged_files_raise_no_error(double: Callable[[Any], Any], tmp_path: Path) -> None:
    assert double(2) == 4
    (index,) = (tmp_path / "__pycache__").glob("*.nbi")
    index.write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert double(0.5) == 1.0


@jit.compiled
def _next(number: int) -> int:
    return number + 1


@jit.compiled
def _sum_of_next(n: int) -> int:
    total = 0
    for _ in range(n):
        total += _next(total) + _next(3)
    return total


@jit.compiled
def _checked(n: int) -> int:
    if n < 0:
        raise ValueError("negative", n)
    if n < 2:
        return 1
    return n * _checked(n - 1)


@jit.compiled
def _binomial(n: int, k: int) -> int:
    return int(_checked(n) // (_checked(k) * _checked(n - k)))


def compilations(call: Callable[[], Any]) -> Counter[str]:
    """Names of the functions that are compiled during a call."""
    with event.install_recorder("numba:compile") as recorder:
        call()
    started = [found for _, found in recorder.buffer if found.is_start]
    return Counter(found.data["dispatcher"].py_func.__name__ for found in started)


needs_compilation = pytest.mark.skipif(not hasattr(_next, "signatures"), reason="compilation is disabled")


@needs_compilation
def test_a_function_is_not_compiled_again_for_constants(monkeypatch: pytest.MonkeyPatch) -> None:
    sum_of_next: Any = _sum_of_next
    monkeypatch.setattr(sum_of_next, "_cache", NullCache())
    assert compilations(lambda: sum_of_next(2)) == {"_sum_of_next": 1, "_next": 1}
    assert sum_of_next(2) == 15


@needs_compilation
def test_a_function_called_by_compiled_code_alone_has_no_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    for function in (_binomial, _checked):
        monkeypatch.setattr(function, "_cache", NullCache())
    checked: Any = _checked
    assert _binomial(6, 2) == 15
    assert not checked.signatures
    assert checked(5) == 120
    assert len(checked.signatures) == 1


def test_errors_pass_through_functions_that_are_linked_in() -> None:
    with pytest.raises(ValueError, match="negative") as error:
        _binomial(2, 3)
    assert error.value.args == ("negative", -1)
