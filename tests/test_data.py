"""Transitions in memory and in files: narrow types, complete rows, and rejection of rows of another environment."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbagent import data as data_module
from mbagent.data import TransitionBatch, TransitionDataset

CARDINALITIES = (2, 3, 300)


def batch(n: int, seed: int = 0) -> TransitionBatch:
    rng = np.random.default_rng(seed)
    states, after = (np.stack([rng.integers(c, size=n) for c in CARDINALITIES], axis=1) for _ in range(2))
    actions, ends = rng.integers(4, size=n), rng.integers(2, size=n) == 1
    return TransitionBatch(states, actions, after, ends, rng.random(n), np.arange(n) // 7)


def same(first: TransitionBatch, second: TransitionBatch) -> bool:
    names = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


def test_bits_are_kept_as_bytes_and_read_as_wide_integers() -> None:
    data = TransitionDataset((2, 2), 4)
    data.append(TransitionBatch(*(part[:, :2] % 2 if part.ndim == 2 else part for part in vars(batch(9)).values())))
    rows = data.rows()
    assert rows.before.dtype == rows.after.dtype == np.uint8
    assert rows.states.dtype == rows.next_states.dtype == np.int64
    assert rows.select(np.arange(3)).before.dtype == np.uint8
    assert TransitionDataset((2, 300), 4).kind == np.uint16


def test_values_that_no_factor_has_are_refused() -> None:
    data = TransitionDataset((2, 2), 4)
    for value in (-1, 2, 256):
        wrong, none = np.full((1, 2), value), np.zeros(1, np.int64)
        with pytest.raises(ValueError, match="outside 0"):
            data.append(TransitionBatch(wrong, none, wrong, none == 1, np.zeros(1), none))


def test_parts_are_all_rows_in_their_order() -> None:
    rows = batch(10)
    assert [len(part) for part in rows.parts(4)] == [4, 4, 2]
    assert np.array_equal(np.concatenate([part.states for part in rows.parts(4)]), rows.states)


@pytest.mark.parametrize("in_folder", [False, True])
def test_rows_are_the_same_in_memory_and_in_a_folder(in_folder: bool, tmp_path: Path) -> None:
    data = TransitionDataset(CARDINALITIES, 4, tmp_path / "rows" if in_folder else None)
    assert len(data) == len(data.rows()) == 0
    first, second = batch(30), batch(20, seed=1)
    data.append(first)
    data.append(second)
    rows, together = (
        data.rows(),
        [np.concatenate([a, b]) for a, b in zip(vars(first).values(), vars(second).values(), strict=True)],
    )
    assert same(rows, TransitionBatch(*together))
    assert isinstance(rows.before, np.memmap) == in_folder
    assert same(data.split(0.1, 0)[0], rows.select(~data.held_out(0.1, 0)))


def test_a_folder_is_continued_and_incomplete_rows_are_ignored(tmp_path: Path) -> None:
    TransitionDataset(CARDINALITIES, 4, tmp_path).append(batch(30))
    with (tmp_path / "states.bin").open("ab") as file:  # an interrupted write
        file.write(b"12345")
    data = TransitionDataset.load(tmp_path)
    assert same(data.rows(), batch(30))
    data.append(batch(20, seed=1))
    assert same(TransitionDataset.load(tmp_path).rows().select(np.arange(30, 50)), batch(20, seed=1))


def test_large_selections_of_mapped_rows_are_mapped_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_module, "_MAPPED", 50)
    data, some = TransitionDataset(CARDINALITIES, 4, tmp_path), np.arange(0, 30, 2)
    data.append(batch(30))
    chosen = data.rows().select(some)
    assert isinstance(chosen.before, np.memmap)
    assert same(chosen, batch(30).select(some))
    assert same(data.rows().select(np.isin(np.arange(30), some)), chosen)
    assert not isinstance(data.rows().select(some[:2]).before, np.memmap)


def test_folders_of_another_environment_are_refused(tmp_path: Path) -> None:
    TransitionDataset(CARDINALITIES, 4, tmp_path)
    with pytest.raises(ValueError, match="another environment"):
        TransitionDataset((2, 2), 4, tmp_path)
    with pytest.raises(ValueError, match="not a folder of transitions"):
        TransitionDataset.load(tmp_path / "..")


def test_files_are_read_back(tmp_path: Path) -> None:
    data = TransitionDataset(CARDINALITIES, 4)
    data.append(batch(30))
    data.save(tmp_path / "rows.npz")
    assert same(TransitionDataset.load(tmp_path / "rows.npz").rows(), batch(30))


def test_values_are_checked_factor_by_factor_and_columns_by_their_length() -> None:
    data, good = TransitionDataset(CARDINALITIES, 4), batch(3)
    wrong = good.states.copy()
    wrong[1, 1] = 3
    with pytest.raises(ValueError, match="factor 1 outside"):
        data.append(TransitionBatch(wrong, good.actions, good.states, good.terminated, good.rewards, good.episodes))
    with pytest.raises(ValueError, match="of one length"):
        data.append(TransitionBatch(good.states, good.actions, good.states, good.terminated, good.rewards[:1], good.episodes))
    with pytest.raises(ValueError, match="whole numbers"):
        data.append(replace(good, before=good.states + 0.5))  # type: ignore[arg-type]
    assert len(data) == 0


def test_two_datasets_do_not_overwrite_each_other(tmp_path: Path) -> None:
    one, other = (TransitionDataset(CARDINALITIES, 4, folder=tmp_path / "rows") for _ in range(2))
    one.append(batch(20))
    seen = one.rows().states.copy()
    with pytest.raises(ValueError, match="load it again"):
        other.append(batch(2, 1))
    one.append(batch(2, 1))
    assert np.array_equal(one.rows().states[:20], seen)
    assert len(TransitionDataset.load(tmp_path / "rows")) == 22


def test_a_file_or_half_a_folder_is_no_folder_of_transitions(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot hold"):
        TransitionDataset(CARDINALITIES, 4, folder=tmp_path / "file")
    TransitionDataset(CARDINALITIES, 4, folder=tmp_path / "rows").append(batch(3))
    (tmp_path / "rows" / "rewards.bin").unlink()
    with pytest.raises(ValueError, match=r"lacks rewards\.bin"):
        TransitionDataset.load(tmp_path / "rows")


def test_rows_that_are_added_while_another_thread_reads_are_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    data, merge = TransitionDataset(CARDINALITIES, 4), np.concatenate
    adding = threading.Thread(target=lambda: data.append(batch(3)))

    def slowly(parts: Any) -> Any:
        if adding.ident is None:  # during the first merge
            adding.start()
            adding.join(0.1)
        return merge(parts)

    data.append(batch(5))
    data.append(batch(7))
    monkeypatch.setattr(np, "concatenate", slowly)
    assert len(data.rows()) == 12
    adding.join()
    assert len(data.rows()) == 15
