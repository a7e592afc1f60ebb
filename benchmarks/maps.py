# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Maps that are saved, loaded, gone on with and merged, against runs without any of it.

    python benchmarks/maps.py [--data DIR] [--frames 60]

On the first frames of kitchen_30hz, all of them keyframes. Writes benchmarks/results/maps.json;
exit code 1 where a map that was loaded in the middle did not become, bit for bit, what it would
have been.
"""
from __future__ import annotations

import argparse
from contextlib import closing
import json
from pathlib import Path
import sys
import tempfile
from time import perf_counter
from typing import Any

from common import frames, KITCHEN_30HZ, machine, say_absent, table
import numpy as np

from gr2t_ros.core.blocks import VOXELS
from gr2t_ros.core.merge import add_map
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.state import state_of
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.io.map_file import MapFile, save_map
from gr2t_ros.settings import Settings
from gr2t_ros.tools.report import peak_memory_mb

_VOXEL = Settings(
    voxel_size=0.01, ray_stride=2, keyframe_translation=0.0, remarch_budget=0.0, depth_max=3.5)
_EXACT = _VOXEL.updated({'density': 'exact', 'ray_stride': 4})


def built(views: list[View], settings: Settings) -> Reconstruction:
    """Return a map of some views; rays may wait."""
    reconstruction = Reconstruction(settings)
    for view in views:
        reconstruction.add(view)
    return reconstruction


def resumed(views: list[View], settings: Settings, folder: Path) -> dict[str, Any]:
    """Save in the middle, load, go on; count the bytes that differ in the end."""
    half = len(views) // 2
    path = folder / 'map.gr2t'
    with closing(built(views[:half], settings)) as first:
        before, begin = peak_memory_mb(), perf_counter()
        size = save_map(path, first, 'map').size
        saving, more = perf_counter() - begin, peak_memory_mb() - before
    with closing(Reconstruction(settings)) as second, closing(built(views, settings)) as whole:
        begin = perf_counter()
        with MapFile(path) as file:
            file.load(second)
        loading = perf_counter() - begin
        for view in views[half:]:
            second.add(view)
        second.finish()
        whole.finish()
        columns, others = state_of(second).columns, state_of(whole).columns
        differing = sum(
            int(np.count_nonzero(
                np.concatenate(columns[name]).view(np.uint8)
                != np.concatenate(others[name]).view(np.uint8)))
            for name in columns if columns[name])
        return {
            'density': settings.density, 'frames': f'{half} + {len(views) - half}',
            'MB': size / 1e6, 'save (s)': saving, 'load (s)': loading,
            'memory to save (MB)': more, 'bytes that differ at the end': differing}


def merged(views: list[View], settings: Settings) -> dict[str, Any]:
    """Merge two halves; compare with one run."""
    half = len(views) // 2
    with (closing(built(views, settings)) as whole, closing(built(views[:half], settings)) as both,
          closing(built(views[half:], settings)) as other):
        add_map(both, other)
        whole.finish()
        both.finish()
        row = {'density': settings.density, 'frames': f'{half} + {len(views) - half}'}
        relative = np.zeros(1)
        if isinstance(both.density, VoxelDensity):
            ours, theirs = samples(both), samples(whole)
            relative = np.abs(ours - theirs)[theirs > 0] / theirs[theirs > 0]
        moved, otherwise = [], 0
        for a, b in zip(both.keyframes, whole.keyframes):
            otherwise += int(np.count_nonzero(a.rays.status != b.rays.status))
            moved.append(np.abs(a.rays.depth - b.rays.depth)[a.rays.converged & b.rays.converged])
        away = np.concatenate(moved).astype(np.float64)
        return {
            **row, 'samples: largest difference': f'{relative.max():.1e}',
            'rays': sum(len(item.rays.pixels) for item in both.keyframes),
            'that end otherwise': otherwise, 'that differ': int(np.count_nonzero(away)),
            '999 of 1000 within (m)': f'{np.quantile(away, 0.999):.1e}',
            'all within (m)': f'{away.max():.1e}'}


def samples(reconstruction: Reconstruction) -> np.ndarray:
    """Return the lattice's samples in the order of the blocks' places."""
    density = reconstruction.density
    assert isinstance(density, VoxelDensity)
    size = density.blocks.size
    order = np.argsort(density.blocks.key[1:size])
    return density.blocks.value[VOXELS:VOXELS * size].reshape(-1, VOXELS)[order].ravel()


def main() -> int:
    """Measure; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n', maxsplit=1)[0])
    parser.add_argument(
        '--data', type=Path, default=Path(__file__).resolve().parents[2] / 'shared' / 'data')
    parser.add_argument('--frames', type=int, default=60)
    args = parser.parse_args()
    say_absent(args.data)
    warm_up(_VOXEL)
    rows: dict[str, list[dict[str, Any]]] = {'resumed': [], 'merged': []}
    with tempfile.TemporaryDirectory() as folder:
        for settings, count in ((_VOXEL, args.frames), (_EXACT, args.frames // 6)):
            views = frames(args.data, KITCHEN_30HZ, count, settings)
            if views:
                rows['resumed'].append(resumed(views, settings, Path(folder)))
                rows['merged'].append(merged(views, settings))
    table('saved in the middle, loaded, gone on with', rows['resumed'])
    table('two halves merged, beside one run', rows['merged'])
    results = Path(__file__).parent / 'results'
    results.mkdir(exist_ok=True)
    (results / 'maps.json').write_text(
        json.dumps({'machine': machine(), **rows}, indent=2) + '\n', encoding='utf-8')
    return int(any(row['bytes that differ at the end'] for row in rows['resumed']))


if __name__ == '__main__':
    sys.exit(main())
