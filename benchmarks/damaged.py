# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Recordings that are cut off or damaged: how many of their messages are read.

    python benchmarks/damaged.py [--data ../shared/data] [--times 5] [--seed 0]

Each recording is damaged at random places: cut off there; 500 bytes overwritten with zeros or with
noise; single bits flipped. Printed are the messages read, as a share of all, by rosbags alone (up
to where it fails) and by this package, the runs in which nothing was left, and those that failed
with anything but a sentence. Exit code 1: there were some.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
import random
import sys
import tempfile
from typing import Any

from common import machine, table
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from gr2t_ros.errors import InputError
from gr2t_ros.io.bags import Bag

_FILES = (
    'bags/kitchen_sweep/kitchen_sweep.mcap', 'bags/nav2_turtlebot.mcap',
    'bags/tf_example/tf_example.db3', 'bags/jsk_watercan.bag', 'bags/embag_test.bag')
_AS_SQLITE3 = _FILES[0]  # is read from sqlite3 too
_BYTES, _BITS = 500, 20
_TYPES = get_typestore(Stores.ROS2_HUMBLE)


def cut_off(content: bytearray, rng: random.Random) -> None:
    """Keep the first part, of 5 % at least."""
    del content[rng.randrange(len(content) // 20, len(content)):]


def zeros(content: bytearray, rng: random.Random) -> None:
    """Overwrite as a disk does that lost a block."""
    at = rng.randrange(len(content) - _BYTES)
    content[at:at + _BYTES] = bytes(_BYTES)


def noise(content: bytearray, rng: random.Random) -> None:
    """Overwrite as memory does that is not ours."""
    at = rng.randrange(len(content) - _BYTES)
    content[at:at + _BYTES] = rng.randbytes(_BYTES)


def flipped(content: bytearray, rng: random.Random) -> None:
    """Change bits here and there."""
    for _ in range(_BITS):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)


DAMAGES: dict[str, Callable[[bytearray, random.Random], None]] = {
    'cut off': cut_off, f'{_BYTES} zeros': zeros, f'{_BYTES} bytes of noise': noise,
    f'{_BITS} bits flipped': flipped}


def read_by_rosbags(path: Path) -> int:
    """Return how many messages come before it fails."""
    count = 0
    try:
        with AnyReader([path], default_typestore=_TYPES) as reader:
            for _ in reader.messages():
                count += 1
    except Exception:  # it raises anything
        pass
    return count


def read(path: Path) -> int:
    """Return how many messages can be decoded; -1: nothing is left; -2: it failed."""
    try:
        with Bag([path]) as bag:
            return sum(1 for _ in bag.messages(bag.topics))
    except InputError:
        return -1
    except Exception as error:
        print(f'{path.name}: {type(error).__name__}: {error}')
        return -2


def as_sqlite3(path: Path, folder: Path) -> Path:
    """Return a recording's copy of the other kind."""
    with AnyReader([path]) as reader, Writer(
            folder / 'copy', version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            item.id: writer.add_connection(item.topic, item.msgtype, typestore=reader.typestore)
            for item in reader.connections}
        for connection, log_ns, data in reader.messages():
            writer.write(connections[connection.id], log_ns, data)
    return (folder / 'copy' / 'copy.db3').rename(folder / f'{path.stem}.db3')


def measure(path: Path, times: int, rng: random.Random, folder: Path) -> list[dict[str, Any]]:
    """Return rows of the table for one recording."""
    content = path.read_bytes()
    whole = read(path)
    rows = []
    for name, damage in DAMAGES.items():
        theirs, ours = [], []
        for _ in range(times):
            changed = bytearray(content)
            damage(changed, rng)
            file = folder / f'damaged{path.suffix}'
            file.write_bytes(changed)
            theirs.append(read_by_rosbags(file))
            ours.append(read(file))
        rows.append({
            'recording': path.name, 'damage': name, 'times': times,
            'rosbags, %': 100 * sum(theirs) / times / whole,
            'gr2t, %': 100 * sum(max(count, 0) for count in ours) / times / whole,
            'nothing left': ours.count(-1), 'failed': ours.count(-2)})
    return rows


def main() -> int:
    """Damage what there is."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--data', type=Path, default=Path('../shared/data'))
    parser.add_argument('--times', type=int, default=5, help='each damage, of each recording')
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    about = machine()
    print(f'{about["processor"]}, load average {about["load"]:.1f}', flush=True)
    rng = random.Random(arguments.seed)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix='gr2t_damaged_') as name:
        folder = Path(name)
        paths = [arguments.data / file for file in _FILES if (arguments.data / file).exists()]
        if (arguments.data / _AS_SQLITE3).exists():
            paths.append(as_sqlite3(arguments.data / _AS_SQLITE3, folder))
        for path in paths:
            rows += measure(path, arguments.times, rng, folder)
            print(f'{path.name} is done', flush=True)
    table('Messages read of damaged recordings', rows)
    return int(any(row['failed'] for row in rows))


if __name__ == '__main__':
    sys.exit(main())
