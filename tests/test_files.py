"""Atomic writing of files, with killed and concurrent writers."""

import io
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbagent import checkpoint, files
from mbagent.data import TransitionDataset
from tests.test_data import CARDINALITIES, batch, same

STEPS = {"fsync", "truncate", "rename", "replace", "flock", "mkdir", "unlink"}
"""A writer is killed before each of these calls, and before every tenth ``write``."""


def killed(work: Callable[[], None], step: int) -> bool:
    """Whether ``work``, in a subprocess, was killed before its call number ``step`` among those that change files."""
    child = os.fork()
    if child == 0:
        left, writes = step, 0

        def trace(frame: Any, event: str, function: Any) -> None:
            nonlocal left, writes
            if event == "c_call":
                writes += function.__name__ == "write"
                left -= function.__name__ in STEPS or (function.__name__ == "write" and writes % 10 == 1)
                if left < 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.setprofile(trace)
        work()
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)


def dataset(n: int) -> TransitionDataset:
    data = TransitionDataset(CARDINALITIES, 4)
    data.append(batch(n))
    return data


def written_agent(path: Path, n: int) -> None:
    data = dict.fromkeys(checkpoint.REQUIRED, 0) | {"settings": {}, "reward_source": "learned", "n_updates": n}
    starts = {"start_states": np.zeros((1, 2))}
    checkpoint.write(path, checkpoint.AgentState(data, {"policy": {"weights": np.full(n, n)}, "planning": starts}))


def agent_rows(path: Path) -> int:
    state = checkpoint.read(path)
    n = int(state.data["n_updates"])
    assert state.arrays["policy"]["weights"].tolist() == [n] * n
    return n


def table_rows(path: Path) -> int:
    rows = TransitionDataset.load(path).rows()
    assert same(rows, batch(len(rows)))
    return len(rows)


def folder_rows(path: Path) -> int:
    rows = TransitionDataset(CARDINALITIES, 4, path).rows()
    assert len(rows) == 0 or same(rows.select(slice(0, 30)), batch(30))
    assert len(rows) <= 30 or same(rows.select(slice(30, None)), batch(20, seed=1))
    return len(rows)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("first", "second", "rows", "expected"),
    [
        (lambda p: written_agent(p, 3), lambda p: written_agent(p, 5), agent_rows, (3, 5)),
        (lambda p: dataset(30).save(p), lambda p: dataset(50).save(p), table_rows, (30, 50)),
        (
            lambda p: TransitionDataset(CARDINALITIES, 4, p).append(batch(30)),
            lambda p: TransitionDataset(CARDINALITIES, 4, p).append(batch(20, seed=1)),
            folder_rows,
            (30, 50),
        ),
        (lambda p: None, lambda p: TransitionDataset(CARDINALITIES, 4, p).append(batch(30)), folder_rows, (0, 30)),
    ],
    ids=["save", "save_transitions", "folder", "new folder"],
)
def test_a_writer_killed_at_any_step_leaves_the_last_or_the_new(
    first: Callable[[Path], None], second: Callable[[Path], None], rows: Callable[[Path], int], expected: Any, tmp_path: Path
) -> None:
    seen, step, going = set(), 0, True
    while going:
        path = tmp_path / str(step) / "file.npz"
        path.parent.mkdir()
        first(path)
        going = killed(lambda path=path: second(path), step)  # type: ignore[misc]
        seen.add(rows(path))
        if rows(path) == expected[0]:
            second(path)
        assert rows(path) == expected[1]
        left = [p.name for p in tmp_path.glob(f"{step}/**/*.part")]
        assert not left or not going
        step += 1
    assert step > 5
    assert seen == set(expected)


def test_a_live_writers_file_is_left_alone_and_the_last_to_end_wins(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with files.replaced(path) as slow:
        slow.write(b"slow")
        files.write(path, "quick")
        assert path.read_text() == "quick"
        assert len(list(tmp_path.iterdir())) == 2
    assert path.read_text() == "slow"
    assert list(tmp_path.iterdir()) == [path]


def test_writers_at_one_path_do_not_hinder_each_other(tmp_path: Path) -> None:
    path, failures = tmp_path / "file", []

    def work(letter: str) -> None:
        try:
            for _ in range(30):
                files.write(path, letter * 10_000)
                assert path.read_text() in {"a" * 10_000, "b" * 10_000}
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(letter,)) for letter in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_removed_before_it_was_locked_is_created_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stolen: list[str] = []
    lock = files._lock

    def late(file: Any, *, wait: bool) -> None:
        if not stolen:
            stolen.append(file.name)
            Path(file.name).unlink()
        lock(file, wait=wait)

    monkeypatch.setattr(files, "_lock", late)
    files.write(tmp_path / "file", "all")
    assert stolen
    assert (tmp_path / "file").read_text() == "all"


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_only_the_old_file(step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rows.npz"
    dataset(30).save(path)

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space left"):
        dataset(50).save(path)
    monkeypatch.undo()
    assert table_rows(path) == 30
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_can_be_continued_after_the_disk_was_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, calls = TransitionDataset(CARDINALITIES, 4, tmp_path), []
    data.append(batch(30))

    def full(*args: Any) -> None:
        calls.append(args)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        data.append(batch(20, seed=1))
    assert len(data) == folder_rows(tmp_path) == 30
    data.append(batch(20, seed=1))
    assert len(data) == folder_rows(tmp_path) == 50


def test_a_column_with_missing_rows_raises_an_error(tmp_path: Path) -> None:
    TransitionDataset(CARDINALITIES, 4, tmp_path).append(batch(30))
    os.truncate(tmp_path / "rewards.bin", 8 * 12)
    with pytest.raises(ValueError, match="only 12 of the 30 rows"):
        TransitionDataset.load(tmp_path)


def test_folders_without_a_number_of_rows_are_read(tmp_path: Path) -> None:
    TransitionDataset(CARDINALITIES, 4, tmp_path).append(batch(30))
    (tmp_path / "dataset.json").write_text('{"cardinalities": [2, 3, 300], "n_actions": 4}', encoding="utf-8")
    assert folder_rows(tmp_path) == 30
    TransitionDataset(CARDINALITIES, 4, tmp_path).append(batch(20, seed=1))
    assert folder_rows(tmp_path) == 50


def test_symbolic_links_are_kept_and_their_targets_written(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for name in ("old", "dangling"):
        (tmp_path / name).symlink_to(Path("there") / name)
    (tmp_path / "there" / "old").write_text("old")
    for name in ("old", "dangling"):
        files.write(tmp_path / name, "new")
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / "there" / name).read_text() == "new"
    assert {path.name for path in tmp_path.rglob("*")} == {"there", "old", "dangling"}
    (tmp_path / "rows").symlink_to(Path("there") / "rows")
    TransitionDataset(CARDINALITIES, 4, tmp_path / "rows").append(batch(30))
    assert folder_rows(tmp_path / "there" / "rows") == 30


def test_permissions_are_those_of_a_new_file_or_of_the_one_replaced(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        files.write(tmp_path / "file", "new")
        assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
        (tmp_path / "file").chmod(0o604)
        files.write(tmp_path / "file", "newer")
        assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o604
    finally:
        os.umask(before)


def test_long_names_leave_room_for_temporary_names(tmp_path: Path) -> None:
    for name in ("a" * 255, "é" * 127):
        files.write(tmp_path / name, "all")
        assert (tmp_path / name).read_text() == "all"


def test_unwritable_paths_raise_an_error_of_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("kept")
    with pytest.raises(IsADirectoryError, match="is a folder; give the path of a file"):
        files.write(tmp_path, "x")
    with pytest.raises(NotADirectoryError, match="a part of this path is a file"):
        files.write(tmp_path / "file" / "below", "x")
    with pytest.raises(ValueError, match="device or a pipe"):
        files.write(Path(os.devnull), "x")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError, match="write-protected"):
        files.write(tmp_path / "file", "x")
    monkeypatch.undo()

    def denied(*args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(PermissionError, match=r"no file can be created and renamed in .*; make the folder writable"):
        files.write(tmp_path / "file", "x")
    monkeypatch.undo()
    assert (tmp_path / "file").read_text() == "kept"


def test_names_get_their_suffix_when_written_and_when_read(tmp_path: Path) -> None:
    for name in ("rows", "rows.v1", "rows2.npz"):
        dataset(30).save(tmp_path / name)
        assert table_rows(tmp_path / name) == 30
    for name in ("agent", "agent.v1"):
        written_agent(tmp_path / name, 3)
        assert agent_rows(tmp_path / name) == 3
    (tmp_path / "agent.v1").rename(tmp_path / "agent.v1.zip")
    assert agent_rows(tmp_path / "agent.v1") == 3
    assert {path.name for path in tmp_path.iterdir()} == {
        *("rows.npz", "rows.v1.npz", "rows2.npz"),
        *("agent.zip", "agent.v1.zip"),
    }


def test_open_files_are_written_to_and_read(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    dataset(30).save(buffer)
    buffer.seek(0)
    assert same(TransitionDataset.load(buffer).rows(), batch(30))
    with (tmp_path / "text").open("w") as file, pytest.raises(TypeError, match="open in text mode"):
        dataset(30).save(file)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "act", [lambda p: dataset(3).save(p), lambda p: written_agent(p, 3), TransitionDataset.load, checkpoint.read]
)
def test_invalid_paths_raise_an_error_of_one_sentence(act: Callable[[Any], None]) -> None:
    for wrong in (None, 3):
        with pytest.raises(TypeError, match="a path or an open binary file, got"):
            act(wrong)
    with pytest.raises(ValueError, match="must name a file, got ''"):
        act("")


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no file .*rows or .*rows\.npz"):
        TransitionDataset.load(tmp_path / "rows")
    with pytest.raises(FileNotFoundError, match=r"no file .*agent\.zip;"):
        checkpoint.read(tmp_path / "agent.zip")


def test_files_that_are_no_table_raise_an_error_without_advice_to_read_pickles(tmp_path: Path) -> None:
    np.save(tmp_path / "objects.npy", np.array([{}]), allow_pickle=True)
    np.save(tmp_path / "numbers.npy", np.arange(3))
    np.savez(tmp_path / "lacks.npz", states=np.arange(3))
    (tmp_path / "text.csv").write_text("a,b\n1,2\n")
    (tmp_path / "empty.npz").write_bytes(b"")
    written_agent(tmp_path / "agent.zip", 3)
    dataset(3000).save(tmp_path / "rows.npz")
    whole = (tmp_path / "rows.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "flipped.npz").write_bytes(whole[:2000] + bytes(9) + whole[2009:])
    with np.load(tmp_path / "rows.npz") as archive:
        table = dict(archive)
    np.savez(tmp_path / "odd.npz", **{**table, "cardinalities": np.array(3)})
    np.savez(tmp_path / "pickled.npz", **{**table, "rewards": np.array([{}])}, allow_pickle=True)
    (tmp_path / "rows.npz").unlink()
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(ValueError, match=r"is not a table of transitions written by save_transitions") as caught:
            TransitionDataset.load(path)
        assert path.name in str(caught.value)
        assert "allow_pickle" not in str(caught.value)


def test_arrays_of_objects_are_not_saved_as_pickles(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="'bad' contains Python objects"):
        files.write_arrays(tmp_path / "arrays.npz", {"good": np.zeros(1), "bad": np.array([None])})
    assert not list(tmp_path.iterdir())
