"""Atomic writing of files: written under a temporary name in the same folder, flushed to the disk, then renamed.

A file that is being written is locked (``flock``). A later call for the same path removes temporary files that are not locked,
since their writers were killed: the operating system releases a lock when its process ends for any reason. Unlike process
numbers, locks work across containers, and on network file systems that support locks; unlike an age limit, they never remove the
file of a slow writer. Without such locks (Windows, some network file systems) files are equally safe, but temporary files of
killed writers are not removed.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
import sys
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np
from numpy.typing import NDArray

if sys.platform != "win32":
    import fcntl

Target = str | os.PathLike[str] | BinaryIO
"""Destination or source of a file: a path or an open binary file."""


def write(path: Path, content: str | bytes) -> None:
    """Writes a complete file; text as UTF-8, with line endings unchanged.

    Raises:
        OSError: see ``replaced``.
    """
    with replaced(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def writing(target: Target, suffix: str, *, always: bool) -> AbstractContextManager[BinaryIO]:
    """A file to write to: an open file unchanged, or one that replaces the file at a path.

    Args:
        target: the path or the open file.
        suffix: suffix to append to the path.
        always: append it unless the path ends with it, as NumPy does; else only to a path without any suffix, as SB3 does.

    Raises:
        TypeError, ValueError: ``target`` is neither.
        OSError: see ``replaced``.
    """
    if _is_open(target, "write"):
        return nullcontext(target)
    path = _checked(target)
    bare = path.suffix != suffix if always else not path.suffix
    return replaced(Path(f"{path}{suffix}") if bare else path)


def reading(source: Target, suffix: str) -> AbstractContextManager[BinaryIO]:
    """A file to read: an open file unchanged, or the file at a path, or at the path with ``suffix``.

    Raises:
        TypeError, ValueError: ``source`` is neither.
        FileNotFoundError: there is no such file; the message names the paths tried.
    """
    if _is_open(source, "read"):
        return nullcontext(source)
    path = _checked(source)
    tried = [path] if path.suffix == suffix else [path, Path(f"{path}{suffix}")]
    for candidate in tried:
        if candidate.is_file():
            return candidate.open("rb")
    raise FileNotFoundError(f"There is no file {' or '.join(map(str, tried))}; check the path, or save there first.")


def arrays(file: BinaryIO) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz``.

    Raises:
        ValueError: the file is not an ``.npz``, is damaged, or contains pickles. NumPy's own message is omitted, since it may
            suggest allowing pickles, which run code when read.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive.files}
    except (ValueError, EOFError, TypeError, AttributeError, KeyError, zipfile.BadZipFile, zlib.error):
        raise ValueError("it is not an .npz of plain arrays, or is damaged") from None


def write_arrays(file: BinaryIO | Path, given: Mapping[str, NDArray[Any]], compressed: bool = False) -> None:
    """Writes an ``.npz``.

    Raises:
        TypeError: an array contains Python objects, which NumPy would pickle.
    """
    for name, array in given.items():
        if np.asarray(array).dtype.hasobject:
            raise TypeError(f"The array {name!r} contains Python objects, which cannot be saved.")
    save: Any = np.savez_compressed if compressed else np.savez
    save(file, **given)  # without allow_pickle, which older versions of NumPy do not know


def _is_open(target: Any, method: str) -> TypeGuard[BinaryIO]:
    """Whether ``target`` is an open binary file; TypeError if it is an open text file."""
    if isinstance(target, io.TextIOBase):
        raise TypeError("The file is open in text mode; open it in binary mode ('wb' to save, 'rb' to load), or pass its path.")
    return hasattr(target, method) and not isinstance(target, str | os.PathLike)


def _checked(target: Any) -> Path:
    """The path of a file; TypeError or ValueError if ``target`` is not one."""
    if not isinstance(target, str | os.PathLike):
        raise TypeError(f"Files are saved to and loaded from a path or an open binary file, got {target!r}.")
    path = Path(target)
    if not path.name:
        raise ValueError(f"The path must name a file, got {os.fspath(target)!r}.")
    return path


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """A new binary file that replaces ``path`` when the block ends; if the block is interrupted, the old file is kept.

    Missing folders are created, symbolic links are followed, and the permissions of an existing file are kept.

    Raises:
        IsADirectoryError, NotADirectoryError: there is a folder at the path, or a file in place of its folder.
        PermissionError: the folder or the file is not writable.
        OSError: any other failure, such as a full disk.
    """
    path = Path(os.path.realpath(path))
    before = _prepare(path)
    _remove_abandoned(path)
    with _explain_permissions(path):
        temporary, file = _create_temporary(path)
    try:
        with file:
            yield file
            if before is not None:
                _copy_permissions(temporary, before)
            file.flush()
            os.fsync(file.fileno())
            if sys.platform == "win32":  # cannot rename open files; elsewhere the file stays open, hence locked, until then
                file.close()
            with _explain_permissions(path):
                temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def _prepare(path: Path) -> os.stat_result | None:
    """Status of the file to be replaced; None if it is missing. Creates the folder."""
    try:
        with _explain_permissions(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            before = path.stat()
    except FileNotFoundError:
        return None
    except (FileExistsError, NotADirectoryError) as error:
        raise NotADirectoryError(f"{path} cannot be written: a part of this path is a file, not a folder.") from error
    if stat.S_ISDIR(before.st_mode):
        raise IsADirectoryError(f"{path} is a folder; give the path of a file.")
    if not stat.S_ISREG(before.st_mode):
        raise ValueError(f"{path} is a device or a pipe, which cannot be replaced; give the path of a file, or an open file.")
    if not os.access(path, os.W_OK):
        raise PermissionError(f"{path} is write-protected; make it writable or choose another path.")
    return before


@contextmanager
def _explain_permissions(path: Path) -> Iterator[None]:
    """Explains why a file that may itself be writable cannot be replaced."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        raise PermissionError(
            f"{path} cannot be written because no file can be created and renamed in {path.parent}, which is needed so that "
            "an interruption never destroys the previous file; make the folder writable or choose another path."
        ) from error


def _create_temporary(path: Path) -> tuple[Path, BinaryIO]:
    """A new, locked file with a unique name in the folder of ``path``, with the default permissions of new files."""
    while True:
        temporary = path.with_name(f"{_prefix(path)}{uuid.uuid4().hex}.part")
        file = temporary.open("xb")
        with suppress(OSError):
            _lock(file, wait=True)
        if temporary.exists():
            return temporary, file
        file.close()  # removed by another process between creation and locking


def _prefix(path: Path) -> str:
    """Prefix of the names of temporary files, shortened since file systems limit names to 255 bytes."""
    return f".{os.fsencode(path.name)[:200].decode(errors='ignore')}."


def _remove_abandoned(path: Path) -> None:
    """Removes temporary files left by killed writers to ``path``."""
    pattern = re.compile(rf"{re.escape(_prefix(path))}[0-9a-f]{{32}}\.part")
    with suppress(OSError):
        for other in [other for other in path.parent.iterdir() if pattern.fullmatch(other.name)]:
            with suppress(OSError), other.open("r+b") as file:
                _lock(file, wait=False)  # fails while its writer is alive
                other.unlink()


def _lock(file: BinaryIO, *, wait: bool) -> None:
    """Locks a file until it is closed.

    Raises:
        OSError: another process has locked it, or locks are not supported.
    """
    if sys.platform == "win32":
        raise OSError(errno.ENOTSUP, "no locks")
    fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds an exclusive lock on a file during the block; has no effect if locks are not supported."""
    with path.open("r+b") as file:
        with suppress(OSError):
            _lock(file, wait=True)
        yield


def _copy_permissions(path: Path, before: os.stat_result) -> None:
    """Gives a file the permissions of another and, if allowed, its owner."""
    if sys.platform != "win32":
        with suppress(OSError):
            os.chown(path, before.st_uid, before.st_gid)
    path.chmod(stat.S_IMODE(before.st_mode))


def _sync(folder: Path) -> None:
    """Flushes a folder's entries to disk, if supported; if not, the file is still complete under either name."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
