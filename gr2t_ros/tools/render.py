# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of meshes in the colours of their likelihoods or deviations."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.colour import Colouring
from ..io.files import whole_file
from .raster import Raster, rasterise, vertex_normals
from .viewpoint import good_view

Pose = NDArray[np.float64]
Image = NDArray[np.uint8]

FOCAL = 1.3  # of the width: a field of view of 42 degrees
_SAMPLES = 2  # a pixel's side
_KEY = np.array([-0.45, -0.75, -0.55], np.float32)  # light from the upper left, behind the camera
_FILL = np.array([0.75, -0.1, -0.6], np.float32)
# the background's colours
_TOP, _BOTTOM = np.array([(247, 248, 250), (206, 212, 221)], np.float32)
_INK = '#2b3340'
_FOOTER = 76  # px, below the picture
_DPI = 100


def preview(
    path: Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    likelihood: ArrayLike,
    sigma: ArrayLike,
    colouring: Colouring,
    title: str = '',
    poses: Sequence[Pose] = (),
    T_world_camera: Pose | None = None,
    width: int = 1280,
    height: int = 800,
) -> None:
    """
    Write a picture of a mesh, from a place that shows much of it, with a scale of colours.

    :param path: a PNG file; an older one is replaced
    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) indices of vertices, counter-clockwise seen from outside
    :param likelihood: (n,), 1 / (px^2 m)
    :param sigma: (n,) standard deviations, metres
    :param colouring: which of the two is shown
    :param title: a line below the picture
    :param poses: (4, 4) T_world_camera of the cameras that scanned it; without them z is up
    :param T_world_camera: (4, 4) the place to look from, where it is known
    :param width: of the picture, pixels; likewise height, to which a footer is added
    :raises Gr2tError: if the file cannot be written
    """
    vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
    faces = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    # vertices that no triangle uses are not drawn, and so do not count for the view either
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    faces = (np.cumsum(used, dtype=np.int32) - 1)[faces]
    vertices = vertices[used]
    colours = colouring.colours(np.asarray(likelihood)[used], np.asarray(sigma)[used])
    if T_world_camera is None:
        T_world_camera = good_view(vertices, faces, poses, FOCAL, height / width)
    picture = render(vertices, faces, colours, T_world_camera, width, height)
    figure = _framed(picture, colouring, title)
    with whole_file(path) as stream:
        figure.savefig(stream, format='png')


def _framed(picture: Image, colouring: Colouring, title: str) -> Figure:
    """Return the picture above a footer with a title and a scale of colours."""
    height, width = picture.shape[0] + _FOOTER, picture.shape[1]
    footer = np.broadcast_to(_BOTTOM.astype(np.uint8), (_FOOTER, width, 3))
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    figure.figimage(np.vstack([picture, footer]), zorder=-1)
    figure.text(
        24 / width, 0.5 * _FOOTER / height, title, color=_INK, fontsize=11, va='center')
    bar = figure.add_axes((1 - 384 / width, 38 / height, 360 / width, 14 / height))
    label, factor = _unit(colouring)
    end = colouring.scale or 1.0
    ramp = np.linspace(0.0, end, 256)
    bar.imshow(
        replace(colouring, scale=end).colours(ramp, ramp)[None], aspect='auto',
        extent=(0.0, factor * end, 0.0, 1.0))
    bar.set_yticks([])
    bar.locator_params(axis='x', nbins=6)
    bar.tick_params(axis='x', colors=_INK, labelsize=9, length=3, pad=2)
    bar.spines[:].set_visible(False)
    bar.set_title(label, color=_INK, fontsize=9, pad=4, loc='left')
    return figure


def _unit(colouring: Colouring) -> tuple[str, float]:
    """Return the label of a scale, and by what its values are multiplied."""
    if colouring.by == 'sigma':
        return 'standard deviation along the ray, mm', 1e3
    # likelihoods are far from 1: a power of ten in the label keeps the ticks short
    exponent = int(np.floor(np.log10(colouring.scale))) if colouring.scale > 0 else 0
    unit = f'$10^{{{exponent}}}$' if exponent else '1'
    return f'likelihood, {unit} / (px² m)', 10.0 ** -exponent


def render(
    vertices: ArrayLike,
    faces: ArrayLike,
    colours: NDArray[np.uint8],
    T_world_camera: Pose,
    width: int = 1280,
    height: int = 960,
) -> Image:
    """
    Draw a mesh, lit, before a soft background.

    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) indices of vertices
    :param colours: (n, 3) uint8, red green blue
    :param T_world_camera: (4, 4), the place to look from; see good_view
    :return: (height, width, 3) uint8
    """
    vertices = np.asarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
    points = np.ascontiguousarray((vertices - eye) @ R, np.float32)
    raster = rasterise(
        points, vertex_normals(points, faces), faces, colours,
        FOCAL * width * _SAMPLES, width * _SAMPLES, height * _SAMPLES)
    picture = _lit(raster)
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _lit(raster: Raster) -> NDArray[np.float32]:
    """Return (h, w, 3) float32 colours, 0 to 255."""
    height, width = raster.depth.shape
    seen = np.isfinite(raster.depth)
    light = (
        0.56 + 0.46 * np.maximum(raster.normal @ (_KEY / np.linalg.norm(_KEY)), 0)
        + 0.2 * np.maximum(raster.normal @ (_FILL / np.linalg.norm(_FILL)), 0))
    light *= 1.0 - _hollows(raster.depth, seen, 0.012 * width, 0.03)
    light *= 1.0 - _hollows(raster.depth, seen, 0.003 * width, 0.012)
    ramp = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    background = (1 - ramp) * _TOP + ramp * _BOTTOM
    return np.where(
        seen[..., None], np.minimum(raster.colour * light[..., None], 255), background)


def _hollows(
    depth: NDArray[np.float32], seen: NDArray[np.bool_], radius: float, reach: float
) -> NDArray[np.float32]:
    """
    Return how much darker hollows are: pixels that lie behind the mean of their surroundings.

    :param radius: of the surroundings, pixels
    :param reach: the share of the depth that gives the darkest
    """
    height, width = depth.shape
    coarse = max(int(radius / 2), 1)  # blurring a smaller image is as smooth, and much faster
    size = (width // coarse, height // coarse)
    share, mean = (
        cv2.GaussianBlur(
            cv2.resize(image, size, interpolation=cv2.INTER_AREA), (0, 0), radius / coarse)
        for image in (seen.astype(np.float32), np.where(seen, depth, np.float32(0))))
    mean = cv2.resize(mean / np.maximum(share, 1e-6), (width, height))
    behind = np.where(seen, 1 - mean / depth, 0)
    darkness: NDArray[np.float32] = 0.38 * np.clip(behind / reach, 0, 1).astype(np.float32)
    return darkness
