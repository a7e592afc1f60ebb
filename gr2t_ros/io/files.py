# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files that a reader finds whole or not at all, and folders that they do not leave."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
import fcntl
from itertools import count
import os
from pathlib import Path
from typing import BinaryIO

from ..errors import Gr2tError, InputError

# hidden files beside those that are written; the lock on one ends with its process
_PART, _CLAIM = '.gr2t-part', '.gr2t-claim'


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """
    Write a file beside its final name; it gets that name once it is complete and on the disk.

    :param path: the final name; missing folders are made, an older file is replaced
    :raises Gr2tError: if the folder or the disk does not let it, or another process is writing the
        same file; an older file is left as it was
    """
    try:
        if path.is_dir():
            raise Gr2tError(f'cannot write {path}: there is a folder of that name')
        path.parent.mkdir(parents=True, exist_ok=True)
        part = _beside(path, _PART)
        with _held(part) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            part.replace(path)
            _sync(path.parent)
    except _HeldError as error:
        raise Gr2tError(f'cannot write {path}: another process is writing it') from error
    except OSError as error:
        raise Gr2tError(f'cannot write {path}: {error.strerror or error}') from error


class Folder:
    """
    Where a program puts its files.

    :param path: made when needed; ~ is the home
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path).expanduser()
        self._device: int | None = None
        self._note_device()

    def made(self) -> Path:
        """
        Return its path; it is made where it is missing, but only on the disk where it was.

        :raises Gr2tError: if it cannot be made, or the disk was taken away
        """
        try:
            nearest = self.path
            while not nearest.exists() and nearest != nearest.parent:
                nearest = nearest.parent
            if self._device not in (None, nearest.stat().st_dev):
                raise Gr2tError(
                    f'cannot write to {self.path}: it is not on the disk where it was; is that '
                    'mounted?')
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Gr2tError(
                f'cannot write to {self.path}: {error.strerror or error}') from error
        self._note_device()
        return self.path

    @contextmanager
    def new_file(self, stem: str, ending: str) -> Iterator[Path]:
        """
        Yield a path that no file has, and that no other process is given meanwhile.

        What processes that were killed left unfinished is removed.

        :param stem: of the name; a number follows where it is taken
        :raises Gr2tError: see made
        """
        self.made()
        try:
            self._tidy()
            for number in count(1):
                path = self.path / f'{stem}{f"_{number}" if number > 1 else ""}{ending}'
                with suppress(_HeldError), _held(_beside(path, _CLAIM)):
                    if not os.path.lexists(path):
                        yield path
                        return
        except OSError as error:
            raise Gr2tError(
                f'cannot write to {self.path}: {error.strerror or error}') from error

    def inside(self, name: str) -> Path:
        """
        Return the path of a file in this folder.

        :raises InputError: if the name leads out of it
        """
        try:
            path = (self.path / name).resolve()
            within = bool(name) and path.parent == self.path.resolve()
        except (OSError, ValueError, RuntimeError):  # too long, with a zero, links in a circle
            within = False
        if not within:
            raise InputError(f'{name!r} is not the name of a file in {self.path}')
        return path

    def _note_device(self) -> None:
        with suppress(OSError):
            self._device = self.path.stat().st_dev

    def _tidy(self) -> None:
        """Remove what no living process holds."""
        for ending in (_PART, _CLAIM):
            for path in self.path.glob(f'.*{ending}'):
                with suppress(OSError, _HeldError), _held(path, surely=True):
                    pass


class _HeldError(Exception):
    """Another process holds a file."""


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(f'.{path.name}{ending}')


@contextmanager
def _held(path: Path, surely: bool = False) -> Iterator[BinaryIO]:
    """
    Hold a file, made or emptied, that no other process holds; in the end it is removed.

    :param surely: not on a file system without locks
    :raises _HeldError: if another holds it
    """
    with closing(_lock(path, surely)) as stream:
        try:
            yield stream
        finally:
            if _is_at(path, stream):
                path.unlink()


def _lock(path: Path, surely: bool) -> BinaryIO:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        stream = os.fdopen(descriptor, 'r+b')
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise _HeldError from None
        except OSError:  # a file system without locks
            if surely:
                stream.close()
                raise
        if _is_at(path, stream):
            stream.truncate(0)
            return stream
        stream.close()  # whoever held it removed it after it was opened


def _is_at(path: Path, stream: BinaryIO) -> bool:
    """Tell whether an open file has a name still."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _sync(folder: Path) -> None:
    """Have a folder's names written to the disk, where the file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
