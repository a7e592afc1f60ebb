# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is left of recordings that were cut off or damaged, whatever their kind."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import shutil
import sqlite3
import struct
import tracemalloc

import bags_for_tests as bags
from hypothesis import given, settings, strategies
import numpy as np
import pytest

from gr2t_ros.errors import InputError
from gr2t_ros.io.bag_files import BagFile, Raw
from gr2t_ros.io.bags import Bag
from gr2t_ros.io.salvage import expand, MAX_EXPANDED

Message = tuple[int, str, bytes]
FILES = ('rosbag1', 'rosbag1 bz2', 'rosbag1 lz4', 'sqlite3 bare', 'mcap bare')
FOLDERS = ('sqlite3', 'sqlite3 message zstd', 'mcap', 'mcap message zstd', 'mcap storage zstd')


def messages() -> list[bags.Message]:
    """Return some 100 kB, so that chunks and pages are more than one."""
    rng = np.random.default_rng(0)
    return [*bags.scan(30), *(
        bags.image(i, '/other/image', rng.integers(0, 4000, (60, 80), np.uint16))
        for i in range(30))]


def read(path: Path) -> tuple[list[Message], str]:
    """Return a recording's messages in their order, and what is damaged."""
    with Bag([path]) as bag:
        found = [(raw.log_ns, raw.topic, bytes(raw.data)) for file in bag._files
                 for raw in file.messages(bag.topics)]
        for _ in bag.messages(bag.topics):
            pass
        return found, bag.damage


@pytest.fixture(scope='module')
def recording(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return recordings of each kind, written once; they are copied before they are damaged."""
    folder = tmp_path_factory.mktemp('recordings')
    written: dict[str, Path] = {}

    def get(kind: str) -> Path:
        if kind not in written:
            written[kind] = bags.write(folder / kind.replace(' ', '_'), messages(), kind)
        return written[kind]
    return get


def damaged(path: Path, folder: Path, change: Callable[[bytearray], None]) -> Path:
    """Copy a recording and change its file, or the first of them."""
    copy = folder / path.name
    if path.is_dir():
        shutil.copytree(path, copy, dirs_exist_ok=True)
    else:
        shutil.copy(path, copy)
    file = next(item for item in copy.iterdir() if item.suffix != '.yaml') if (
        path.is_dir()) else copy
    content = bytearray(file.read_bytes())
    change(content)
    file.write_bytes(content)
    return copy


def cut(fraction: float) -> Callable[[bytearray], None]:
    """Return what keeps a part of a file."""
    def change(content: bytearray) -> None:
        del content[int(fraction * len(content)):]
    return change


# not bz2: its blocks are larger than this recording
@pytest.mark.parametrize('kind', [kind for kind in (*FILES, *FOLDERS) if 'bz2' not in kind])
def test_a_file_that_was_cut_off_gives_what_is_in_its_first_part(
    recording: Callable[[str], Path], tmp_path: Path, kind: str
) -> None:
    whole, damage = read(recording(kind))
    assert not damage
    before: set[Message] = set()
    for fraction in (0.5, 0.9, 0.99):
        found, damage = read(damaged(recording(kind), tmp_path, cut(fraction)))
        # compression and tables of contents make the parts uneven
        assert fraction - 0.25 < len(found) / len(whole) <= min(1, fraction + 0.2)
        assert before <= set(found) <= set(whole)
        assert [item[0] for item in found] == sorted(item[0] for item in found)
        assert 'is damaged (' in damage
        before = set(found)


@pytest.mark.parametrize('kind', [*FILES, *FOLDERS])
def test_any_damage_costs_what_is_damaged_and_no_more_than_a_sentence(
    recording: Callable[[str], Path], tmp_path: Path, kind: str
) -> None:
    whole, _ = read(recording(kind))

    @given(
        at=strategies.floats(0, 1), size=strategies.sampled_from([1, 8, 300, 5000]),
        seed=strategies.integers(0, 255))
    @settings(max_examples=12, deadline=None)
    def check(at: float, size: int, seed: int) -> None:
        def change(content: bytearray) -> None:
            begin = int(at * (len(content) - size))
            content[begin:begin + size] = np.random.default_rng(seed).bytes(size)

        path = damaged(recording(kind), tmp_path, change)
        try:
            found, _ = read(path)
        except InputError:  # nothing is left
            return
        assert len(set(found)) == len(found) <= len(whole)
    check()


def test_mcap_as_the_mcap_library_reads_it(
    recording: Callable[[str], Path], tmp_path: Path, data: Path
) -> None:
    """Cut off anywhere, a file gives at least what the library's NonSeekingReader finds."""
    reader = pytest.importorskip('mcap.reader')
    rng = np.random.default_rng(1)
    total = 0
    for original, places in ((recording('mcap bare'), 5), (
            data / 'bags' / 'nav2_turtlebot.mcap', 2)):
        content = original.read_bytes()
        for place in rng.integers(len(content) // 10, len(content), places):
            path = tmp_path / 'cut.mcap'
            path.write_bytes(content[:place])
            expected = []
            with path.open('rb') as file:
                try:
                    for _, channel, message in reader.NonSeekingReader(file).iter_messages(
                            log_time_order=False):
                        expected.append((message.log_time, channel.topic, bytes(message.data)))
                except Exception:  # at the cut
                    pass
            try:
                found, _ = read(path)
            except InputError:
                found = []
            assert set(found) >= set(expected)
            total += len(expected)
    assert total > 100


@pytest.mark.parametrize('name', [
    'embag_test.bag', 'jsk_watercan.bag', 'tf_example', 'nav2_turtlebot.mcap'])
def test_recordings_of_others_cut_off(data: Path, tmp_path: Path, name: str) -> None:
    whole, _ = read(data / 'bags' / name)
    path = damaged(data / 'bags' / name, tmp_path, cut(0.6))
    found, damage = read(path)
    assert 0 < len(found) < len(whole)
    assert set(found) <= set(whole)
    assert 'is damaged (' in damage


def test_pages_that_only_the_log_of_sqlite_holds(tmp_path: Path) -> None:
    """A recorder that was killed leaves the newest messages in a write-ahead log."""
    path = bags.write(tmp_path / 'scan', bags.scan(10), 'sqlite3 bare')
    whole, _ = read(path)
    live = tmp_path / 'live.db3'
    shutil.copy(path, live)
    database = sqlite3.connect(live)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    image = next(item for item in whole if item[1] == bags.DEPTH)
    later = image[0] + 10_000_000_000
    for count in range(20):
        database.execute(
            'INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, ?, ? FROM messages '
            'JOIN topics ON topic_id = topics.id WHERE name = ? LIMIT 1',
            (later + count, image[2] * 3, bags.DEPTH))
        database.commit()
    killed = tmp_path / 'killed.db3'
    shutil.copy(live, killed)
    shutil.copy(tmp_path / 'live.db3-wal', tmp_path / 'killed.db3-wal')
    database.close()
    found, damage = read(killed)
    assert found == [*whole, *(
        (later + count, bags.DEPTH, image[2] * 3) for count in range(20))]
    assert 'damaged' not in damage


def test_a_ros_1_recorder_that_was_killed(
    recording: Callable[[str], Path], tmp_path: Path
) -> None:
    path = damaged(recording('rosbag1'), tmp_path, cut(0.5)).rename(tmp_path / 'scan.bag.active')
    found, _ = read(path)
    assert found


def test_what_a_file_claims_costs_no_memory(
    recording: Callable[[str], Path], tmp_path: Path
) -> None:
    """Records and chunks that claim to be of gigabytes and more."""
    def claim(content: bytearray, chunk: int, size: int) -> None:
        if chunk == 6:  # MCAP: the record's length, the expanded and the compressed size
            at = content.index(b'\x06', 40)
            content[at + 1:at + 9] = struct.pack('<Q', size)
            content[at + 25:at + 33] = struct.pack('<Q', size)
        else:
            at = content.index(b'compression=')
            at = content.index(b'size=', at) + 9
            content[at:at + 4] = struct.pack('<I', size & 0xfffffff0)

    for kind, chunk, size in (('mcap bare', 6, 1 << 40), ('rosbag1', 5, 1 << 31)):
        path = damaged(
            recording(kind), tmp_path,
            lambda content, chunk=chunk, size=size: claim(content, chunk, size))
        with BagFile(path) as file:  # types are made, once
            assert file.topics
        tracemalloc.start()
        try:
            with BagFile(path) as file:
                names = [topic.name for topic in file.topics]
                assert sum(1 for _ in file.messages(names)) > 50
            assert tracemalloc.get_traced_memory()[1] < 20e6
        finally:
            tracemalloc.stop()


def test_what_expands_to_more_than_any_message_is_not_expanded() -> None:
    zstd = pytest.importorskip('backports.zstd')
    bomb = zstd.compress(bytes(MAX_EXPANDED + 1))
    assert len(bomb) < 100_000
    data, whole, _ = expand('zstd', bomb)
    assert (len(data), whole) == (MAX_EXPANDED, False)


def test_reading_goes_on_where_a_reader_failed(
    recording: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each message comes once, several of one log time too, though the first reader gave up."""
    file = BagFile(recording('mcap bare'))
    names = [topic.name for topic in file.topics]
    whole = list(file.messages(names))
    good = file._reader

    class Fails:
        """A reader that fails after some messages."""

        def __init__(self, after: int) -> None:
            self.after = after

        def messages(self, *args: object) -> object:
            for number, raw in enumerate(good.messages(*args)):
                if number == self.after:
                    raise ValueError('no more')
                yield raw

        def close(self) -> None:
            pass

    def key(raw: Raw) -> Message:
        return raw.log_ns, raw.topic, bytes(raw.data)

    for after in range(0, len(whole), 25):
        monkeypatch.setattr(file, '_reader', Fails(after))
        assert sorted(map(key, file.messages(names))) == sorted(map(key, whole))
        assert [raw.log_ns for raw in whole] == sorted(raw.log_ns for raw in whole)
