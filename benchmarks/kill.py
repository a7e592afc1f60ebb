# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
kill -9 while snapshots and maps are written: what is left in the folder.

    python benchmarks/kill.py [--kills 150] [--nodes 10] [--seed N]

A process writes snapshots and maps as fast as it can, one map under the same name again and again,
and is killed at a random moment; then the next. Likewise whole nodes that are fed over DDS and
write by themselves (--nodes 0 leaves them out). After each kill every file that has a name is
read, checksums included. Writes benchmarks/results/kill.json; exit code 1 where a file is damaged,
one whose writing had ended is gone, or unfinished ones stay for good.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
import json
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
from pathlib import Path
import random
import subprocess
import sys
import tempfile
import time
from typing import Any

from common import machine, table
import numpy as np
from synthetic_camera import camera_pose, intrinsics, render, SyntheticCamera

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.frozen import ASKING, room_for
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.state import ADDING
from gr2t_ros.core.view import View
from gr2t_ros.errors import Gr2tError
from gr2t_ros.io import formats
from gr2t_ros.io.files import Folder
from gr2t_ros.io.map_file import ENDING, MapFile, save_map
from gr2t_ros.io.snapshots import save_snapshot
from gr2t_ros.settings import Settings

_FORK = get_context('fork')
_SIZE = (160, 120)  # pixels
_VIEWS, _PERIOD = 8, 2.0
_SETTINGS = Settings(
    voxel_size=0.04, depth_bandwidth=0.02, keyframe_translation=0.0, threads=1)
_KEPT = f'kept{ENDING}'  # the map that is written again and again
_LIFE = 1.0  # s; a writer or, after its first files, a node lives no longer
_PATIENCE = 120.0  # s: for what takes a few on a machine that does nothing else


class Folders:
    """
    What the killed left, and what of it was wrong.

    counts: of kills, of those in the middle of a file, of files read, damaged, lost, left over.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: Counter[str] = Counter(dict.fromkeys(
            ('kills', 'while writing', 'files read', 'damaged', 'lost', 'left over'), 0))

    def check(self, finished: set[Path]) -> None:
        """Read all files after a kill; remove those that are not written again."""
        hidden = [path for path in self.path.iterdir() if path.name.startswith('.')]
        self.counts['kills'] += 1
        self.counts['while writing'] += bool(hidden)
        self.counts['lost'] += sum(not path.exists() for path in finished)
        for path in sorted(self.path.iterdir()):
            if path in hidden:
                continue
            self.counts['files read'] += 1
            try:
                self._read(path)
            except Gr2tError as error:
                self.counts['damaged'] += 1
                print(error)
            if path.name != _KEPT:
                path.unlink()

    def tidy(self) -> None:
        """Do what the next writer would, and count what is left of the killed ones."""
        with Folder(str(self.path)).new_file('last', '.ply'):
            pass
        with suppress(OSError):
            (self.path / _KEPT).unlink()
        self.counts['left over'] += sum(1 for _ in self.path.iterdir())

    @staticmethod
    def _read(path: Path) -> None:
        if path.suffix == ENDING:
            with MapFile(path) as file, closing(Reconstruction(file.settings)) as reconstruction:
                file.load(reconstruction)
        else:
            formats.read(path)


def kill_writers(folders: Folders, kills: int, frames: Path) -> None:
    """Kill processes that do nothing but write one map."""
    reconstruction = Reconstruction(_SETTINGS)
    images = np.load(frames)
    f, cx, cy = intrinsics(*_SIZE)
    camera = Camera(*_SIZE, f, f, cx, cy)
    for n in range(_VIEWS):
        number = n * len(images) // _VIEWS
        reconstruction.add(View(
            (images[number] / 1000).astype(np.float32), camera,
            camera_pose(number * _PERIOD / len(images)), n + 1))
    reconstruction.finish()
    # copies work without the threads, which a forked process does not have
    copies = [
        reconstruction.frozen(room_for(reconstruction.density, fields), fields)
        for fields in (ASKING, ADDING)]
    with tempfile.TemporaryDirectory() as elsewhere:
        save_snapshot(copies[0], Folder(elsewhere))  # its kernels are compiled by now
    for _ in range(kills):
        ours, theirs = _FORK.Pipe(duplex=False)
        process = _FORK.Process(target=_write, args=(folders.path, *copies, theirs))
        process.start()
        theirs.close()
        time.sleep(random.uniform(0, _LIFE))
        process.kill()
        process.join()
        finished = set()
        with suppress(EOFError):
            while ours.poll():
                finished.add(folders.path / ours.recv())
        folders.check(finished)
    reconstruction.close()


def _write(
    folder: Path, mesh: Reconstruction, map_: Reconstruction, finished: Connection
) -> None:
    while True:
        snapshot = save_snapshot(mesh, Folder(str(folder)))
        finished.send(snapshot.file.path.name)
        save_map(folder / _KEPT, map_, 'map')
        finished.send(_KEPT)
        with Folder(str(folder)).new_file('map', ENDING) as path:
            save_map(path, map_, 'map')
        finished.send(path.name)


def kill_nodes(folders: Folders, kills: int, frames: Path) -> None:
    """Kill nodes that save snapshots and maps all the time."""
    from gr2t_ros.ros.isolation import isolated
    environment = isolated(os.environ)
    parameters = {
        'voxel_size': 0.04, 'depth_bandwidth': 0.02, 'snapshot_period': 0.01,
        'map_period': 0.01, 'snapshot_directory': folders.path}
    command = [
        sys.executable, '-m', 'gr2t_ros.ros.node', '--ros-args',
        *(item for name, value in parameters.items() for item in ('-p', f'{name}:={value}'))]
    camera = SyntheticCamera(frames, '--rate', '15', '--speed', '0.5', environment=environment)
    try:
        for _ in range(kills):
            log = folders.path.parent / 'node.log'
            with log.open('wb') as output, subprocess.Popen(
                    command, env=environment, stdout=output, stderr=output) as node:
                _wait(lambda node=node: node.poll() is not None or all(
                    any(folders.path.glob(f'[!.]*{ending}')) for ending in ('.ply', ENDING)),
                    f'the first files: {log}')
                time.sleep(random.uniform(0, 3 * _LIFE))
                node.kill()
            finished = {
                Path(line.split('periodic ')[1].split(': ')[1])
                for line in log.read_text(encoding='utf-8').splitlines()
                if 'periodic snapshot: /' in line or 'periodic map: /' in line}
            folders.check(finished)
    finally:
        camera.end()


def _wait(condition: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + _PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f'waited in vain for {what}')
        time.sleep(0.02)


def main() -> int:
    """Kill, and tell; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n', maxsplit=1)[0])
    parser.add_argument('--kills', type=int, default=150)
    parser.add_argument('--nodes', type=int, default=10)
    parser.add_argument('--seed', type=int)
    args = parser.parse_args()
    seed = random.randrange(2 ** 32) if args.seed is None else args.seed
    random.seed(seed)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        frames = folder / 'frames.npy'
        render(frames, *_SIZE)
        for name, kills, run in (
                ('writers', args.kills, kill_writers), ('nodes', args.nodes, kill_nodes)):
            if kills:
                folders = Folders(folder / name)
                folders.path.mkdir()
                run(folders, kills, frames)
                folders.tidy()
                rows.append({'killed': name, **folders.counts})
    table(f'kill -9 at random moments, seed {seed}', rows)
    results = Path(__file__).parent / 'results'
    results.mkdir(exist_ok=True)
    (results / 'kill.json').write_text(json.dumps(
        {'machine': machine(), 'seed': seed, 'rows': rows}, indent=2) + '\n', encoding='utf-8')
    return int(any(row[wrong] for row in rows for wrong in ('damaged', 'lost', 'left over')))


if __name__ == '__main__':
    sys.exit(main())
