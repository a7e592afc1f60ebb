# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The engine: views in, likelihood-coloured meshes out, one view after the other.

A view adds its kernels to the density, which changes only the rays that pass through what it saw;
those climb again to their maximum, and the meshes of their keyframes follow.
"""
from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
import os
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..settings import Settings
from .camera import Camera
from .exact_density import ExactDensity
from .ray_march import affected, march, Rays, rays_of
from .view import View
from .view_mesh import ROBUST_MAXIMUM, view_mesh, ViewMesh

_SLICE = 16384  # rays marched between two looks at the clock


@dataclass(eq=False)
class Keyframe:
    """
    A view that keeps its rays, and so owns a mesh.

    :param waiting: (n,) bool, rays whose density changed since they were marched
    """

    view: View
    rays: Rays
    waiting: NDArray[np.bool_]


@dataclass(frozen=True)
class Update:
    """
    What a step did.

    :param keyframe: the number of the keyframe that the view became, or None
    :param marched: rays marched for the first time
    :param remarched: rays marched again
    :param converged: of these, rays that found their maximum
    :param waiting: rays left for a later step
    :param changed: keyframes whose rays were marched
    :param seconds: wall time of `integrate` and `march`
    :param refused_keyframe: whether max_keyframes kept the view from becoming one
    """

    keyframe: int | None = None
    marched: int = 0
    remarched: int = 0
    converged: int = 0
    waiting: int = 0
    changed: tuple[int, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    refused_keyframe: bool = False


class Reconstruction:
    """
    Meshes from depth images with known poses.

    :param settings: bandwidths, thresholds, keyframe distances, threads

    `keyframes` are the views that own a mesh, `density` is what all views built.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.keyframes: list[Keyframe] = []
        self.density = ExactDensity(
            settings.pixel_bandwidth, settings.depth_bandwidth,
            settings.depth_bandwidth_quadratic)
        self._pool = ThreadPoolExecutor(
            settings.threads or os.cpu_count() or 1, thread_name_prefix='gr2t')

    def add(self, view: View) -> Update:
        """
        Add a view's kernels to the density and march what they change.

        A new keyframe's rays are marched at once, older rays within `remarch_budget`; what is left
        waits for the next view or for finish.

        :raises FrameError: if the depth image is not of its camera's size
        """
        if view.depth.shape != (view.camera.height, view.camera.width):
            raise FrameError(
                'image_size', f'depth image of shape {view.depth.shape} does not fit its camera '
                f'of {view.camera.width} x {view.camera.height} pixels')
        began = perf_counter()
        index = self.density.add(view)
        for keyframe in self.keyframes:
            keyframe.waiting |= affected(self.density, keyframe.rays, index, self._pool)
        wanted = self._is_keyframe(view)
        full = len(self.keyframes) >= self.settings.max_keyframes
        number = None
        if wanted and not full:
            number = len(self.keyframes)
            rays = rays_of(
                self.density, index, view, self.settings.ray_stride, self.settings.start,
                self._pool)
            self.keyframes.append(Keyframe(view, rays, np.ones(len(rays.pixels), np.bool_)))
        integrated = perf_counter()
        update = self._march_waiting(number, integrated + self.settings.remarch_budget)
        return replace(
            update, keyframe=number, refused_keyframe=wanted and full,
            seconds={'integrate': integrated - began, 'march': perf_counter() - integrated})

    def finish(self, budget: float = float('inf')) -> Update:
        """
        March all rays that wait, as before a snapshot or at the end of a recording.

        :param budget: seconds after which what still waits is left
        """
        return self._march_waiting(None, perf_counter() + budget)

    def mesh(self, keyframe: int, stride: int = 1) -> ViewMesh:
        """
        Return a keyframe's mesh, cut by the thresholds.

        :param stride: use every stride-th ray of every stride-th row
        """
        chosen = self.keyframes[keyframe]
        return view_mesh(
            self.density, chosen.rays, chosen.view.camera.width,
            self.settings.ray_stride * stride, self.settings.min_likelihood,
            self.settings.min_edge_likelihood, self._pool)

    def meshes(self, stride: int = 1) -> Iterator[tuple[int, ViewMesh]]:
        """Yield (number, mesh) of all keyframes, in order."""
        for number in range(len(self.keyframes)):
            yield number, self.mesh(number, stride)

    def colour_scale(self) -> float:
        """Return the robust maximum of the likelihood over all keyframes, 1 / (px^2 m)."""
        totals = [
            keyframe.rays.total[keyframe.rays.converged] for keyframe in self.keyframes]
        likely = np.concatenate(totals) if totals else np.zeros(0)
        if not len(likely):
            return 0.0
        return float(np.percentile(likely, ROBUST_MAXIMUM)) / self.density.views.size

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _is_keyframe(self, view: View) -> bool:
        """Tell whether the camera has moved or turned enough since the last keyframe."""
        if not self.keyframes:
            return True
        last, new = self.keyframes[-1].view.T_world_camera, view.T_world_camera
        moved = float(np.linalg.norm(new[:3, 3] - last[:3, 3]))
        cosine = (np.trace(last[:3, :3].T @ new[:3, :3]) - 1) / 2
        turned = float(np.arccos(np.clip(cosine, -1, 1)))
        return (
            moved >= self.settings.keyframe_translation
            or turned >= self.settings.keyframe_rotation)

    def _march_waiting(self, new: int | None, deadline: float) -> Update:
        """March the new keyframe's rays, then what waits on older ones, newest first."""
        marched = remarched = converged = waiting = 0
        changed: list[int] = []
        for number in reversed(range(len(self.keyframes))):
            keyframe = self.keyframes[number]
            pending = np.flatnonzero(keyframe.waiting)
            for part in range(0, len(pending), _SLICE):
                if number != new and perf_counter() >= deadline:
                    break
                which = np.zeros_like(keyframe.waiting)
                which[pending[part:part + _SLICE]] = True
                first = int(np.count_nonzero(keyframe.rays.iterations[which] == 0))
                marched += first
                remarched += march(self.density, keyframe.rays, which, self._pool) - first
                converged += int(np.count_nonzero(keyframe.rays.converged[which]))
                keyframe.waiting[which] = False
                if changed[-1:] != [number]:
                    changed.append(number)
            waiting += int(np.count_nonzero(keyframe.waiting))
        return Update(
            marched=marched, remarched=remarched, converged=converged, waiting=waiting,
            changed=tuple(changed))


def warm_up(settings: Settings) -> float:
    """
    Compile the kernels, or load them from the cache, so that the first frame need not wait.

    :return: seconds it took
    """
    began = perf_counter()
    camera = Camera(24, 16, 20.0, 20.0, 12.0, 8.0)
    depth = np.full((16, 24), 1.0, np.float32)
    tiny = Reconstruction(settings.updated({'keyframe_translation': 0.0, 'ray_stride': 1}))
    for stamp in range(2):
        tiny.add(View(depth, camera, np.eye(4), stamp))
    tiny.finish()
    for _ in tiny.meshes():
        pass
    tiny.close()
    return perf_counter() - began
