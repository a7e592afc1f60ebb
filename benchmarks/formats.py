# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A mesh in each format and as a page: size, time to write, to read, until a browser shows it.

    python benchmarks/formats.py out/mesh.ply

Open3D reads the same files where it is installed, a Chromium without a graphics card the page.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
import shutil
import sys
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from common import machine, table

from gr2t_ros.io import formats
from gr2t_ros.tools import view

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))


def main() -> None:
    """Measure one mesh."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('mesh', type=Path)
    path = parser.parse_args().mesh
    mesh = formats.read(path)
    print(machine())
    print(f'{path}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces')
    with TemporaryDirectory() as folder:
        rows = [_format(mesh, Path(folder) / f'mesh{ending}') for ending in formats.WRITTEN]
        table('formats', rows)
        page = Path(folder) / 'mesh.html'
        wrote = _seconds(lambda: view.write(page, mesh, [], path.name))
        table('page', [{
            'MB': page.stat().st_size / 1e6,
            'share of the PLY': page.stat().st_size / 1e6 / rows[0]['MB'],
            'write s': wrote, 'shown s': _shown(page)}])


def _format(mesh: formats.Mesh, path: Path) -> dict[str, Any]:
    wrote = _seconds(lambda: formats.write(path, mesh))
    row = {
        'format': path.suffix, 'MB': path.stat().st_size / 1e6, 'write s': wrote,
        'read s': _seconds(lambda: formats.read(path)), 'Open3D reads s': None}
    if find_spec('open3d'):
        import open3d
        row['Open3D reads s'] = _seconds(lambda: open3d.io.read_triangle_mesh(str(path)))
    return row


def _seconds(task: Callable[[], Any]) -> float:
    """Return the time of the faster of two runs."""
    times = []
    for _ in range(2):
        began = perf_counter()
        task()
        times.append(perf_counter() - began)
    return min(times)


def _shown(page: Path) -> float | None:
    """Return the seconds until a browser that runs already shows a page."""
    if not shutil.which('chromium'):
        return None
    from browser_for_tests import browser
    with browser() as chromium:
        return min(chromium.open(page) for _ in range(2))


if __name__ == '__main__':
    main()
