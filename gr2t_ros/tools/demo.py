# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
`make demo`: the main job from end to end, on a simulated camera.

A camera moves round a tabletop and is recorded; one process plays the recording over DDS, another
one is gr2t_node, which builds the map; this one asks it for a snapshot, measures and draws it.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time
from typing import Any, NoReturn, TypeVar

import numpy as np
import trimesh

from ..core.colour import Colouring
from ..core.view_mesh import ROBUST_MAXIMUM
from ..errors import Gr2tError, InputError
from ..io import formats
from ..ros.client import Client
from ..ros.isolation import isolated
from ..settings import Settings
from ..share import share_directory
from .distance import Surface
from .noise import Noise
from .progress import Progress
from .recorder import CAMERA_INFO_TOPIC, DEPTH_TOPIC, record
from .render import preview
from .scenes import tabletop, tabletop_poses
from .simulate import rendered_views, simulated_camera

VIEWS = 20
RATE = 3.0  # images a second
WIDTH, HEIGHT = 320, 240
NOISE = Noise('gaussian', sigma=0.001)
PRESET = 'tabletop_scan'
RAY_STRIDE = 2
_START_NS = 1_700_000_000_000_000_000

T = TypeVar('T')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demonstration; return the exit code."""
    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument(
        '-o', '--output', type=Path, default=Path('demo'), help='folder of the results (demo)')
    options = parser.parse_args(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):  # also where a shell has them ignored
        signal.signal(number, _interrupt)
    try:
        _Demo(options.output.resolve()).run()
    except KeyboardInterrupt:
        print('demo: interrupted', file=sys.stderr)
        return 130
    except (Gr2tError, OSError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    return 0


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


class _Demo:
    """
    One run.

    :param output: folder of the results
    """

    def __init__(self, output: Path) -> None:
        self._bag = output / 'tabletop'
        self._log = output / 'gr2t_node.log'
        self._mesh = output / 'mesh.ply'
        self._picture = output / 'preview.png'
        self._output = output
        self._environment = isolated(os.environ)
        self._poses = tabletop_poses(VIEWS)
        self._stamps = [_START_NS + round(i * 1e9 / RATE) for i in range(VIEWS)]
        self._seconds: dict[str, float] = {}

    def run(self) -> None:
        """Do all of it."""
        began = time.monotonic()
        self._output.mkdir(parents=True, exist_ok=True)
        scene = tabletop()
        with self._step('simulate', f'simulating {VIEWS} depth images of a tabletop'):
            self._simulate(scene)
        with self._step('start', 'starting gr2t_node (the first time it compiles its kernels)'):
            node = self._start_node()
        try:
            with self._step('play', 'playing the recording over DDS into gr2t_node'):
                self._play()
            self._save_snapshot(node)
        finally:
            _stop(node)
        with self._step('measure', 'measuring the mesh and drawing it'):
            mesh, distance = self._measure(scene)
        self._report(mesh, distance, time.monotonic() - began)

    @contextmanager
    def _step(self, name: str, what: str) -> Iterator[None]:
        print(f'[{len(self._seconds) + 1}/6] {what}', flush=True)
        began = time.monotonic()
        yield
        self._seconds[name] = time.monotonic() - began

    def _simulate(self, scene: trimesh.Trimesh) -> None:
        shutil.rmtree(self._bag, ignore_errors=True)
        camera = simulated_camera(WIDTH, HEIGHT)
        with Progress(VIEWS, 'images') as progress:
            def views() -> Iterator[Any]:
                for i, view in enumerate(rendered_views(
                        scene, camera, self._poses, noise=NOISE, stamps_ns=self._stamps)):
                    yield view
                    progress.reach(i + 1)

            record(self._bag, views())

    def _start_node(self) -> subprocess.Popen[bytes]:
        """Start the node and wait until it is ready."""
        preset = share_directory() / 'config' / f'{PRESET}.yaml'
        command = [
            sys.executable, '-m', 'gr2t_ros.ros.node', '--ros-args', '--params-file', str(preset),
            '-p', f'snapshot_directory:={self._output}', '-p', f'ray_stride:={RAY_STRIDE}',
            # no image is left out, however slow the machine
            '-p', f'queue_size:={VIEWS}', '-p', 'max_wait_for_pose:=60.0',
            '-r', f'depth/image:={DEPTH_TOPIC}', '-r', f'depth/camera_info:={CAMERA_INFO_TOPIC}']
        with open(self._log, 'wb') as log:
            node = subprocess.Popen(
                command, env=self._environment, stdout=log, stderr=subprocess.STDOUT)
        try:
            _wait(lambda: b'subscribed to' in self._log.read_bytes(), 'gr2t_node', node)
        except BaseException:
            _stop(node)
            raise
        return node

    def _play(self) -> None:
        with subprocess.Popen(
                [sys.executable, '-m', 'gr2t_ros.ros.bag_player', str(self._bag)],
                env=self._environment) as player:
            try:
                if player.wait():
                    raise Gr2tError(f'the player ended with exit code {player.returncode}')
            finally:
                player.terminate()

    def _save_snapshot(self, node: subprocess.Popen[bytes]) -> None:
        """Wait until the last image is in the map and let the node save it."""
        os.environ.update(self._environment)
        with Client() as client:
            def saved() -> Path | None:
                client.spin(0.1)
                return client.snapshot

            with (self._step('march', 'waiting for the last image\'s share of the map'),
                  Progress(VIEWS, 'images in the map') as progress):
                def complete() -> bool:
                    client.spin(0.1)
                    in_map = np.searchsorted(self._stamps, client.newest_ns, side='right')
                    progress.reach(int(in_map))
                    return bool(in_map == VIEWS)

                _wait(complete, 'the map', node)
            with self._step('snapshot', 'asking for a snapshot: rays that wait go first'):
                client.save_snapshot()
                _wait(saved, 'the snapshot', node).replace(self._mesh)

    def _measure(self, scene: trimesh.Trimesh) -> tuple[formats.Mesh, np.ndarray]:
        """Draw the mesh; return it and its vertices' distances to the true surface, metres."""
        mesh = formats.read(self._mesh)
        likelihood, sigma = mesh.attributes['likelihood'], mesh.attributes['sigma']
        settings = Settings()
        colouring = Colouring(
            settings.color_by, float(np.percentile(likelihood, ROBUST_MAXIMUM)),
            settings.colour_map)
        distance = Surface(scene.triangles).distances(mesh.vertices)
        preview(
            self._picture, mesh.vertices, mesh.faces, likelihood, sigma,
            colouring, title='gr2t_ros: a simulated tabletop, mapped live',
            poses=self._poses)
        return mesh, distance

    def _report(self, mesh: formats.Mesh, distance: np.ndarray, seconds: float) -> None:
        print(f'\nmesh      {self._mesh}\n'
              f'          {len(mesh.vertices)} vertices, {len(mesh.faces)} faces\n'
              f'picture   {self._picture}')
        millimetres = 1000 * distance
        print(f'distance to the true surface: mean {millimetres.mean():.2f} mm, '
              f'median {np.median(millimetres):.2f} mm, '
              f'95 % within {np.percentile(millimetres, 95):.2f} mm '
              f'(the camera\'s noise: {1000 * NOISE.sigma:.1f} mm)')
        print('frames: ' + self._log.read_text().partition('frames: ')[2].rstrip())
        parts = ', '.join(f'{name} {value:.1f}' for name, value in self._seconds.items())
        print(f'seconds: {parts}, all {seconds:.1f}')


def _wait(
    condition: Callable[[], T | None], what: str, process: subprocess.Popen[bytes],
    limit: float = 600.0,
) -> T:
    """
    Wait for a condition, which another process brings about; return its value.

    :raises Gr2tError: if that process ends, or after so many seconds
    """
    began = said = time.monotonic()
    while not (value := condition()):
        now = time.monotonic()
        if process.poll() is not None:
            raise Gr2tError(f'gr2t_node ended with exit code {process.returncode}: see '
                            'gr2t_node.log in the folder of the results')
        if now - began > limit:
            raise Gr2tError(f'waited {limit:g} s in vain for {what}')
        if now - said > 10.0:
            said = now
            print(f'      waiting for {what} since {now - began:.0f} s', flush=True)
        time.sleep(0.02)
    return value


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End a process and wait for it, gently if it lets us."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(timeout=30.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


if __name__ == '__main__':
    sys.exit(main())
