# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What can still be read of a damaged MCAP file (specification: mcap.dev/spec).

The mcap library's NonSeekingReader reads a file up to the first damaged record, and no further.
"""
from __future__ import annotations

import struct
import zlib

import numpy as np

from .salvage import Channel, expand, IN_FILE, MAX_EXPANDED, Record, RecordSalvage, Source

_MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')  # kind, length of the content
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _LAST = 3, 4, 5, 6, 0x0b, 0x0f
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct('<QQQII')  # begin, end, expanded size, checksum, length of the name
_FORMS = {'ros2msg': 'msg', 'ros2idl': 'idl', 'omgidl': 'idl'}
_COMPRESSIONS = ('', 'zstd', 'lz4')
_MAX_TEXT = 1 << 24  # bytes of a schema or channel
_BLOCK = 1 << 20  # bytes that are searched at a time
_DAY_NS = 86_400_000_000_000


class McapSalvage(RecordSalvage):
    """The messages of a damaged MCAP file."""

    def _search(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}  # name, form, definition
        self._channel_schemas: dict[int, tuple[str, int]] = {}  # topic, schema
        self.begin = len(_MAGIC) if self.source.read(0, len(_MAGIC)) == _MAGIC else 0
        super()._search()
        for number, (topic, schema) in self._channel_schemas.items():
            name, form, definition = self._schemas.get(schema, ('', '', ''))
            if name:
                self.channels[number] = Channel(topic, name, definition, form)

    def _parse(self, source: Source, at: int) -> Record | None:
        head = source.read(at, _HEAD.size)
        if head[:8] == _MAGIC and at == source.size - len(_MAGIC):
            return Record(0, at, source.size)
        if len(head) < _HEAD.size:
            return None
        kind, length = _HEAD.unpack(head)
        body = at + _HEAD.size
        if kind == _CHUNK:
            inside = self._content(source, body, length)
            if inside is None:
                return None
            compression, content, size = inside
            # a chunk that is cut off holds something too
            end = content + size if compression else content
            return Record(kind, body, min(end, source.size), packed=bool(compression))
        if not 0 < kind <= _LAST or body + length > source.size or (
                kind == _MESSAGE and length < _MESSAGE_HEAD.size):
            return None
        return Record(kind, body, body + length)

    def _content(self, source: Source, body: int, length: int) -> tuple[str, int, int] | None:
        """Return a chunk's compression, where its content begins, and its size."""
        head = source.read(body, _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return None
        name_size = _CHUNK_HEAD.unpack(head)[-1]
        rest = source.read(body + _CHUNK_HEAD.size, min(name_size, 8) + 8)
        if name_size > 8 or len(rest) < name_size + 8:
            return None
        name = rest[:name_size].decode('latin-1')
        size = int.from_bytes(rest[name_size:], 'little')
        content = _CHUNK_HEAD.size + name_size + 8
        if name not in _COMPRESSIONS or content + size != length:
            return None
        return name, body + content, size

    def _take(self, source: Source, record: Record, chunk: int) -> None:
        if record.kind == _MESSAGE:
            channel, _, log_ns, _ = _MESSAGE_HEAD.unpack(
                source.read(record.body, _MESSAGE_HEAD.size))
            at = record.body + _MESSAGE_HEAD.size
            if log_ns < 1 << 63:
                self._note(channel, log_ns, chunk, at, record.end - at)
        elif record.kind == _CHUNK and chunk == IN_FILE:
            self._take_chunk(record)
        elif record.kind in (_SCHEMA, _CHANNEL, _STATISTICS) and (
                (size := record.end - record.body) <= _MAX_TEXT):
            self._take_text(record.kind, source.read(record.body, size))

    def _take_chunk(self, record: Record) -> None:
        source = self.source
        length = _HEAD.unpack(source.read(record.body - _HEAD.size, _HEAD.size))[1]
        inside = self._content(source, record.body, length)
        assert inside
        compression, content, size = inside
        checksum = _CHUNK_HEAD.unpack(source.read(record.body, _CHUNK_HEAD.size))[3]
        begin, end = record.body - _HEAD.size, content + size
        self._cut |= end > source.size
        if not compression:  # its records come next
            if checksum and end <= source.size and _checksum(source, content, end) != checksum:
                self._lose(begin, end)
            return
        data, whole, used = expand(compression, source.read(content, min(size, MAX_EXPANDED)))
        sound = self._walk(Source(data), 0, begin) and (
            not checksum or zlib.crc32(data) == checksum)
        if not (whole and sound) and end <= source.size:
            self._lose(begin if whole else content + used, record.end)

    def _expand_chunk(self, chunk: int) -> bytes:
        length = _HEAD.unpack(self.source.read(chunk, _HEAD.size))[1]
        inside = self._content(self.source, chunk + _HEAD.size, length)
        assert inside
        compression, content, size = inside
        return expand(compression, self.source.read(content, min(size, MAX_EXPANDED))).data

    def _take_text(self, kind: int, body: bytes) -> None:
        """Take a schema, a channel or the statistics; one that cannot be read says nothing."""
        try:
            if kind == _STATISTICS:
                self.expected = int.from_bytes(body[:8], 'little')
                return
            number = int.from_bytes(body[:2], 'little')
            if kind == _SCHEMA:
                name, at = _text(body, 2)
                encoding, at = _text(body, at)
                definition, _ = _text(body, at)
                self._schemas.setdefault(number, (name, _FORMS.get(encoding, ''), definition))
            else:
                topic, _ = _text(body, 4)
                self._channel_schemas.setdefault(
                    number, (topic, int.from_bytes(body[2:4], 'little')))
        except ValueError:
            return

    def _next(self, source: Source, at: int, *, outside: bool) -> int:
        first = _CHUNK if outside else _SCHEMA
        while at < source.size:
            block = np.frombuffer(source.read(at, _BLOCK + _HEAD.size), np.uint8)
            starts = block[:max(0, len(block) - _HEAD.size)]
            small = np.ones(len(starts), bool)
            for byte in (6, 7, 8):  # of the length: above 2^40
                small &= block[byte:byte + len(starts)] == 0
            for candidate in np.flatnonzero(
                    small & (starts >= first) & (starts <= _CHUNK)).tolist():
                if self._is_sure(source, at + candidate):
                    return at + candidate
            at += _BLOCK
        return source.size

    def _is_sure(self, source: Source, at: int) -> bool:
        """Tell whether a record begins here, rather than bytes that look like one."""
        record = self._parse(source, at)
        if record is None:
            return False
        if record.kind == _CHUNK:
            return True
        if record.kind == _MESSAGE and record.body + _MESSAGE_HEAD.size <= record.end:
            channel, _, log_ns, _ = _MESSAGE_HEAD.unpack(
                source.read(record.body, _MESSAGE_HEAD.size))
            if channel in self._channel_schemas and self._log_ns and (
                    abs(log_ns - self._log_ns[-1]) < _DAY_NS):
                return True
        for _ in range(2):
            if record.end == source.size:
                return True
            following = self._parse(source, record.end)
            if following is None:
                return False
            record = following
        return True


def _checksum(source: Source, at: int, end: int) -> int:
    checksum = 0
    while at < end:
        piece = source.read(at, min(_BLOCK, end - at))
        checksum = zlib.crc32(piece, checksum)
        at += len(piece)
    return checksum


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Return a text and where it ends; ValueError where it is cut off or no text."""
    end = at + 4 + int.from_bytes(body[at:at + 4], 'little')
    if end > len(body):
        raise ValueError('cut off')
    return body[at + 4:end].decode(), end
