# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The density sampled on a sparse lattice: a view costs the same however many came before.

A view adds its term to the voxels within its support, each once; between voxels the density is a
cubic spline. Nothing of the view is kept, and remove() subtracts the same numbers again.
"""
from __future__ import annotations

from concurrent.futures import Executor
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from . import blocks as lattice
from .block_removal import without
from .blocks import Blocks, SIDE, VOXELS
from .camera import Camera
from .compiled import run_all
from .view import View
from .voxel_add import add_to_blocks, keys_of_view, Place
from .voxel_query import jets, Lattice
from .warped import (
    empty_support,
    find_support,
    Scale,
    Warped,
    warped,
    Weights,
)

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_ROWS_OF_CELLS = 30  # a task
_BLOCKS = 128  # a task
_POINTS = 16384  # a task
_FINEST = 1.5  # voxels wider than this many lateral bandwidths alias


class VoxelDensity:
    """
    The likelihood of world points given the views added so far, on a lattice.

    :param pixel_bandwidth: h1 = h2, pixels
    :param depth_bandwidth: h3 at depth 0, metres
    :param depth_bandwidth_quadratic: growth of h3 with the squared depth, 1/metres
    :param voxel_size: metres; h3 is never below it
    :param depth_max: metres; larger depths count as invalid
    :raises InputError: if a bandwidth or the voxel size is not positive

    most_blocks: that are expected, see blocks.with_keys; may be set.
    """

    def __init__(
        self, pixel_bandwidth: float, depth_bandwidth: float, depth_bandwidth_quadratic: float,
        voxel_size: float, depth_max: float,
    ) -> None:
        if not (pixel_bandwidth > 0 and depth_bandwidth > 0 and depth_bandwidth_quadratic >= 0):
            raise InputError('bandwidths must be positive')
        if not voxel_size > 0:
            raise InputError('voxel_size must be positive')
        self.voxel_size = voxel_size
        self.pixel_bandwidth = pixel_bandwidth
        self.depth_max = depth_max
        # h3(z) = max(constant + quadratic z^2, floor)
        self.bandwidth = (
            float(depth_bandwidth), float(depth_bandwidth_quadratic), float(voxel_size))
        self.scale = Scale.of(*self.bandwidth, depth_max)
        self.weights = Weights.of(pixel_bandwidth)
        self.blocks = lattice.new_blocks()
        self.size = 0  # views
        self.pixels = 0
        self.aliased_pixels = 0  # nearer than the lattice can follow
        self._depth_of_bins = self.scale.depth_of_bins()
        self.most_blocks = lattice.NO_LIMIT
        self._change = 0
        self._recent: tuple[View, Warped] | None = None  # a keyframe's rays need its image again
        self._stale: list[NDArray[np.int32]] = []

    @property
    def state(self) -> Lattice:
        """Return what the kernels need."""
        return Lattice(self.blocks, self.voxel_size)

    @property
    def change(self) -> int:
        """Return the number of the last change of the lattice."""
        return self._change

    def h3(self, depth: Doubles | Floats) -> Doubles:
        """Return the bandwidth along the depth, metres, at depths in metres."""
        constant, quadratic, floor = self.bandwidth
        return np.maximum(constant + quadratic * np.asarray(depth, np.float64) ** 2, floor)

    def add(self, view: View, pool: Executor | None = None) -> None:
        """Add a view's kernels."""
        self._accumulate(view, 1, pool)

    def cover(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        """
        Make sure that blocks exist, so that whoever watches them learns of every change there.

        :param keys: (n,) int64, in any order, repeated or not
        :return: the blocks' numbers, each once
        """
        before = self.blocks.size
        self._change += 1
        self.blocks, found = lattice.with_keys(
            self.blocks, keys, self._change, self.most_blocks)
        if self.blocks.size > before:
            self._stale.append(np.arange(before, self.blocks.size, dtype=np.int32))
        return found

    def finest_voxel(self, depth: float, camera: Camera) -> float:
        """Return the widest voxel (metres) that follows the lateral kernel at a depth."""
        return _FINEST * self.pixel_bandwidth * depth / max(camera.fx, camera.fy)

    def share_changed(self, watched: NDArray[np.int32], change: int) -> float:
        """Return the share of some blocks whose spline changed after a change."""
        return float(np.mean(self.blocks.filtered[watched] > change)) if len(watched) else 0.0

    def remove(self, view: View, pool: Executor | None = None) -> None:
        """Subtract what add() added for the same view."""
        self._accumulate(view, -1, pool)

    def forget(
        self, watched: NDArray[np.bool_], since: int, pool: Executor | None = None
    ) -> NDArray[np.int32]:
        """
        Remove the blocks that neither rays need nor a view has touched after a change.

        :param watched: (n,) for each block whether rays need it
        :return: each former block's number now, (n,) int32; 0: it is gone
        """
        self.refresh(pool)
        self.blocks, renumbered, border = without(self.blocks, watched, since)
        self._filter(border, pool)
        return renumbered

    def refresh(self, pool: Executor | None = None) -> None:
        """Bring the spline up to date with the samples; before asking for anything."""
        if not self._stale:
            return
        changed = np.unique(np.concatenate(self._stale))
        self._stale.clear()
        self._filter(
            np.sort(lattice.with_neighbours(self.blocks, changed, self._change)), pool)

    def restore(
        self, blocks: Blocks, views: int, pixels: int, aliased_pixels: int, change: int,
        pool: Executor | None = None,
    ) -> None:
        """
        Become what another density was when its samples were saved, just refreshed.

        :param blocks: with all but the coefficients
        """
        self.blocks = blocks
        self.size, self.pixels, self.aliased_pixels = views, pixels, aliased_pixels
        self._change = change
        self._filter(np.arange(1, blocks.size, dtype=np.int32), pool)

    def merge(self, other: VoxelDensity) -> NDArray[np.int32]:
        """
        Add the samples of another lattice with the same voxels, whose change numbers end here.

        :return: the numbers of its blocks in this one, from its block 1 on
        """
        size = other.blocks.size
        self._change = max(self._change, other.change)
        found = self.cover(other.blocks.key[1:size])
        for name in ('value', 'expected'):
            ours = getattr(self.blocks, name).reshape(-1, VOXELS)
            theirs = getattr(other.blocks, name).reshape(-1, VOXELS)[1:size]
            for begin in range(0, len(found), _BLOCKS):
                ours[found[begin:begin + _BLOCKS]] += theirs[begin:begin + _BLOCKS]
        self._stale.append(found)
        self.size += other.size
        self.pixels += other.pixels
        self.aliased_pixels += other.aliased_pixels
        return found

    def _filter(self, chosen: NDArray[np.int32], pool: Executor | None) -> None:
        """Compute the spline of some blocks."""
        parts = [chosen[i:i + _BLOCKS] for i in range(0, len(chosen), _BLOCKS)]
        run_all(pool, lattice.prefilter, [(self.blocks, part) for part in parts])
        run_all(pool, lattice.copy_margins, [(self.blocks, part) for part in parts])

    def likelihood(self, points: Doubles, pool: Executor | None = None) -> Doubles:
        """
        Evaluate the likelihood at points.

        :param points: (n, 3) float64, world, metres
        :return: (n,) float64, 1 / (px^2 m)
        """
        points = np.ascontiguousarray(points, np.float64)
        directions = np.zeros((1, 3))
        found = np.zeros((len(points), 3))
        run_all(pool, jets, [
            (self.state, points[i:i + _POINTS], directions, np.zeros(1), found[i:i + _POINTS])
            for i in range(0, len(points), _POINTS)])
        return found[:, 0] / max(self.size, 1)

    def expected_total(self, points: Doubles) -> Doubles:
        """
        Return C times the likelihood of a plane that faces the views which see a point.

        The sum over those views of 1 / (N_c sqrt(2 pi) h3), at the nearest voxel: C times the
        likelihood over it depends neither on the cameras nor on how often a place was seen.

        :param points: (n, 3) float64, world, metres
        :return: (n,) float64, 1 / (px^2 m); 0 where no view sees the point
        """
        return lattice.values_at(
            self.blocks, self.blocks.expected,
            np.round(np.asarray(points, np.float64) / self.voxel_size).astype(np.int64))

    def along(
        self, origins: Doubles, directions: Doubles, distances: Doubles
    ) -> tuple[Doubles, Doubles, Doubles]:
        """
        Evaluate the likelihood and its derivatives along lines.

        :param origins: (n, 3) float64, world, metres; directions likewise
        :param distances: (n,) float64, in units of the directions' lengths
        :return: f, f', f'', each (n,) float64; f in 1 / (px^2 m)
        """
        found = np.zeros((len(origins), 3))
        jets(
            self.state, np.ascontiguousarray(origins, np.float64),
            np.ascontiguousarray(directions, np.float64),
            np.ascontiguousarray(distances, np.float64), found)
        found /= max(self.size, 1)
        return found[:, 0], found[:, 1], found[:, 2]

    def image_of(self, view: View, pool: Executor | None = None) -> Warped:
        """Return a view's depth image in units of its bandwidth."""
        if self._recent is None or self._recent[0] is not view:
            before = self._recent[1] if self._recent else None
            self._recent = (view, warped(view, self.scale, self.weights, pool, before))
        return self._recent[1]

    def _check_reach(self, view: View) -> None:
        """Refuse a camera from where a block's number could not be written down."""
        reach = 2.0 ** 20 * SIDE * self.voxel_size
        away = float(np.abs(view.T_world_camera[:3, 3]).max())
        if not away + 4 * self.depth_max < reach:
            raise FrameError(
                'out_of_range', f'the camera is {away:.6g} m from the origin of the world frame; '
                f'with voxels of {1000 * self.voxel_size:g} mm a map reaches {reach:.0f} m: '
                'choose a nearer world_frame')

    def _accumulate(self, view: View, sign: int, pool: Executor | None) -> None:
        height, width = view.depth.shape
        self._check_reach(view)
        T = np.asarray(view.T_world_camera, np.float64)
        R_world_camera = np.ascontiguousarray(T[:3, :3])
        R_camera_world = np.ascontiguousarray(R_world_camera.T)
        # the weights sum to 1 where the Gaussian's values sum to 2 pi h1^2
        factor = sign / sqrt(2 * pi) / (width * height)
        place = Place(
            R_camera_world, -R_camera_world @ T[:3, 3], view.camera.parameters, width, height,
            factor)
        image = self.image_of(view, pool)
        support = empty_support(height, width)
        rows = [
            (i, min(i + _ROWS_OF_CELLS, len(image.low)))
            for i in range(0, len(image.low), _ROWS_OF_CELLS)]
        run_all(pool, find_support, [
            (image, height, width, self.weights.lanes, support, *part) for part in rows])
        keys = run_all(pool, keys_of_view, [
            (support, view.camera.rays, R_world_camera, T[:3, 3].copy(), self._depth_of_bins,
             SIDE * self.voxel_size, self.weights.lanes // 2, *part) for part in rows])
        self.size += sign
        self.pixels += sign * image.valid
        nearest = self.voxel_size / self.finest_voxel(1.0, view.camera)
        self.aliased_pixels += sign * int(np.count_nonzero(view.depth < nearest))
        self._change += 1
        self.blocks, touched = lattice.with_keys(
            self.blocks, np.concatenate(keys), self._change, self.most_blocks)
        if len(touched) == 0:
            return
        run_all(pool, add_to_blocks, [
            (self.blocks, self.voxel_size, touched[i:i + _BLOCKS], place, image, support,
             self.scale, self.weights)
            for i in range(0, len(touched), _BLOCKS)])
        self._stale.append(touched)
