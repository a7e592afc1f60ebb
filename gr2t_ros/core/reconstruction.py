# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The engine: views in, likelihood-coloured meshes out, one view after the other.

A view adds its kernels to the density, which changes only the rays that pass through what it saw;
those climb again to their maximum, and the meshes of their keyframes follow.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
import os
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..settings import Settings
from .colour import Colouring
from .colour_scale import robust_maximum
from .frozen import ASKING, frozen, Room
from .fused_mesh import FusedMap, MIN_COMPONENT, Region, SurfaceMesh
from .new_density import aliasing, new_density
from .poses import step
from .ray_march import Density, march, Rays, rays_of, stale, watched_blocks
from .release import MemoryBound, Sink
from .view import View
from .view_mesh import view_mesh, ViewMesh
from .voxel_density import VoxelDensity

_SLICE = 65536  # rays marched between two looks at the clock


@dataclass(eq=False)
class Keyframe:
    """
    A view that keeps its rays, and so owns a mesh.

    :param blocks: the lattice's blocks that its rays need; None with the exact density
    :param checked: the density's change up to which all its rays are right
    :param shared: whether a frozen map has the same rays
    :param released: whether its mesh was handed out for good, and only its pose is left
    """

    view: View
    rays: Rays
    blocks: NDArray[np.int32] | None
    checked: int = -1
    shared: bool = False
    released: bool = False

    def own_rays(self) -> Rays:
        """Return the rays for a change, which is not seen where they are shared."""
        if self.shared:
            self.rays, self.shared = self.rays.copy(), False
        return self.rays


@dataclass(frozen=True)
class Update:
    """
    What a step did.

    :param keyframe: the number of the keyframe that the view became, or None
    :param marched: rays marched for the first time
    :param remarched: rays marched again
    :param converged: of these, rays that found their maximum
    :param waiting: rays of keyframes that are still to be looked at; not all need marching
    :param changed: keyframes whose rays were marched
    :param released: keyframes whose meshes were handed out for good, to keep within max_memory_mb
    :param seconds: wall time of `integrate` and `march`
    :param notices: sentences that a user should read
    """

    keyframe: int | None = None
    marched: int = 0
    remarched: int = 0
    converged: int = 0
    waiting: int = 0
    changed: tuple[int, ...] = ()
    released: tuple[int, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    notices: tuple[str, ...] = ()


class Reconstruction:
    """
    Meshes from depth images with known poses.

    :param settings: bandwidths, thresholds, keyframe distances, threads
    :param sink: takes meshes that leave where max_memory_mb is full, see MemoryBound; may be set
    :param copied: whether max_memory_mb has to leave room for what frozen returns

    `keyframes` are the views that own a mesh, `density` is what all views built, `fused` makes one
    mesh of the keyframes where it is asked to, `stamp_ns` is the newest stamp of these views.
    """

    def __init__(
        self, settings: Settings, sink: Sink | None = None, copied: bool = False
    ) -> None:
        self.settings = settings
        self.keyframes: list[Keyframe] = []
        self.stamp_ns = 0
        self.sink = sink
        self.copied = copied
        self._bound = MemoryBound()
        self._density: Density | None = None
        self.fused = FusedMap()
        self._noticed: set[str] = set()
        self._pool: Executor | None = ThreadPoolExecutor(
            settings.threads or os.cpu_count() or 1, thread_name_prefix='gr2t')

    @property
    def density(self) -> Density:
        """
        Return what all views built.

        :raises FrameError: before the first view
        """
        if self._density is None:
            raise FrameError('empty_map', 'there is no map yet: no frame was integrated')
        return self._density

    @property
    def views(self) -> int:
        """Return the number of views that were added."""
        return self._density.size if self._density is not None else 0

    @property
    def pool(self) -> Executor | None:
        """Return the threads; None: it works in the caller's."""
        return self._pool

    @property
    def blocks(self) -> int:
        """Return the number of the lattice's blocks; the first stands for none."""
        lattice = self._density
        return lattice.blocks.size - 1 if isinstance(lattice, VoxelDensity) else 0

    @property
    def kept(self) -> int:
        """Return the number of keyframes that have their rays."""
        return sum(not keyframe.released for keyframe in self.keyframes)

    @property
    def depth_max(self) -> float:
        """Return up to which depth (m) the map takes pixels, whatever the settings became."""
        lattice = self._density
        return lattice.depth_max if isinstance(lattice, VoxelDensity) else float('inf')

    def add(self, view: View, load: float = 0.0) -> Update:
        """
        Add a view's kernels to the density and march what they change.

        A new keyframe's rays are marched at once, older rays within `remarch_budget`; what is left
        waits for the next view or for finish.

        :param load: 0 to 1; this share of the budget is left out, as other views wait
        :raises FrameError: if the depth image is not of its camera's size, or there is no memory
        """
        if view.depth.shape != (view.camera.height, view.camera.width):
            raise FrameError(
                'image_size', f'depth image of shape {view.depth.shape} does not fit its camera '
                f'of {view.camera.width} x {view.camera.height} pixels')
        began = perf_counter()
        notices = []
        wanted = self._is_keyframe(view)
        if self._density is not None:
            self._bound.make_room(self, view, wanted)
        made_room = perf_counter()
        if self._density is None:
            self._density, notice = new_density(self.settings, view)
            notices += [notice] if notice else []
        self._density.add(view, self._pool)
        self.stamp_ns = max(self.stamp_ns, view.stamp_ns)
        if 'aliasing' not in self._noticed:
            notices += self._once('aliasing', aliasing(self._density, view))
        number = None
        if wanted and self.kept < self.settings.max_keyframes:
            number = len(self.keyframes)
            self.keyframes.append(self._new_keyframe(view))
        elif wanted:
            notices += self._once(
                'keyframes', f'max_keyframes {self.settings.max_keyframes} is reached: later '
                'views add to the density, but own no mesh')
        integrated = perf_counter()
        update = self._march(
            number, integrated + (1.0 - load) * self.settings.remarch_budget)
        return replace(
            update, keyframe=number, notices=tuple(notices),
            seconds={'integrate': integrated - made_room, 'march': perf_counter() - integrated} | (
                {'release': made_room - began} if update.released else {}))

    def finish(self, budget: float = float('inf')) -> Update:
        """
        March the rays that wait, as before a snapshot or at the end of a recording.

        :param budget: seconds after which the rest is left waiting
        """
        began = perf_counter()
        update = self._march(None, began + budget)
        return replace(update, seconds={'march': perf_counter() - began})

    def mesh(self, keyframe: int, stride: int = 1) -> ViewMesh:
        """
        Return a keyframe's mesh, cut by the thresholds.

        :param stride: use every stride-th ray of every stride-th row
        """
        chosen = self.keyframes[keyframe]
        return view_mesh(
            self.density, chosen.rays, chosen.view.camera.width,
            self.settings.ray_stride * stride, self.settings.min_confidence,
            self.settings.min_edge_likelihood, self._pool)

    def meshes(self, stride: int = 1) -> Iterator[tuple[int, ViewMesh]]:
        """Yield (number, mesh) of all keyframes, in order."""
        for number in range(len(self.keyframes)):
            yield number, self.mesh(number, stride)

    def fuse(self) -> list[Region]:
        """
        Bring the fused map up to date with the rays as they are, marched or waiting.

        The first call makes it from all keyframes; none is made for those who do not ask.

        :return: the regions whose mesh may have changed since the last call
        """
        return self.fused.update(
            self._density, [(keyframe.view, keyframe.rays) for keyframe in self.keyframes],
            self.settings, self._pool)

    @property
    def fused_regions(self) -> list[Region]:
        """Return all regions of the fused map, as it was fused last."""
        return self.fused.regions

    def fused_region(self, region: Region) -> SurfaceMesh:
        """Return a region's mesh, as it was fused last; borders share vertices, no triangles."""
        return self.fused.mesh(self._density, self._pool, region=region)

    def fused_mesh(self, min_component: int = MIN_COMPONENT) -> SurfaceMesh:
        """
        Return the fused mesh of the whole map, brought up to date.

        :param min_component: triangles; connected parts that have fewer are left out
        """
        self.fuse()
        return self.fused.mesh(self._density, self._pool, min_component)

    def colouring(self) -> Colouring:
        """Return how points are coloured, up to the robust maximum over all keyframes."""
        density = self._density
        scale = robust_maximum(
            self.settings.color_by, density, [item.rays for item in self.keyframes]
        ) if density is not None else 0.0
        return Colouring(self.settings.color_by, scale, self.settings.colour_map)

    def frozen(self, room: Room, fields: Sequence[str] = ASKING) -> Reconstruction:
        """
        Return the map as it is now, for another thread, while this one goes on.

        It can finish and be meshed, in that thread alone, and takes no views.

        :param room: of frozen.room_for; most of the memory that it takes
        :param fields: of the lattice that it has; with state.ADDING it can be saved, not meshed
        """
        twin = copy(self)
        twin._pool, twin._bound, twin.sink = None, MemoryBound(), None
        twin.fused = FusedMap()  # it is made again from the same rays, where it is wanted
        if self._density is not None:
            self._density.refresh(self._pool)
            twin._density = frozen(self._density, room, fields)
        for keyframe in self.keyframes:
            keyframe.shared = True
        twin.keyframes = [copy(keyframe) for keyframe in self.keyframes]
        return twin

    def restore(self, density: Density, keyframes: list[Keyframe], stamp_ns: int) -> None:
        """Become what another reconstruction was when it was saved; see state.py."""
        self._density, self.keyframes, self.stamp_ns = density, keyframes, stamp_ns
        self.fused = FusedMap()

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _new_keyframe(self, view: View) -> Keyframe:
        rays = rays_of(
            self.density, view, self.settings.ray_stride, self.settings.start, self._pool)
        blocks = None
        if isinstance(self.density, VoxelDensity):
            blocks = watched_blocks(self.density, rays, self._pool)
        return Keyframe(view, rays, blocks)

    def _is_keyframe(self, view: View) -> bool:
        """Tell whether the camera has moved or turned enough since its last keyframe."""
        former = next((keyframe.view for keyframe in reversed(self.keyframes)
                       if keyframe.view.camera_name == view.camera_name), None)
        if former is None:
            return True
        moved, turned = step(former.T_world_camera, view.T_world_camera)
        return (
            moved >= self.settings.keyframe_translation
            or turned >= self.settings.keyframe_rotation)

    def _march(self, new: int | None, deadline: float) -> Update:
        """March the new keyframe's rays, then what changed on others until the deadline."""
        if self._density is None:
            return Update()
        released = self._bound.news()
        self._density.refresh(self._pool)
        marched = remarched = converged = 0
        changed: list[int] = []
        waiting = self._waiting(new)
        while waiting:
            number = waiting[0]
            keyframe = self.keyframes[number]
            rays = keyframe.own_rays()
            for begin in range(0, len(rays.pixels), _SLICE):
                if number != new and perf_counter() >= deadline:
                    break
                chosen = stale(
                    self._density, rays, slice(begin, begin + _SLICE), self._pool)
                if not len(chosen):
                    continue
                first = int(np.count_nonzero(rays.iterations[chosen] == 0))
                march(self._density, rays, chosen, self._pool)
                marched += first
                remarched += len(chosen) - first
                converged += int(np.count_nonzero(rays.converged[chosen]))
                if changed[-1:] != [number]:
                    changed.append(number)
            else:
                keyframe.checked = self._density.change
                waiting.pop(0)
                continue
            break
        return Update(
            marched=marched, remarched=remarched, converged=converged, changed=tuple(changed),
            released=released,
            waiting=sum(len(self.keyframes[number].rays.pixels) for number in waiting))

    def _waiting(self, new: int | None) -> list[int]:
        """Return the keyframes that may have stale rays: the newest, then the most changed."""
        shares = {}
        for number, keyframe in enumerate(self.keyframes):
            if keyframe.checked == self.density.change:
                continue
            if isinstance(self.density, VoxelDensity) and keyframe.blocks is not None:
                share = self.density.share_changed(keyframe.blocks, keyframe.checked)
                if share == 0 and number != new:
                    keyframe.checked = self.density.change
                    continue
                shares[number] = share
            else:
                shares[number] = 0.0
        newest = len(self.keyframes) - 1
        return sorted(shares, key=lambda n: (n != newest, -shares[n], -n))

    def _once(self, topic: str, sentence: str) -> list[str]:
        if not sentence or topic in self._noticed:
            return []
        self._noticed.add(topic)
        return [sentence]
