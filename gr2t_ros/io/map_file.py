# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""
A map as one file, from which it can go on.

    gr2t map 1\n | length of the header, 8 bytes | header, JSON | columns | SHA-256 of all before

The header holds settings and counts, and how many rows each column of state.columns_of has; these
follow as they are in memory, little endian. Nothing in it is code, and nothing is used before the
sizes and the checksum are right.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import hashlib
from io import BufferedReader
import json
from math import prod
import os
from pathlib import Path
import stat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.reconstruction import Reconstruction
from ..core.state import columns_of, differing, Kind, restore, state_of
from ..errors import Gr2tError, InputError
from ..settings import Settings
from .files import whole_file

ENDING = '.gr2t'
_MAGIC, _VERSION = b'gr2t map ', 1
_LINE = b'%s%d\n' % (_MAGIC, _VERSION)
_PIECE = 4 << 20  # bytes
_LENGTH = 8  # bytes
_CHECKSUM = hashlib.sha256().digest_size


@dataclass(frozen=True)
class SavedMap:
    """
    What was written.

    :param size: bytes
    """

    path: Path
    size: int
    views: int
    keyframes: int

    @property
    def content(self) -> str:
        """Return what the file holds, as text."""
        return f'{self.views} views, {self.keyframes} keyframes, {self.size / 1e6:.1f} MB'

    def __str__(self) -> str:
        """Return the path, ': ' and what the file holds."""
        return f'{self.path}: {self.content}'


def save_map(
    path: Path, reconstruction: Reconstruction, world_frame: str, *,
    interrupted: Callable[[], bool] = lambda: False,
) -> SavedMap:
    """
    Write a map with all that it needs to go on; rays that wait are left waiting.

    :param path: an older file is replaced once the new one is complete
    :param reconstruction: or its copy for ADDING; it must not change meanwhile
    :param world_frame: that its poses are in
    :param interrupted: asked all the while; True: leave no file and raise
    :raises FrameError: if it has no views
    :raises Gr2tError: if the file cannot be written, or the writing was interrupted
    """
    state = state_of(reconstruction)
    kinds = columns_of(reconstruction.settings.density)
    header = json.dumps({
        **state.numbers, 'world_frame': world_frame,
        'rows': {name: sum(map(len, state.columns[name])) for name in kinds}}).encode()
    checksum = hashlib.sha256()
    size = 0
    with whole_file(path) as stream:
        def write(piece: memoryview | bytes) -> None:
            nonlocal size
            if interrupted():
                raise Gr2tError('interrupted: the node was told to stop')
            checksum.update(piece)
            size += stream.write(piece)

        write(_LINE)
        write(len(header).to_bytes(_LENGTH, 'little'))
        write(header)
        for name, (dtype, _) in kinds.items():
            for rows in state.columns[name]:
                flat = np.ascontiguousarray(rows, dtype).reshape(-1).view(np.uint8)
                for begin in range(0, len(flat), _PIECE):
                    write(flat[begin:begin + _PIECE].data)
        size += stream.write(checksum.digest())
    return SavedMap(path, size, state.numbers['views'], len(reconstruction.keyframes))


class MapFile:
    """
    A map that was opened and found whole; it is read when it is loaded.

    settings: that it was saved with. world_frame: of its poses. views: how many are in it.
    stamp_ns: the newest of their stamps.

    :raises InputError: if it cannot be read, is no map, of another version, truncated or altered
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = os.fdopen(_descriptor_of(path), 'rb')
            try:
                self._read_header(_verified(self._stream))
            except BaseException:
                self._stream.close()
                raise
        except OSError as error:
            raise InputError(f'cannot read the map {path}: {error.strerror or error}') from error
        except InputError as error:
            raise InputError(f'cannot use the map {path}: {error}') from error

    def _read_header(self, length: int) -> None:
        try:
            numbers = self._numbers = json.loads(self._stream.read(length))
            known = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in numbers['settings'].items()
                if name in Settings.__dataclass_fields__}
            self.settings = Settings().updated(known)
            self.world_frame = str(numbers['world_frame'])
            self.views, self.stamp_ns = int(numbers['views']), int(numbers['stamp_ns'])
            if not (0 < self.views < 2 ** 31 and 0 <= self.stamp_ns < 2 ** 63):
                raise ValueError(f'{self.views} views, stamp {self.stamp_ns}')
            self.voxel_size = float(numbers.get('voxel_size', 0))
            self._kinds = columns_of(self.settings.density)
            self._places: dict[str, tuple[int, int]] = {}  # first byte, rows
            end = self._stream.tell()
            for name, kind in self._kinds.items():
                count = numbers['rows'][name]
                if not isinstance(count, int) or count < 0:
                    raise ValueError(f'{name} has {count} rows')
                self._places[name] = (end, count)
                end += count * _row_bytes(kind)
            if end + _CHECKSUM != os.fstat(self._stream.fileno()).st_size:
                raise ValueError('its size')
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError,
                RecursionError) as error:
            raise InputError(f'its header contradicts itself ({error})') from error

    def count(self, name: str) -> int:
        """Return a column's number of rows."""
        return self._places[name][1]

    def read(self, name: str, begin: int, end: int) -> NDArray[Any]:
        """Return some rows of a column."""
        first, count = self._places[name]
        dtype, shape = self._kinds[name]
        if not 0 <= begin <= end <= count:
            raise ValueError(f'{name} has {count} rows')
        rows = np.empty((end - begin, *shape), dtype)
        self._stream.seek(first + begin * _row_bytes(self._kinds[name]))
        if rows.size and self._stream.readinto(
                rows.reshape(-1).view(np.uint8).data) != rows.nbytes:
            raise InputError('it became shorter while it was read')
        return rows

    def check(self, settings: Settings) -> None:
        """
        Refuse settings with which the map cannot go on.

        :raises InputError: naming those that differ
        """
        different = differing(settings, settings.voxel_size, self.settings, self.voxel_size)
        if different:
            raise InputError(
                f'cannot go on with the map {self.path}: '
                + ', '.join(f'{name} is {there} there and {here} here'
                            for name, here, there in different)
                + '; set what the map was built with')

    def load(self, reconstruction: Reconstruction) -> None:
        """
        Make an empty reconstruction the saved one.

        :param reconstruction: its settings may differ from the saved ones, but for the FIXED
        :raises InputError: see check; or if the content contradicts itself
        """
        self.check(reconstruction.settings)
        try:
            restore(reconstruction, self._numbers, self)
        except OSError as error:
            raise InputError(
                f'cannot read the map {self.path}: {error.strerror or error}') from error
        except InputError as error:
            raise InputError(f'cannot use the map {self.path}: {error}') from error

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> MapFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _descriptor_of(path: Path) -> int:
    """Open a file, and not wait for a writer where it is a pipe."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError('it is not a file')
    return descriptor


def _verified(stream: BufferedReader) -> int:
    """
    Check all of a map file, and go to its header.

    :return: bytes of the header
    :raises InputError: if it is no map, of another version, truncated or altered
    """
    line = stream.readline(len(_MAGIC) + 20)
    if not line.startswith(_MAGIC):
        raise InputError('it is not a map that gr2t saved')
    if line != _LINE:
        version = line[len(_MAGIC):].decode('ascii', 'replace').strip()
        raise InputError(
            f'it is of version {version!r}, but this program reads version {_VERSION}')
    size = os.fstat(stream.fileno()).st_size
    length = int.from_bytes(stream.read(_LENGTH), 'little')
    left = size - _CHECKSUM
    if len(_LINE) + _LENGTH + length > left:
        raise InputError('it is truncated or altered')
    stream.seek(0)
    checksum = hashlib.sha256()
    while left > 0 and (piece := stream.read(min(left, _PIECE))):
        checksum.update(piece)
        left -= len(piece)
    if stream.read(_CHECKSUM) != checksum.digest():
        raise InputError('it is truncated or altered: its checksum does not fit')
    stream.seek(len(_LINE) + _LENGTH)
    return length


def _row_bytes(kind: Kind) -> int:
    dtype, shape = kind
    return np.dtype(dtype).itemsize * prod(shape)
