# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What can still be read of a recording that is cut off or damaged.

A file is searched once from its begin to its end, and each message that is found is noted with its
place. They are read again from there in the order of their log times, so that memory is small,
whatever the file claims.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from bisect import bisect_left
import bz2
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
import sys
from typing import BinaryIO, NamedTuple

from lz4.frame import LZ4FrameDecompressor
import numpy as np

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_EXPANDED = 1 << 28  # bytes that a chunk may expand to; the largest image is half of it
_MAX_CACHED = 1 << 26  # bytes of expanded chunks that are kept
_PIECE = 1 << 16  # bytes that are expanded at a time: so much is lost before a damaged place
_MAX_LOSSES = 10_000  # that are told apart
_DECOMPRESSORS = {
    'zstd': zstd.ZstdDecompressor, 'lz4': LZ4FrameDecompressor, 'bz2': bz2.BZ2Decompressor}
IN_FILE = -1  # instead of a chunk


class Channel(NamedTuple):
    """
    What a recording says of the messages of one topic and publisher.

    :param kind: message type as ROS 2 writes it
    :param definition: of that type; empty: unknown
    :param form: of the definition, msg or idl
    """

    topic: str
    kind: str
    definition: str
    form: str


class Found(NamedTuple):
    """A message: its channel, its log time in nanoseconds, its bytes."""

    channel: Channel
    log_ns: int
    data: bytes


@dataclass
class Loss:
    """
    A damaged part of the file: not all that was in it can be read.

    :param begin: byte
    :param end: byte behind it
    :param after_ns: log time of the last message before it, nanoseconds; None: there is none
    """

    begin: int
    end: int
    after_ns: int | None


class Expanded(NamedTuple):
    """
    What was decompressed.

    :param data: bytes, as far as it could be done
    :param whole: whether these are all
    :param used: bytes of the compressed data before the damaged place
    """

    data: bytes
    whole: bool
    used: int


def expand(kind: str, data: bytes) -> Expanded:
    """
    Decompress, to MAX_EXPANDED bytes at most.

    :param kind: zstd, lz4 or bz2
    """
    decompressor = _DECOMPRESSORS[kind]()
    parts: list[bytes] = []
    room = MAX_EXPANDED
    used = 0
    try:
        for used in range(0, len(data), _PIECE):
            piece = data[used:used + _PIECE]
            while not decompressor.eof and room > 0:
                part = decompressor.decompress(piece, max_length=room)
                piece = b''
                parts.append(part)
                room -= len(part)
                if decompressor.needs_input:
                    break
    except Exception:  # each library has errors of its own
        return Expanded(b''.join(parts), False, used)
    return Expanded(b''.join(parts), decompressor.eof, len(data))


def unpack(file: BinaryIO, out: BinaryIO) -> bool:
    """Decompress a file of zstd as far as it can be done; tell whether this was all of it."""
    decompressor = zstd.ZstdDecompressor()
    try:
        while piece := file.read(_PIECE):
            while piece:
                if decompressor.eof:  # another frame
                    decompressor = zstd.ZstdDecompressor()
                out.write(decompressor.decompress(piece))
                piece = decompressor.unused_data
    except zstd.ZstdError:
        return False
    return bool(decompressor.eof)


class Source:
    """Bytes to read from: a file, or a chunk of it that was expanded."""

    def __init__(self, content: BinaryIO | bytes) -> None:
        self._content = content
        if isinstance(content, bytes):
            self.size = len(content)
        else:
            self.size = content.seek(0, 2)

    def read(self, at: int, size: int) -> bytes:
        """Return bytes; fewer at the end."""
        size = max(0, min(size, self.size - at))
        if isinstance(self._content, bytes):
            return self._content[at:at + size]
        self._content.seek(at)
        return self._content.read(size)


class Salvage(ABC):
    """
    The messages of a damaged file.

    losses: the damaged parts of the file. orphans: messages of channels that are not described.
    unread: messages that were found, but turned out to be damaged when they were read. counts:
    messages of each channel. expected: messages that the file says it has; None: it does not say.

    :param file: open for reading; closed by close
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.source = Source(file)
        self.channels: dict[int, Channel] = {}
        self.losses: list[Loss] = []
        self.orphans = 0
        self.unread: set[int] = set()
        self.expected: int | None = None
        # of each message
        self._channel = array('q')
        self._log_ns = array('q')
        self._chunk = array('q')
        self._at = array('q')
        self._size = array('q')
        self._search()
        self._sort()

    @abstractmethod
    def _search(self) -> None:
        """Find the channels and the messages."""

    @abstractmethod
    def _read(self, chunk: int, at: int, size: int) -> bytes | None:
        """Return a message's bytes; None: they cannot be read."""

    def _sort(self) -> None:
        """Put the messages in the order of log times, those of one time in that of the file."""
        known = np.isin(np.array(self._channel, np.int64), list(self.channels))
        self.orphans = int(np.count_nonzero(~known))
        order = np.flatnonzero(known)
        order = order[np.argsort(np.array(self._log_ns, np.int64)[order], kind='stable')]
        for name in ('_channel', '_log_ns', '_chunk', '_at', '_size'):
            values = np.array(getattr(self, name), np.int64)[order]
            setattr(self, name, array('q', values.tobytes()))
        self.counts = Counter(self._channel)

    @property
    def begin_ns(self) -> int:
        """Return the first log time; 0 without messages."""
        return self._log_ns[0] if self._log_ns else 0

    @property
    def end_ns(self) -> int:
        """Return the last log time; 0 without messages."""
        return self._log_ns[-1] if self._log_ns else 0

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Found]:
        """Return messages of some topics, by log time."""
        begin = 0 if start_ns is None else bisect_left(self._log_ns, start_ns)
        end = len(self._log_ns) if stop_ns is None else bisect_left(self._log_ns, stop_ns)
        for number in range(begin, end):
            channel = self.channels[self._channel[number]]
            if channel.topic not in topics:
                continue
            size = self._size[number]
            data = None
            if size <= MAX_EXPANDED:
                data = self._read(self._chunk[number], self._at[number], size)
            if data is None:
                self.unread.add(number)
            else:
                yield Found(channel, self._log_ns[number], data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _note(self, channel: int, log_ns: int, chunk: int, at: int, size: int) -> None:
        """Note a message that was found."""
        self._channel.append(channel)
        self._log_ns.append(log_ns)
        self._chunk.append(chunk)
        self._at.append(at)
        self._size.append(size)

    def _lose(self, begin: int, end: int) -> None:
        """Note a damaged part of the file."""
        last = self.losses[-1] if self.losses else None
        if last and (begin <= last.end or len(self.losses) == _MAX_LOSSES):
            last.end = max(last.end, end)
        else:
            self.losses.append(Loss(begin, end, self._log_ns[-1] if self._log_ns else None))


class Record(NamedTuple):
    """
    A record of a file.

    :param kind: as the format numbers them
    :param body: where its content begins
    :param end: where the next record begins: behind it, or inside it where it holds records
    :param packed: whether it holds records compressed
    """

    kind: int
    body: int
    end: int
    packed: bool = False


class RecordSalvage(Salvage):
    """The messages of a damaged file of records, which may be in compressed chunks."""

    begin: int  # byte of the first record

    def __init__(self, file: BinaryIO) -> None:
        self._expanded: OrderedDict[int, bytes] = OrderedDict()
        self._cut = False  # whether a chunk should go on behind the end
        super().__init__(file)

    def _search(self) -> None:
        self._walk(self.source, self.begin, IN_FILE)
        if self._cut:
            self._lose(self.source.size, self.source.size)

    @abstractmethod
    def _parse(self, source: Source, at: int) -> Record | None:
        """Return the record that begins at a byte; None: there is none, or it is cut off."""

    @abstractmethod
    def _take(self, source: Source, record: Record, chunk: int) -> None:
        """Note what a record holds."""

    @abstractmethod
    def _expand_chunk(self, chunk: int) -> bytes:
        """Return what a chunk holds, as far as it can be read."""

    @abstractmethod
    def _next(self, source: Source, at: int, *, outside: bool) -> int:
        """
        Return the first byte from one on at which a record surely begins; or else the size.

        :param outside: take chunks only: what looks like others may be inside a compressed one
        """

    def _walk(self, source: Source, at: int, chunk: int) -> bool:
        """Take all records of a file or an expanded chunk; tell whether they were all whole."""
        whole = True
        while at < source.size:
            record = self._parse(source, at)
            if record is None or not self._begins(source, record.end):
                # the length of this record may be wrong, or the next one damaged
                packed = record is not None and record.packed
                found = self._next(source, at + 1, outside=packed)
                if record is not None and packed:
                    self._take(source, record, chunk)
                    at = min(found, record.end)
                    continue
                if record is None or found < record.end:
                    if chunk == IN_FILE:
                        self._lose(at, found)
                    whole = False
                    at = found
                    continue
            self._take(source, record, chunk)
            at = record.end
        return whole

    def _begins(self, source: Source, at: int) -> bool:
        return at == source.size or self._parse(source, at) is not None

    def _read(self, chunk: int, at: int, size: int) -> bytes | None:
        """Return a message's bytes; None: they cannot be read."""
        if chunk == IN_FILE:
            data = self.source.read(at, size)
        else:
            if chunk not in self._expanded:
                self._expanded[chunk] = self._expand_chunk(chunk)
                while (len(self._expanded) > 1
                       and sum(map(len, self._expanded.values())) > _MAX_CACHED):
                    self._expanded.popitem(last=False)
            self._expanded.move_to_end(chunk)
            data = self._expanded[chunk][at:at + size]
        return data if len(data) == size else None
