# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What can still be read of a damaged sqlite3 recording (sqlite.org/fileformat2.html).

Its pages are searched for rows of messages, without the tree that leads to them, as the command
.recover of sqlite's shell does it. Those of a write-ahead log, which a killed recorder leaves
beside the file, are read too.
"""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
import struct
from typing import NamedTuple

import numpy as np

from .salvage import Channel, MAX_EXPANDED, Salvage, Source

_MAGIC = b'SQLite format 3\x00'
_LEAF = 0x0d  # of a table
_FILE_HEADER = 100  # bytes, in the first page
_PAGE_SIZES = tuple(1 << n for n in range(9, 17))
_LOG_HEADER, _FRAME_HEADER = 32, 24
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}  # a column's type -> bytes
_FIRST_BLOB, _FIRST_TEXT = 12, 13  # types; two more are one byte longer
_MAX_TEXT = 1 << 24  # bytes of a row of text
_MAX_COLUMNS = 10
_BLOCK = 256  # pages that are looked at at a time


class _Row(NamedTuple):
    """
    A row of a table.

    :param size: of the content: the header and the columns
    :param local: where that begins in the page
    :param stored: how much of it is in the page
    :param rest: page in which it goes on; 0: none
    """

    number: int
    size: int
    local: int
    stored: int
    rest: int


class Sqlite3Salvage(Salvage):
    """
    The messages of a damaged sqlite3 recording.

    :param path: the file; its log has the same name with -wal
    """

    def __init__(self, path: Path) -> None:
        with ExitStack() as stack:
            file = stack.enter_context(path.open('rb'))
            log = path.with_name(f'{path.name}-wal')
            self._log = stack.enter_context(log.open('rb')) if log.exists() else None
            super().__init__(file)
            stack.pop_all()

    def close(self) -> None:
        """Close the files."""
        super().close()
        if self._log:
            self._log.close()

    def _search(self) -> None:
        head = self.source.read(0, _FILE_HEADER)
        size = int.from_bytes(head[16:18], 'big')
        size = 65536 if size == 1 else size
        known = head[:16] == _MAGIC and size in _PAGE_SIZES
        self._page_size = size if known else 4096
        self._usable = self._page_size - (head[20] if known else 0)
        self._logged: dict[int, int] = {}  # page -> its place in the log
        self._log_source = Source(self._log) if self._log else Source(b'')
        self._read_log()
        claimed = int.from_bytes(head[28:32], 'big') * self._page_size if known else 0
        self._kinds: dict[str, tuple[str, str]] = {}  # type -> definition, its form
        self._topics: dict[int, tuple[str, str]] = {}  # name, type
        rows: set[int] = set()  # of messages
        for page, data in self._leaves():
            for row in self._rows(page, data):
                self._take(page, data, row, rows)
        if claimed > self.source.size and not self._logged:
            self._lose(self.source.size, claimed)
        self.expected = max(rows, default=0)  # they are numbered from 1 on
        for number, (topic, kind) in self._topics.items():
            self.channels[number] = Channel(topic, kind, *self._kinds.get(kind, ('', '')))

    def _read_log(self) -> None:
        """Find the newest pages in the log, up to the last that ends a transaction."""
        source = self._log_source
        head = source.read(0, _LOG_HEADER)
        if len(head) < _LOG_HEADER or int.from_bytes(head[8:12], 'big') != self._page_size:
            return
        at = _LOG_HEADER
        open_pages: dict[int, int] = {}
        while at + _FRAME_HEADER + self._page_size <= source.size:
            page, commit = struct.unpack('>II', source.read(at, 8))
            if source.read(at + 8, 8) != head[16:24]:  # of an older use of the log
                break
            open_pages[page] = at + _FRAME_HEADER
            if commit:
                self._logged.update(open_pages)
                open_pages.clear()
            at += _FRAME_HEADER + self._page_size

    def _page(self, number: int) -> bytes:
        if number in self._logged:
            return self._log_source.read(self._logged[number], self._page_size)
        return self.source.read((number - 1) * self._page_size, self._page_size)

    def _leaves(self) -> Iterator[tuple[int, bytes]]:
        """Return all pages that may hold rows: number and content."""
        size = self._page_size
        for first in range(0, self.source.size, size * _BLOCK):
            block = self.source.read(first, size * _BLOCK)
            kinds = np.frombuffer(block, np.uint8)[::size].copy()
            if first == 0 and len(block) > _FILE_HEADER:
                kinds[0] = block[_FILE_HEADER]
            for index in np.flatnonzero(kinds == _LEAF).tolist():
                page = first // size + index + 1
                if page not in self._logged:
                    yield page, block[index * size:(index + 1) * size]
        for page in sorted(self._logged):
            data = self._page(page)
            if data[_FILE_HEADER if page == 1 else 0] == _LEAF:
                yield page, data

    def _rows(self, page: int, data: bytes) -> Iterator[tuple[int, _Row]]:
        """Return a page's rows: where each begins, and itself."""
        begin = _FILE_HEADER if page == 1 else 0
        count = int.from_bytes(data[begin + 3:begin + 5], 'big')
        for index in range(min(count, self._page_size // 4)):
            at = begin + 8 + 2 * index
            place = int.from_bytes(data[at:at + 2], 'big')
            row = self._row(data, place)
            if row is not None:
                yield place, row

    def _row(self, data: bytes, place: int) -> _Row | None:
        if not 8 <= place < len(data):
            return None
        size, at = _varint(data, place)
        number, at = _varint(data, at)
        usable = self._usable
        stored = size
        if size > usable - 35:
            least = (usable - 12) * 32 // 255 - 23
            stored = least + (size - least) % (usable - 4)
            if stored > usable - 35:
                stored = least
        end = at + stored
        if end + 4 * (stored < size) > len(data):
            return None
        rest = int.from_bytes(data[end:end + 4], 'big') if stored < size else 0
        return _Row(number, size, at, stored, rest)

    def _take(
        self, page: int, data: bytes, found: tuple[int, _Row], rows: set[int]
    ) -> None:
        """Note what a row holds, if it is one of a message, a topic or a definition."""
        place, row = found
        kinds, at = _header(data[row.local:row.local + row.stored])
        if len(kinds) == 4 and kinds[0] == 0 and kinds[1] in (8, 9, *_INTEGERS) and (
                kinds[2] in _INTEGERS and kinds[3] >= _FIRST_BLOB and not kinds[3] % 2):
            topic, at = _integer(data, row.local + at, kinds[1])
            log_ns, _ = _integer(data, at, kinds[2])
            if row.number not in rows:
                rows.add(row.number)
                self._note(topic, log_ns, page, place, (kinds[3] - _FIRST_BLOB) // 2)
        elif len(kinds) >= 4 and kinds[0] == 0 and row.size <= _MAX_TEXT and all(
                kind >= _FIRST_TEXT and kind % 2 for kind in kinds[1:4]):
            self._take_text(row, kinds, at, self._content(data, row))

    def _take_text(self, row: _Row, kinds: list[int], at: int, content: bytes | None) -> None:
        """Take a topic or a definition; one that cannot be read says nothing."""
        if content is None:
            return
        texts = []
        for kind in kinds[1:4]:
            end = at + (kind - _FIRST_TEXT) // 2
            texts.append(content[at:end].decode(errors='replace'))
            at = end
        if texts[1] in ('ros2msg', 'ros2idl'):
            self._kinds.setdefault(texts[0], (texts[2], texts[1][4:]))
        elif '/' in texts[1]:
            self._topics.setdefault(row.number, (texts[0], texts[1]))

    def _read(self, chunk: int, at: int, size: int) -> bytes | None:
        data = self._page(chunk)
        row = self._row(data, at)
        content = self._content(data, row) if row else None
        return content[-size:] if content is not None and size else content

    def _content(self, data: bytes, row: _Row) -> bytes | None:
        """Return a row's content; None: it is cut off."""
        parts = [data[row.local:row.local + row.stored]]
        left = row.size - row.stored
        if row.size > MAX_EXPANDED:
            return None
        page = row.rest
        while left > 0:
            data = self._page(page) if page else b''
            part = data[4:min(self._usable, 4 + left)]
            if len(part) < min(left, self._usable - 4):
                return None
            parts.append(part)
            left -= len(part)
            page = int.from_bytes(data[:4], 'big')
        return b''.join(parts)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of one to nine bytes and where it ends; 0 where the data end before."""
    value = 0
    for count, byte in enumerate(data[at:at + 9]):
        if count == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7f
        if byte < 0x80:
            return value, at + count + 1
    return 0, len(data)


def _header(content: bytes) -> tuple[list[int], int]:
    """Return the types of a row's columns and where the first begins; none where it is no row."""
    end, at = _varint(content, 0)
    kinds: list[int] = []
    while at < end <= len(content) and len(kinds) < _MAX_COLUMNS:
        kind, at = _varint(content, at)
        kinds.append(kind)
    return (kinds, end) if at == end else ([], 0)


def _integer(data: bytes, at: int, kind: int) -> tuple[int, int]:
    if kind in (8, 9):
        return kind - 8, at
    end = at + _INTEGERS[kind]
    return int.from_bytes(data[at:end], 'big', signed=True), end
