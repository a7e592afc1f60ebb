# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t replay --live`: the map as it grows, in a picture that a page shows again and again."""
from __future__ import annotations

from math import ceil, sqrt
from pathlib import Path
from time import perf_counter

import numpy as np

from ..core.reconstruction import Reconstruction
from ..io.files import whole_file
from .progress import say
from .render import FOCAL, preview
from .viewpoint import good_view, Pose

_PAGE = Path(__file__).with_name('viewer') / 'live.html'
_PERIOD = 2.0  # s between two pictures, at least
_SHARE = 0.1  # of the time that they may take
_RAYS = 60_000  # of all keyframes, about, that a picture shows
_WIDTH, _HEIGHT = 800, 500  # px; a quarter of the time of the picture at the end
_GROWN = 1.2  # times as wide: the picture is taken from a new place


class Live:
    """
    Draws preview.png of a folder now and then, beside a page that shows it.

    :param reconstruction: what is drawn
    """

    def __init__(self, directory: Path, reconstruction: Reconstruction) -> None:
        self._picture = directory / 'preview.png'
        self._reconstruction = reconstruction
        self._begin = perf_counter()
        self._next = self._begin
        self._size = 0.0
        self._T_world_camera: Pose | None = None
        with whole_file(directory / 'live.html') as stream:
            stream.write(_PAGE.read_bytes())
        say(f'the map as it grows: open {directory / "live.html"} in a browser')

    def reach(self, done: int, total: int) -> None:
        """
        Draw, if it is time.

        :param done: frames so far
        :param total: about how many there will be
        :raises Gr2tError: if the picture cannot be written
        """
        began = perf_counter()
        if began < self._next or not self._reconstruction.keyframes:
            return
        rate = done / (began - self._begin)
        self._draw(f'{done} of {max(done, total)} frames, {rate:.1f} frames/s')
        now = perf_counter()
        self._next = max(began + _PERIOD, now + (1 / _SHARE - 1) * (now - began))

    def _draw(self, title: str) -> None:
        keyframes = self._reconstruction.keyframes
        rays = sum(len(keyframe.rays.pixels) for keyframe in keyframes)
        stride = max(1, ceil(sqrt(rays / _RAYS)))
        meshes = [mesh for _, mesh in self._reconstruction.meshes(stride)]
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        faces = np.concatenate([mesh.faces + n for mesh, n in zip(meshes, first)])
        size = float(np.ptp(vertices, axis=0).max(initial=0.0)) if len(vertices) else 0.0
        if self._T_world_camera is None or size > _GROWN * self._size:
            self._size = size
            poses = [keyframe.view.T_world_camera for keyframe in keyframes]
            self._T_world_camera = good_view(vertices, faces, poses, FOCAL, _HEIGHT / _WIDTH)
        preview(
            self._picture, vertices, faces,
            np.concatenate([mesh.vertex_likelihood for mesh in meshes]),
            np.concatenate([mesh.vertex_sigma for mesh in meshes]),
            self._reconstruction.colouring(), title=title, width=_WIDTH, height=_HEIGHT,
            T_world_camera=self._T_world_camera)
