# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Exact depths of triangle meshes."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
import trimesh

from ..errors import InputError


class RayCaster:
    """
    Exact depths of a triangle mesh.

    :param mesh: in world coordinates, metres
    :raises InputError: if Embree is not installed
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        try:
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError:
            raise InputError(
                'simulating needs the ray caster Embree: pip install embreex (or install this '
                'package with its extra: pip install "gr2t_ros[simulation]")') from None
        # Embree computes in float32: it only finds the triangle, about an origin that is near
        self._origin = mesh.bounds.mean(axis=0)
        self._triangles = np.asarray(mesh.triangles, np.float64)
        self._embree: Any = RayMeshIntersector(trimesh.Trimesh(
            mesh.vertices - self._origin, mesh.faces, process=False))

    def cast(
        self, T_world_camera: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """
        Return depths and angles of incidence.

        :param rays: (h, w, 2) float64, as Camera.rays
        :return: (h, w) float64 depth along the optical axis, metres; (h, w) float64 angle
            between ray and surface normal, radians, 0 to pi / 2; both NaN where nothing is hit
        """
        shape = rays.shape[:2]
        rays = np.concatenate([rays, np.ones((*shape, 1))], axis=-1).reshape(-1, 3)
        directions = rays @ T_world_camera[:3, :3].T
        eye = T_world_camera[:3, 3]
        origins = np.broadcast_to(eye - self._origin, directions.shape)
        hit = self._embree.intersects_first(origins, directions)
        seen = hit >= 0
        depth = np.full(len(rays), np.nan)
        angle = np.full(len(rays), np.nan)
        depth[seen], angle[seen] = _intersect(
            self._triangles[hit[seen]] - eye, directions[seen], T_world_camera[:3, 2])
        return depth.reshape(shape), angle.reshape(shape)


def _intersect(
    triangles: NDArray[np.float64], directions: NDArray[np.float64], axis: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """
    Intersect rays from the origin with one triangle each that they are known to hit.

    :param triangles: (n, 3, 3) float64, metres
    :param directions: (n, 3) float64 of the rays, any length
    :param axis: (3,) float64, unit vector along which depth counts
    :return: (n,) depth, metres; (n,) angle between ray and normal, radians
    """
    # Volumes of the ray with the triangle's edges are its barycentric coordinates; they are
    # clamped, for Embree's float32 may hit a triangle that the exact ray just misses.
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    weights = np.stack([
        np.einsum('ij,ij->i', directions, np.cross(b, c)),
        np.einsum('ij,ij->i', directions, np.cross(c, a)),
        np.einsum('ij,ij->i', directions, np.cross(a, b))], axis=1)
    weights *= np.sign(weights.sum(axis=1, keepdims=True))
    weights = np.maximum(weights, 0.0)
    total = weights.sum(axis=1)
    flat = total == 0.0  # a degenerate triangle, or one seen exactly from its side
    weights[flat] = 1.0
    total[flat] = 3.0
    depth = np.einsum('ij,ij->i', weights, triangles @ axis) / total
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(directions, axis=1)
    cosine = np.abs(np.einsum('ij,ij->i', normals, directions))
    cosine = np.divide(cosine, lengths, out=np.zeros(len(depth)), where=lengths > 0)
    return depth, np.arccos(np.minimum(cosine, 1.0))
