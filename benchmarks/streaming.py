# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the streaming engine costs and how exact it is.

    python benchmarks/streaming.py [--data DIR] [--only PART] [--quick]

Parts: stages (a frame's, beside Open3D's TSDF where it is installed), pieces (a voxel, a block, a
ray), threads (two against one), replay (whole recordings: speed and memory), accuracy (against the
exact sum). Each runs in a process of its own, confined to as many cores as it may use, and writes
benchmarks/results/PART.json. Other work on the machine disturbs times, less so ratios.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
import hashlib
import json
import os
from pathlib import Path
from time import perf_counter
from typing import Any

from accuracy import measure_accuracy
from common import cores, in_fresh_process, KITCHEN_30HZ, KITCHEN_SWEEP, machine, say_absent
from replay import measure_blocks, measure_replay
from stages import measure_pieces, measure_stages, measure_threads
import tsdf

_PROJECT = Path(__file__).resolve().parents[1]
_FRAMES, _QUICK_FRAMES = 20, 4


def stages(data: Path, quick: bool) -> object:
    """Measure a frame's stages on one core and on two."""
    if not tsdf.installed():
        print('Open3D is not installed: no comparison')
    count = _QUICK_FRAMES if quick else _FRAMES
    return [
        row for threads in (1, 2) if threads <= cores()
        for row in in_fresh_process(threads, measure_stages, data, threads, count)]


def pieces(data: Path, quick: bool) -> object:
    """Measure what a voxel, a block and a ray cost."""
    return in_fresh_process(1, measure_pieces, data)


def threads(data: Path, quick: bool) -> object:
    """Measure two threads against one."""
    if cores() < 2:
        print('threads: skipped, there is one core')
        return []
    return in_fresh_process(2, measure_threads, data, _QUICK_FRAMES if quick else _FRAMES)


def replay(data: Path, quick: bool) -> object:
    """Measure whole recordings."""
    count = 3 * _QUICK_FRAMES if quick else None
    return {
        'replays': [
            in_fresh_process(cores(), measure_replay, data, name, every, count)
            for name, every in (
                (KITCHEN_30HZ, False), (KITCHEN_SWEEP, False), (KITCHEN_SWEEP, True))],
        'blocks': in_fresh_process(cores(), measure_blocks, data)}


def accuracy(data: Path, quick: bool) -> object:
    """Measure the lattice's error."""
    return in_fresh_process(cores(), measure_accuracy, data, _QUICK_FRAMES if quick else 12)


PARTS: dict[str, Callable[[Path, bool], Any]] = {
    part.__name__: part for part in (stages, pieces, threads, replay, accuracy)}


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        '--data', type=Path, default=_PROJECT.parent / 'shared' / 'data', metavar='DIR',
        help='holds bags/kitchen_30hz, bags/kitchen_sweep and meshes/; what is absent is skipped')
    parser.add_argument('--only', choices=PARTS, help='one part')
    parser.add_argument('--quick', action='store_true', help='few frames, to try it out')
    arguments = parser.parse_args()
    # numba does not notice when a kernel that another one calls has changed
    sources = b''.join(
        path.read_bytes() for path in sorted((_PROJECT / 'gr2t_ros').rglob('*.py'))
        if b'njit' in path.read_bytes())
    os.environ.setdefault('NUMBA_CACHE_DIR', str(
        _PROJECT / '.cache' / 'numba' / hashlib.sha256(sources).hexdigest()[:12]))
    results = _PROJECT / 'benchmarks' / 'results'
    results.mkdir(exist_ok=True)
    say_absent(arguments.data)
    for name, part in PARTS.items():
        if arguments.only not in (None, name):
            continue
        about = machine()
        print(f'\n== {name}: {about["processor"]}, {about["cores"]} cores, Python '
              f'{about["python"]}, load average {about["load"]:.1f}', flush=True)
        began = perf_counter()
        figures = part(arguments.data, arguments.quick)
        about['seconds'] = perf_counter() - began
        with open(results / f'{name}.json', 'w', encoding='utf-8') as file:
            json.dump({'machine': about, 'figures': figures}, file, indent=1)
        print(f'({about["seconds"]:.0f} s, load average {os.getloadavg()[0]:.1f})')


if __name__ == '__main__':
    main()
