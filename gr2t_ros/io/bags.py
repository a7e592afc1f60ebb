# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of every kind: what is in them, and their messages in order."""
from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

from ..errors import InputError

_FILES = ('.bag', '.mcap', '.db3')


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


class Bag:
    """
    One recording in one or several files or folders: rosbag1, rosbag2 sqlite3 and MCAP.

    :param paths: .bag, .mcap, .db3 files and rosbag2 folders; read as one, in order of log time
    :raises InputError: if one of them is missing or cannot be read
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        for path in paths:
            _check(path)
        if len({path.suffix == '.bag' for path in paths}) > 1:
            raise InputError('ROS 1 bags (.bag) and ROS 2 bags cannot be read as one recording')
        try:
            self._reader = self._open()
        except Exception as error:  # damaged files make the library raise anything
            raise InputError(
                f'{self.name} cannot be read ({_reason(error)}): it is damaged, cut off or no '
                f'bag; where a recorder was killed, {_repair(paths[0])} may help') from error
        self._undecoded: set[tuple[str, int]] = set()  # topic, log time
        self._cut = ''
        self.topics = self._list_topics()

    def _open(self) -> AnyReader:
        # the types are used where a bag does not bring its own: rosbag2 before Iron
        reader = AnyReader(
            list(self.paths), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader

    def _list_topics(self) -> dict[str, Topic]:
        names = sorted({connection.topic for connection in self._reader.connections})
        topics = {}
        for name in names:
            found = [item for item in self._reader.connections if item.topic == name]
            types = sorted({item.msgtype for item in found if item.msgcount})
            topics[name] = Topic(
                name, tuple(types or [found[0].msgtype]), sum(item.msgcount for item in found))
        return topics

    @property
    def name(self) -> str:
        """Return the paths as one text."""
        return ' '.join(str(path) for path in self.paths)

    @property
    def count(self) -> int:
        """Return the number of messages."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def begin_ns(self) -> int:
        """Return the first message's log time."""
        return int(self._reader.start_time) if self.count else 0

    @property
    def end_ns(self) -> int:
        """Return the last message's log time."""
        return int(self._reader.end_time) - 1 if self.count else 0

    @property
    def damage(self) -> str:
        """Return what could not be read so far, as a sentence; empty: nothing."""
        counts = Counter(topic for topic, _ in self._undecoded)
        parts = [f'{count} messages on {topic} could not be decoded'
                 for topic, count in sorted(counts.items())]
        return '; '.join([self._cut, *parts] if self._cut else parts)

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, Any, int]]:
        """
        Read messages in the order of their log times, one at a time.

        Where the recording turns out to be damaged the messages end, and `damage` says so.

        :param topics: only messages of these are decoded
        :param start_ns: first log time
        :param stop_ns: messages from here on are left out
        :return: topic, message, log time in nanoseconds
        """
        connections = [item for item in self._reader.connections if item.topic in topics]
        if not connections:
            return
        log_ns = start_ns or self.begin_ns
        try:
            for connection, log_ns, data in self._reader.messages(
                    connections, start=start_ns, stop=stop_ns):
                try:
                    message = self._reader.deserialize(data, connection.msgtype)
                except Exception:
                    self._undecoded.add((connection.topic, log_ns))
                    continue
                yield connection.topic, message, log_ns
        except Exception as error:
            seconds = (log_ns - self.begin_ns) * 1e-9
            self._cut = (f'{self.name} is damaged: used up to {seconds:.1f} s of '
                         f'{(self.end_ns - self.begin_ns) * 1e-9:.1f} s ({_reason(error)})')
            # a failure leaves the library's reader of ROS 1 bags unfit for further use
            self._reader.close()
            self._reader = self._open()

    def first(self, topic: str) -> Any:
        """Return a topic's first message that can be decoded, or None."""
        for _, message, _ in self.messages([topic]):
            return message
        return None

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _check(path: Path) -> None:
    """Refuse what is plainly no bag with a sentence that says so."""
    if not path.exists():
        raise InputError(f'{path}: no such file or folder')
    if path.is_dir():
        if not (path / 'metadata.yaml').is_file():
            inside = sorted(item for item in path.iterdir() if item.suffix in _FILES)
            hint = (f'; name the files inside instead: {" ".join(map(str, inside))}' if inside
                    else ' and no .bag, .mcap or .db3 file')
            raise InputError(f'{path} is no rosbag2 folder: it has no metadata.yaml{hint}')
    elif path.suffix not in _FILES:
        raise InputError(
            f'{path} is not a bag: .bag, .mcap and .db3 files and rosbag2 folders can be read')


def _repair(path: Path) -> str:
    if path.suffix == '.bag':
        return '`rosbag reindex`'
    if path.suffix == '.mcap' or any(path.glob('*.mcap')):
        return '`mcap recover`'
    return '`ros2 bag reindex`'


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).rstrip('.')
