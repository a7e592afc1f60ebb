# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One file of a recording: read by rosbags, or where that fails by what can be salvaged."""
from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

from ..errors import InputError
from .salvage import Channel, expand, Loss, Salvage, unpack
from .salvage_mcap import McapSalvage
from .salvage_rosbag1 import Rosbag1Salvage
from .salvage_sqlite3 import Sqlite3Salvage

ROS1_ENDINGS = ('.bag', '.bag.active')
_ROS2_ENDINGS = tuple(f'{kind}{more}' for kind in ('.mcap', '.db3') for more in ('', '.zstd'))
ENDINGS = (*ROS1_ENDINGS, *_ROS2_ENDINGS)
_ZSTD = b'\x28\xb5\x2f\xfd'  # begins a message that was compressed on its own
_PLACES = 3  # damaged parts that are named
_IDL_SEPARATOR = f'{"=" * 80}\nIDL: '


@dataclass(frozen=True)
class Topic:
    """
    A topic of a recording.

    :param types: message types as ROS 2 writes them; several where publishers disagreed
    :param count: messages
    """

    name: str
    types: tuple[str, ...]
    count: int


class Raw(NamedTuple):
    """A message as it was recorded: log time in nanoseconds, topic, type, bytes."""

    log_ns: int
    topic: str
    kind: str
    data: bytes


class BagFile:
    """
    One file of a recording.

    Where rosbags cannot read it, or fails while it does, what can be salvaged is read instead, and
    `damage` says what is lost.

    :param path: with one of ENDINGS
    :raises InputError: if it cannot be opened
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ros1 = path.name.endswith(ROS1_ENDINGS)
        self._stack = ExitStack()
        self._unpacked = path
        self._notes: list[str] = []
        self._missing: dict[str, int] = {}  # of topics: messages that the index promised
        self._reader: _Whole | _Salvaged
        try:
            with path.open('rb'):
                pass
            if path.suffix == '.zstd':
                self._unpack()
            self._reader = self._open()
        except OSError as error:
            self._stack.close()
            raise InputError(
                f'{path} cannot be read: {error.strerror or error}') from error

    def _unpack(self) -> None:
        """Decompress the file beside the others that are temporary, as far as it goes."""
        folder = self._stack.enter_context(TemporaryDirectory())
        self._unpacked = Path(folder) / self.path.stem
        with self.path.open('rb') as file, self._unpacked.open('wb') as out:
            if not unpack(file, out):
                self._notes.append(f'{self.path} is cut off or damaged: {out.tell()} bytes of '
                                   'what it holds could be decompressed')

    def _open(self) -> _Whole | _Salvaged:
        # rosbags passes over the log of a recorder that was killed
        if not self._unpacked.with_name(f'{self._unpacked.name}-wal').exists():
            try:
                return _Whole(self._unpacked)
            except Exception as error:  # damaged files make the library raise anything
                reason = _reason(error).replace(f'Cannot open database {self._unpacked}: ', '')
                return _Salvaged(self._unpacked, reason)
        return _Salvaged(self._unpacked, '')

    @property
    def topics(self) -> list[Topic]:
        """Return what it holds."""
        return self._reader.topics()

    @property
    def begin_ns(self) -> int:
        """Return the first message's log time."""
        return self._reader.begin_ns

    @property
    def end_ns(self) -> int:
        """Return the last message's log time."""
        return self._reader.end_ns

    @property
    def damage(self) -> list[str]:
        """Return sentences without full stops on what cannot be read, as far as is known."""
        return [
            *self._notes, *self._reader.damage(self.path),
            *(f'{self.path} holds {count} messages fewer on {topic} than its index says'
              for topic, count in self._missing.items())]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Raw]:
        """Read messages of some topics from one log time up to before another, in their order."""
        last_ns = start_ns
        now: Counter[str] = Counter()  # messages with that log time
        whole: Counter[str] = Counter()
        try:
            for raw in self._reader.messages(topics, start_ns, stop_ns):
                if raw.log_ns != last_ns:
                    last_ns = raw.log_ns
                    now.clear()
                now[raw.topic] += 1
                whole[raw.topic] += 1
                yield raw
            self._compare(topics, start_ns, stop_ns, whole)
            return
        except Exception as error:  # see _open
            self._reader.close()
            self._reader = _Salvaged(self._unpacked, _reason(error))
        for raw in self._reader.messages(topics, last_ns, stop_ns):
            if raw.log_ns == last_ns and now[raw.topic]:
                now[raw.topic] -= 1
            else:
                yield raw

    def _compare(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None,
        found: Counter[str],
    ) -> None:
        """Note where an index led to fewer messages than it said."""
        if isinstance(self._reader, _Whole) and (start_ns or 0) <= self.begin_ns and (
                stop_ns is None or stop_ns > self.end_ns):
            self._missing.update(
                (topic.name, topic.count - found[topic.name]) for topic in self.topics
                if topic.name in topics and topic.count > found[topic.name])

    def decode(self, raw: Raw) -> Any:
        """
        Return a message.

        :raises Exception: whatever its decoder raises where it is damaged
        """
        data = raw.data
        if not self._ros1 and data.startswith(_ZSTD):
            data, whole, _ = expand('zstd', data)
            if not whole:
                raise ValueError('it cannot be decompressed')
        return self._reader.decode(raw.kind, data)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()
        self._stack.close()

    def __enter__(self) -> BagFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _Whole:
    """A file that rosbags can read."""

    def __init__(self, path: Path) -> None:
        # the types are used where a file does not bring its own: rosbag2 before Iron
        self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        self._reader.open()
        filled = any(item.msgcount for item in self._reader.connections)
        self.begin_ns = int(self._reader.start_time) if filled else 0
        self.end_ns = int(self._reader.end_time) - 1 if filled else 0

    def topics(self) -> list[Topic]:
        return _topics((item.topic, item.msgtype, item.msgcount)
                       for item in self._reader.connections)

    def messages(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[Raw]:
        connections = [item for item in self._reader.connections if item.topic in topics]
        if connections:
            for connection, log_ns, data in self._reader.messages(
                    connections, start=start_ns, stop=stop_ns):
                yield Raw(log_ns, connection.topic, connection.msgtype, data)

    def decode(self, kind: str, data: bytes) -> Any:
        return self._reader.deserialize(data, kind)

    def damage(self, path: Path) -> list[str]:
        return []

    def close(self) -> None:
        self._reader.close()


class _Salvaged:
    """
    A file that rosbags cannot read.

    :param reason: why not
    """

    def __init__(self, path: Path, reason: str) -> None:
        self._reason = reason
        self._salvage = _salvage(path)
        self._ros1 = path.name.endswith(ROS1_ENDINGS)
        self._store = _typestore(self._salvage.channels.values(), self._ros1)
        self.begin_ns = self._salvage.begin_ns
        self.end_ns = self._salvage.end_ns

    def topics(self) -> list[Topic]:
        return _topics((channel.topic, channel.kind, self._salvage.counts[number])
                       for number, channel in self._salvage.channels.items())

    def messages(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[Raw]:
        for channel, log_ns, data in self._salvage.messages(topics, start_ns, stop_ns):
            yield Raw(log_ns, channel.topic, channel.kind, data)

    def decode(self, kind: str, data: bytes) -> Any:
        if self._ros1:
            return self._store.deserialize_ros1(data, kind)
        return self._store.deserialize_cdr(data, kind)

    def damage(self, path: Path) -> list[str]:
        found = self._salvage
        count = found.counts.total() - len(found.unread)
        lost = max(0, (found.expected or 0) - count)
        if not (self._reason or lost or found.losses or found.orphans):
            return []
        parts = [f'{path} is damaged' + (f' ({self._reason})' if self._reason else '')
                 + f': {count} messages' + (f' of {found.expected}' if lost else '')
                 + ' can be read']
        if found.losses:
            damaged = sum(loss.end - loss.begin for loss in found.losses)
            places = [self._place(loss) for loss in found.losses[:_PLACES]]
            if len(found.losses) > _PLACES:
                places.append(f'and {len(found.losses) - _PLACES} more places')
            size = max(found.source.size, found.losses[-1].end)
            parts.append((f'{damaged} of {size} bytes are damaged or lost: ' if damaged else '')
                         + ', '.join(places))
        if found.unread:
            parts.append(f'{len(found.unread)} messages are incomplete')
        if found.orphans:
            parts.append(f'{found.orphans} messages are of topics that nothing describes')
        return ['; '.join(parts)]

    def _place(self, loss: Loss) -> str:
        place = f'from byte {loss.begin} to {loss.end}'
        if loss.begin == loss.end:
            place = f'cut off at byte {loss.end}'
        if loss.after_ns is None:
            return f'{place}, before the first message'
        return f'{place}, after {(loss.after_ns - self.begin_ns) * 1e-9:.1f} s'

    def close(self) -> None:
        self._salvage.close()


def _salvage(path: Path) -> Salvage:
    if path.suffix == '.db3':
        return Sqlite3Salvage(path)
    kind = McapSalvage if path.suffix == '.mcap' else Rosbag1Salvage
    file = path.open('rb')
    try:
        return kind(file)
    except BaseException:
        file.close()
        raise


def _topics(items: Iterable[tuple[str, str, int]]) -> list[Topic]:
    """Return the topics of channels: topic, type, messages."""
    found = sorted(items)
    topics = []
    for name in dict.fromkeys(item[0] for item in found):
        kinds = {kind: count for topic, kind, count in found if topic == name}
        types = [kind for topic, kind, count in found if topic == name and count]
        topics.append(Topic(
            name, tuple(dict.fromkeys(types)) or tuple(kinds)[:1],
            sum(count for topic, _, count in found if topic == name)))
    return topics


def _typestore(channels: Iterable[Channel], ros1: bool) -> Any:
    """Return types for decoding: those that the file describes, and ROS's."""
    standard = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for channel in channels:
        try:
            found = _types(channel)
        except Exception:  # damaged text makes the parser raise anything
            continue
        for name, fields in found.items():
            types.setdefault(name, fields)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register({**standard.fielddefs, **types})
    except Exception:  # as above
        return standard
    return store


def _types(channel: Channel) -> dict[str, Any]:
    if channel.form == 'msg' and channel.definition:
        return dict(get_types_from_msg(channel.definition, channel.kind))
    found: dict[str, Any] = {}
    if channel.form == 'idl':
        for text in channel.definition.split(_IDL_SEPARATOR):
            found.update(get_types_from_idl(text.partition('\n')[2] if text else ''))
    return found


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError | OverflowError):
        return 'a record claims to be huge'
    return (str(error) or type(error).__name__).rstrip('.').partition('\n')[0]
