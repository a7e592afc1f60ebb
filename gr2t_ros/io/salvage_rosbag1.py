# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged ROS 1 bag (wiki.ros.org/Bags/Format/2.0)."""
from __future__ import annotations

import struct

from rosbags.rosbag1.reader import normalize
from rosbags.typesys.msg import normalize_msgtype

from .salvage import Channel, expand, IN_FILE, MAX_EXPANDED, Record, RecordSalvage, Source

_MAGIC = b'#ROSBAG V2.0\n'
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_KINDS = range(2, 8)
_COMPRESSIONS = ('none', 'bz2', 'lz4')
_MAX_HEADER = 1 << 16  # bytes; the longest hold a topic's name
_MAX_TEXT = 1 << 24  # bytes of a message definition
_BLOCK = 1 << 20  # bytes that are searched at a time
_OPERATION = b'\x04\x00\x00\x00op='  # in every record's header
_FARTHEST = 200  # bytes from a header's begin to this
_TIME = struct.Struct('<II')  # seconds, nanoseconds


class Rosbag1Salvage(RecordSalvage):
    """The messages of a damaged ROS 1 bag."""

    begin = len(_MAGIC)

    def _parse(self, source: Source, at: int) -> Record | None:
        header = self._header(source, at)
        if header is None:
            return None
        fields, body, size = header
        kind = fields['op'][0]
        if kind == _CHUNK:
            compression = fields.get('compression', b'').decode('latin-1')
            if compression not in _COMPRESSIONS:
                return None
            # a chunk that is cut off holds something too
            end = body if compression == 'none' else body + size
            return Record(kind, at, min(end, source.size), packed=compression != 'none')
        if body + size > source.size or (
                kind == _MESSAGE and not len(fields.get('conn', b'')) == 4 == len(
                    fields.get('time', bytes(8))[4:])):
            return None
        return Record(kind, at, body + size)

    def _header(self, source: Source, at: int) -> tuple[dict[str, bytes], int, int] | None:
        """Return a header's fields, where the record's content begins, and its size."""
        length = int.from_bytes(source.read(at, 4), 'little')
        if not 8 <= length <= _MAX_HEADER:
            return None
        data = source.read(at + 4, length + 4)
        if len(data) < length + 4:
            return None
        fields = _fields(data[:length])
        if fields is None or len(fields.get('op', b'')) != 1 or fields['op'][0] not in _KINDS:
            return None
        return fields, at + length + 8, int.from_bytes(data[length:], 'little')

    def _take(self, source: Source, record: Record, chunk: int) -> None:
        header = self._header(source, record.body)
        assert header
        fields, body, size = header
        if record.kind == _MESSAGE:
            seconds, nanoseconds = _TIME.unpack(fields['time'])
            self._note(int.from_bytes(fields['conn'], 'little'),
                       seconds * 1_000_000_000 + nanoseconds, chunk, body, size)
        elif record.kind == _CONNECTION and size <= _MAX_TEXT:
            self._take_connection(fields, _fields(source.read(body, size)))
        elif record.kind == _CHUNK and chunk == IN_FILE:
            compression = fields['compression'].decode('latin-1')
            self._cut |= body + size > source.size
            if compression == 'none':  # its records come next
                return
            data, whole, used = expand(compression, source.read(body, min(size, MAX_EXPANDED)))
            sound = self._walk(Source(data), 0, record.body)
            if not (whole and sound) and body + size <= source.size:
                self._lose(record.body if whole else body + used, record.end)

    def _take_connection(
        self, fields: dict[str, bytes], inside: dict[str, bytes] | None
    ) -> None:
        """Take a connection; one that cannot be read says nothing."""
        if not inside or len(fields.get('conn', b'')) != 4:
            return
        try:
            topic, kind = fields['topic'].decode(), inside['type'].decode()
            definition = inside['message_definition'].decode()
        except (KeyError, ValueError):
            return
        if topic and kind:
            self.channels.setdefault(int.from_bytes(fields['conn'], 'little'), Channel(
                normalize(topic), normalize_msgtype(kind), definition, 'msg'))

    def _expand_chunk(self, chunk: int) -> bytes:
        header = self._header(self.source, chunk)
        assert header
        fields, body, size = header
        return expand(fields['compression'].decode('latin-1'),
                      self.source.read(body, min(size, MAX_EXPANDED))).data

    def _next(self, source: Source, at: int, *, outside: bool) -> int:
        begin = at
        while at < source.size:
            block = source.read(at, _BLOCK + _FARTHEST)
            found = block.find(_OPERATION)
            while 0 <= found < _BLOCK:
                for start in range(max(begin, at + found - _FARTHEST), at + found - 3):
                    record = self._parse(source, start)
                    # not a header further back whose content this is
                    if record is not None and (
                            record.kind == _CHUNK or not outside) and self._ends_behind(
                                source, start, at + found):
                        return start
                found = block.find(_OPERATION, found + 1)
            at += _BLOCK
        return source.size

    def _ends_behind(self, source: Source, start: int, place: int) -> bool:
        return start + 4 + int.from_bytes(source.read(start, 4), 'little') > place


def _fields(data: bytes) -> dict[str, bytes] | None:
    """Return a header's fields; None where it is none."""
    fields = {}
    at = 0
    while at < len(data):
        end = at + 4 + int.from_bytes(data[at:at + 4], 'little')
        name, sign, value = data[at + 4:end].partition(b'=')
        if end > len(data) or not sign or not name.isascii():
            return None
        fields[name.decode()] = value
        at = end
    return fields
