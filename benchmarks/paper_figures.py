# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The pictures of benchmarks/paper.py."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from truth import Geometry

from gr2t_ros.core.colour import colours
from gr2t_ros.tools.orbit import looking_at, Pose
from gr2t_ros.tools.render import render

Doubles = NDArray[np.float64]

_LIKELIHOOD_COLOURS = 'turbo'
# the renderer mixes the colours of layers: here the mixture must be the colour of the mean
_DISTANCE_COLOURS = 'YlOrRd'
_ASIDE = np.deg2rad(40)  # between where a view was taken from and where its mesh is looked at
_AWAY = 1.4  # of the bounds' diagonal
_FRONT = np.array([0.25, 0.3, 0.92])
_DISTANCE_SCALE = 0.5  # mm
_SHOWN = (0, 3, 6, 9)  # views
_Y_UP = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # of y-up to z-up
_DPI = 100


def likelihood(
    path: Path, rows: Mapping[str, Sequence[tuple[Geometry, Doubles]]], poses: Sequence[Pose],
    bounds: Doubles,
) -> None:
    """
    Draw some views' meshes, each from aside of its camera, in the colours of their likelihoods.

    :param rows: title -> one (mesh, likelihood from 0 to 1 of its vertices) a view
    :param poses: (4, 4) T_world_camera of the views
    :param bounds: (2, 3) of what they look at, world, metres
    """
    shown = [number for number in _SHOWN if number < len(poses)]
    pictures = {
        title: [render(
            meshes[n][0].vertices, meshes[n][0].faces,
            colours(meshes[n][1], 1.0, _LIKELIHOOD_COLOURS), _aside(poses[n], bounds),
            300, 225) for n in shown]
        for title, meshes in rows.items()}
    _grid(
        path, pictures, [f'view {n + 1}' for n in shown], 1.0, _LIKELIHOOD_COLOURS,
        'likelihood / its robust maximum')


def distance(
    path: Path, rows: Mapping[str, Mapping[str, tuple[Geometry, Doubles]]], bounds: Doubles,
) -> None:
    """
    Draw meshes in the colours of their distances to the truth.

    :param rows: noise -> column -> (mesh, metres of its vertices)
    :param bounds: (2, 3) of the truth, world, metres
    """
    pose = _place(_FRONT, bounds)
    pictures = {
        f'noise: {noise}': [render(
            mesh.vertices, mesh.faces, colours(1e3 * error, _DISTANCE_SCALE, _DISTANCE_COLOURS),
            pose, 450, 338) for mesh, error in columns.values()]
        for noise, columns in rows.items()}
    _grid(
        path, pictures, list(next(iter(rows.values()))), _DISTANCE_SCALE, _DISTANCE_COLOURS,
        'distance to the true surface, mm')


def likelihood_against_distance(
    path: Path, clouds: Mapping[str, tuple[Doubles, Doubles]]
) -> None:
    """
    Plot how many vertices have which likelihood and distance, with the median and the 95th.

    :param clouds: noise -> (likelihood of its robust maximum, metres)
    """
    figure = Figure(figsize=(10.4, 4.2), dpi=_DPI, layout='constrained')
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, len(clouds), sharey=True))
    top = max(1.1, *(1e3 * float(np.percentile(error, 99.9)) for _, error in clouds.values()))
    for panel, (noise, (likely, error)) in zip(panels, clouds.items()):
        error = 1e3 * error
        *_, cells = panel.hist2d(
            likely, error, bins=(np.linspace(0, 1.3, 131), np.linspace(0, top, 111)),
            norm=LogNorm(), cmap='Greys')
        parts = np.array_split(np.argsort(likely, kind='stable'), 40)
        at = [np.median(likely[part]) for part in parts]
        for share, colour, name in (
                (95, '#2463b0', '95th percentile'), (50, '#c0392b', 'median')):
            panel.plot(
                at, [np.percentile(error[part], share) for part in parts], color=colour,
                label=f'{name}, of each 40th of the vertices')
        panel.axhline(1.0, color='0.5', linewidth=0.8, linestyle='--', label='near')
        panel.set(title=f'noise: {noise}', xlabel='likelihood / its robust maximum')
        figure.colorbar(cells, ax=panel, label='vertices in a cell')
    panels[0].set_ylabel('distance to the true surface, mm')
    panels[0].legend(fontsize=8, loc='upper left', bbox_to_anchor=(0, 0.9))
    _save(figure, path)


def _aside(pose: Pose, bounds: Doubles) -> Pose:
    """Return a place beside that of a camera."""
    away = pose[:3, 3] - bounds.mean(axis=0)
    return _place(
        np.cos(_ASIDE) * away / np.linalg.norm(away) + np.sin(_ASIDE) * pose[:3, 0], bounds)


def _place(direction: Doubles, bounds: Doubles) -> Pose:
    """Return the pose that sees all from a direction, y upwards as in Stanford's meshes."""
    target = bounds.mean(axis=0)
    eye = target + _AWAY * np.linalg.norm(bounds[1] - bounds[0]) * direction
    pose = looking_at(_Y_UP @ eye, _Y_UP @ target)
    pose[:3] = _Y_UP.T @ pose[:3]
    return pose


def _grid(
    path: Path, rows: Mapping[str, Sequence[NDArray[np.uint8]]], columns: Sequence[str],
    scale: float, colour_map: str, unit: str,
) -> None:
    """Write rows of pictures with titles above a scale of colours."""
    height, width, _ = next(iter(rows.values()))[0].shape
    head, foot, top = 26, 54, 24
    size = (width * len(columns), top + (height + head) * len(rows) + foot)
    figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor='white')
    FigureCanvasAgg(figure)

    def put(picture: NDArray[np.uint8], left: int, y: int) -> None:
        axes = figure.add_axes(
            (left / size[0], 1 - (y + height) / size[1], width / size[0], height / size[1]))
        axes.imshow(picture, interpolation='nearest', aspect='auto')
        axes.axis('off')

    for column, name in enumerate(columns):
        figure.text(
            (column + 0.5) * width / size[0], 1 - 0.6 * top / size[1], name, fontsize=11,
            ha='center', va='center')
    for row, (title, pictures) in enumerate(rows.items()):
        y = top + row * (height + head)
        figure.text(10 / size[0], 1 - (y + 0.5 * head) / size[1], title, fontsize=10, va='center')
        for column, picture in enumerate(pictures):
            put(picture, column * width, y + head)
    bar = figure.add_axes((0.35, 30 / size[1], 0.4, 12 / size[1]))
    figure.colorbar(
        ScalarMappable(Normalize(0, scale), colour_map), cax=bar, orientation='horizontal',
        extend='max')
    bar.tick_params(labelsize=9, length=3, pad=2)
    figure.text(0.335, 36 / size[1], unit, fontsize=10, ha='right', va='center')
    _save(figure, path, _palette(colour_map))


def _save(figure: Figure, path: Path, palette: NDArray[np.uint8] | None = None) -> None:
    """
    Write a figure.

    :param palette: (n <= 256, 3) colours that it is reduced to, for a third of the bytes
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = BytesIO()
    figure.savefig(stream, format='png')
    picture = Image.open(stream).convert('RGB')
    if palette is not None:
        fixed = Image.new('P', (1, 1))
        fixed.putpalette(palette.tobytes())
        picture = picture.quantize(palette=fixed, dither=Image.Dither.FLOYDSTEINBERG)
    picture.save(path, optimize=True)


def _palette(colour_map: str) -> NDArray[np.uint8]:
    """Return the scale's colours in several lights, backgrounds and greys."""
    lights = np.linspace(0.4, 1.15, 7)[:, None, None]
    scale = lights * colours(np.linspace(0, 1, 32), 1.0, colour_map)
    ramp = np.linspace(0, 1, 16)[:, None]
    return np.vstack([
        np.minimum(scale.reshape(-1, 3), 255),
        ramp * (247, 248, 250) + (1 - ramp) * (206, 212, 221),
        np.linspace(0, 255, 16)[:, None] * np.ones(3)]).astype(np.uint8)
