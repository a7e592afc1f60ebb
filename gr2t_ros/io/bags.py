# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of every kind: what is in them, and their messages in order."""
from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from heapq import merge
from pathlib import Path
import re
from types import TracebackType
from typing import Any

import yaml

from ..errors import InputError
from .bag_files import BagFile, ENDINGS, Raw, ROS1_ENDINGS, Topic

_KINDS = '.bag, .mcap and .db3'


class Bag:
    """
    One recording in one or several files or folders: rosbag1, rosbag2 sqlite3 and MCAP.

    What is damaged or cut off is used as far as it can be read, see `damage`.

    :param paths: .bag, .mcap, .db3 files and rosbag2 folders; read as one, in order of log time
    :raises InputError: if one of them is missing, or nothing in it can be read
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        self._notes: list[str] = []
        files = [file for path in paths for file in self._files_of(path)]
        if len({file.name.endswith(ROS1_ENDINGS) for file in files}) > 1:
            raise InputError('ROS 1 bags (.bag) and ROS 2 bags cannot be read as one recording')
        with ExitStack() as stack:
            self._files = [stack.enter_context(BagFile(file)) for file in files]
            damage = self.damage
            if damage and not self.count:
                raise InputError(f'{self.name} cannot be read: it is no bag, or nothing of it is '
                                 f'left. {damage}')
            stack.pop_all()
        self._undecoded: set[tuple[str, int]] = set()  # topic, log time

    def _files_of(self, path: Path) -> list[Path]:
        """Return a path's files; refuse what is plainly no bag with a sentence that says so."""
        if not path.exists():
            raise InputError(f'{path}: no such file or folder')
        if path.is_dir():
            return self._files_in(path)
        if not path.name.endswith(ENDINGS):
            raise InputError(
                f'{path} is not a bag: {_KINDS} files and rosbag2 folders can be read')
        return [path]

    def _files_in(self, folder: Path) -> list[Path]:
        """Return the files of a rosbag2 folder; the metadata.yaml of a killed recorder lacks."""
        try:
            inside = sorted(
                (file for file in folder.iterdir() if file.name.endswith(ENDINGS)), key=_in_order)
        except OSError as error:
            raise InputError(f'{folder} cannot be read: {error.strerror or error}') from error
        try:
            metadata = yaml.safe_load((folder / 'metadata.yaml').read_bytes())
            names = [Path(name).name for name in
                     metadata['rosbag2_bagfile_information']['relative_file_paths']]
        except Exception as error:  # damaged text makes the parser raise anything
            if not inside:
                raise InputError(f'{folder} is no rosbag2 folder: it has no metadata.yaml and no '
                                 f'{_KINDS.replace("and", "or")} file') from error
            if len({_series(file) for file in inside}) > 1:
                raise InputError(
                    f'{folder} is no rosbag2 folder: it has no metadata.yaml that can be read, '
                    'and files of several recordings; name those of one: '
                    f'{" ".join(map(str, inside))}') from error
            self._notes.append(f'{folder} has no metadata.yaml that can be read, as where its '
                               'recorder was killed: its files are read without')
            return inside
        missing = [name for name in names if not (folder / name).exists()]
        if missing:
            self._notes.append(f'{folder} lacks {", ".join(missing)}')
        series = {_series(folder / name) for name in names}
        # a recorder that was killed does not list its last file
        files = [file for file in inside if file.name in names or _series(file) in series]
        if not files:
            raise InputError(f'{folder} holds none of its files: {", ".join(missing)}')
        return files

    @property
    def name(self) -> str:
        """Return the paths as one text."""
        return ' '.join(str(path) for path in self.paths)

    @property
    def topics(self) -> dict[str, Topic]:
        """Return the topics by name, sorted."""
        parts = [topic for file in self._files for topic in file.topics]
        topics = {}
        for name in sorted({part.name for part in parts}):
            of_it = [part for part in parts if part.name == name]
            filled = [part for part in of_it if part.count] or of_it[:1]
            topics[name] = Topic(
                name, tuple(sorted({kind for part in filled for kind in part.types})),
                sum(part.count for part in of_it))
        return topics

    @property
    def count(self) -> int:
        """Return the number of messages."""
        return sum(topic.count for file in self._files for topic in file.topics)

    @property
    def begin_ns(self) -> int:
        """Return the first message's log time."""
        return min((file.begin_ns for file in self._filled), default=0)

    @property
    def end_ns(self) -> int:
        """Return the last message's log time."""
        return max((file.end_ns for file in self._filled), default=0)

    @property
    def _filled(self) -> list[BagFile]:
        return [file for file in self._files if any(topic.count for topic in file.topics)]

    @property
    def damage(self) -> str:
        """Return what could not be read so far, and where, as a sentence; empty: nothing."""
        counts = Counter(topic for topic, _ in getattr(self, '_undecoded', ()))
        return '; '.join([
            *self._notes, *(part for file in self._files for part in file.damage),
            *(f'{count} messages on {topic} could not be decoded'
              for topic, count in sorted(counts.items()))])

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, Any, int]]:
        """
        Read messages in the order of their log times, one at a time.

        What turns out to be damaged is left out, and `damage` says so.

        :param topics: only messages of these are decoded
        :param start_ns: first log time
        :param stop_ns: messages from here on are left out
        :return: topic, message, log time in nanoseconds
        """
        def raw(file: BagFile) -> Iterator[tuple[BagFile, Raw]]:
            for item in file.messages(topics, start_ns, stop_ns):
                yield file, item

        for file, item in merge(*map(raw, self._files), key=lambda pair: pair[1].log_ns):
            try:
                message = file.decode(item)
            except Exception:  # damaged bytes make the library raise anything
                self._undecoded.add((item.topic, item.log_ns))
                continue
            yield item.topic, message, item.log_ns

    def first(self, topic: str) -> Any:
        """Return a topic's first message that can be decoded, or None."""
        for _, message, _ in self.messages([topic]):
            return message
        return None

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _series(file: Path) -> str:
    """Return what the names of all files of a recording have in common."""
    return re.sub(r'(_\d+)?(\.\w+)+$', '', file.name)


def _in_order(file: Path) -> tuple[int, str]:
    number = re.search(r'_(\d+)(\.\w+)+$', file.name)
    return int(number[1]) if number else 0, file.name
