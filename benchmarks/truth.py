# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is true of a simulated scan: its surface, what the views see of it, where it jumps."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
import trimesh
from trimesh.sample import sample_surface

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.view import View
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.orbit import Pose
from gr2t_ros.tools.ray_caster import RayCaster

Doubles = NDArray[np.float64]

_SAMPLES = 100_000
_SEEN = 1e-4  # metres; a ray that ends this near a point sees it
_PARTS = 8  # a pixel is cut into so many to find where the surface jumps


@dataclass(frozen=True, eq=False)
class Geometry:
    """
    Triangles.

    :param vertices: (n, 3) float64, world, metres
    :param faces: (m, 3) int32
    """

    vertices: Doubles
    faces: NDArray[np.int32]

    @classmethod
    def of(cls, meshes: Sequence[ViewMesh]) -> Geometry:
        """Join the meshes of several views."""
        counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        return cls(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate([mesh.faces + np.int32(n) for mesh, n in zip(meshes, counts)]))

    def only(self, kept: NDArray[np.bool_]) -> Geometry:
        """Return what is left with some vertices, and the faces between them."""
        number = np.cumsum(kept, dtype=np.int32) - 1
        return Geometry(self.vertices[kept], number[self.faces[kept[self.faces].all(axis=1)]])


class Truth:
    """
    The true surface of a scan.

    :param mesh: metres
    :param views: of the scan; their cameras and poses count
    """

    def __init__(self, mesh: trimesh.Trimesh, views: Sequence[View]) -> None:
        self.surface = Surface(mesh.triangles)
        self.caster = RayCaster(mesh)
        samples, _ = sample_surface(mesh, _SAMPLES, seed=0)
        seen = sum(
            self.sees(view.camera, view.T_world_camera, samples).astype(int) for view in views)
        self.samples = samples[seen >= 2]

    def depth(self, view: View) -> Doubles:
        """Return the true depth of each pixel, (h, w), metres, NaN where nothing is."""
        return self.caster.cast(view.T_world_camera, view.camera.rays)[0]

    def completeness(self, found: Geometry, within: float) -> float:
        """Return the share of the surface seen by two views that lies near a mesh (metres)."""
        if not len(found.faces):
            return 0.0
        return float(np.mean(
            Surface(found.vertices[found.faces]).distances(self.samples) <= within))

    def steps(
        self, view: View, pixels: NDArray[np.int64], across: int, down: int
    ) -> tuple[Doubles, Doubles]:
        """
        Return how the true depth changes from pixels to a neighbour each.

        :param pixels: (n,) flat indices
        :param across: columns to the neighbour, down: rows
        :return: (n,) the largest step between neighbouring parts of the way, metres, infinite
            where a part hits nothing; (n,) the whole change
        """
        camera = view.camera
        to = np.array([across / camera.fx, down / camera.fy])
        rays = camera.rays.reshape(-1, 1, 2)[pixels]
        depths = np.stack([
            self.caster.cast(view.T_world_camera, rays + part / _PARTS * to)[0][:, 0]
            for part in range(_PARTS + 1)])
        steps = np.abs(np.diff(depths, axis=0))
        largest = np.where(np.isnan(steps), np.inf, steps).max(axis=0)
        return largest, np.abs(depths[-1] - depths[0])

    def sees(
        self, camera: Camera, T_world_camera: Pose, points: Doubles, steepest: float = np.pi
    ) -> NDArray[np.bool_]:
        """
        Tell which points of the surface a camera sees.

        :param points: (n, 3) float64
        :param steepest: angle between a ray and the surface's normal, radians
        """
        R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
        x, y, z = ((points - eye) @ R).T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (abs(u - camera.width / 2) < camera.width / 2) & (
            abs(v - camera.height / 2) < camera.height / 2)
        hit, angle = self.caster.cast(T_world_camera, np.column_stack([x / z, y / z])[:, None])
        return inside & (np.abs(hit[:, 0] - z) < _SEEN) & (angle[:, 0] <= steepest)
