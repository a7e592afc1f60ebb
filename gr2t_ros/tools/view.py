# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t view`: one HTML file that shows a mesh in a browser, without a network."""
from __future__ import annotations

import argparse
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import asdict, dataclass
import html
import json
from math import floor, log10
from pathlib import Path
import re
from typing import Any
import zlib

import numpy as np
from numpy.typing import NDArray

from ..core.colour import colours
from ..core.view_mesh import ROBUST_MAXIMUM
from ..io import formats, trajectory
from ..io.files import whole_file
from ..settings import Settings
from .progress import say
from .render import FOCAL
from .viewpoint import good_view, Pose, upward

_PARTS = Path(__file__).with_name('viewer')
_ASPECT = 1.6  # of the picture that the first view fills
_STEPS_PER_EDGE = 64  # positions are rounded to this share of a typical edge
_MANY_FACES = 3_000_000  # more than a usual graphics card turns smoothly


@dataclass(frozen=True)
class Scalar:
    """
    What the colours can show.

    :param unit: a text for people
    :param factor: from a mesh's values to that unit
    :param worst: the value of the first colour, in that unit; likewise best, of the last
    """

    name: str
    unit: str
    factor: float
    worst: float
    best: float

    def levels(self, values: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return values as 0 (worst) to 255 (best)."""
        share = (self.factor * values - self.worst) / ((self.best - self.worst) or 1.0)
        return np.rint(255 * np.clip(np.nan_to_num(share), 0, 1))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'mesh', metavar='MESH', type=Path,
        help='a mesh that trimesh reads (PLY, GLB ...), or the folder of a replay, whose cameras '
        'are shown too')
    parser.add_argument(
        '-o', '--output', metavar='PAGE', type=Path, help='the page; default: MESH.html')


def run(args: argparse.Namespace) -> int:
    """
    Run the command.

    :raises InputError: if the mesh cannot be read
    :raises Gr2tError: if the page cannot be written
    """
    path, poses = args.mesh, []
    if path.is_dir():
        cameras = path / 'cameras.txt'
        path = path / 'mesh.ply'
        if path.is_file() and cameras.is_file():
            poses = trajectory.read(cameras)[1]
    mesh = formats.read(path)
    output = args.output or path.with_suffix('.html')
    if not mesh.attributes:
        say(f'{path} has no likelihood, sigma or confidence: the page shows its shape alone')
    if len(mesh.faces) > _MANY_FACES:
        say(f'{path} has {len(mesh.faces)} faces, which may be slow to turn; fewer: '
            'gr2t convert --max-faces')
    title = f'{path.resolve().parent.name}/{path.name}'
    write(output, mesh, poses, title)
    print(f'{output}  {output.stat().st_size / 1e6:.1f} MB; open it in a browser')
    return 0


def write(path: Path, mesh: formats.Mesh, poses: Sequence[Pose], title: str) -> None:
    """
    Write the page.

    :param poses: (4, 4) T_world_camera of the cameras that scanned the mesh; may be empty
    :raises Gr2tError: if the file cannot be written
    """
    header, data = packed(mesh, poses)
    parts = {
        'TITLE': html.escape(title),
        'HEADER': json.dumps(header).replace('<', '\\u003c'),
        'DATA': b64encode(data).decode(),
        'MESH': (_PARTS / 'mesh.js').read_text(encoding='utf-8'),
        'PAGE': (_PARTS / 'page.js').read_text(encoding='utf-8')}
    page = (_PARTS / 'page.html').read_text(encoding='utf-8')
    with whole_file(path) as stream:
        stream.write(re.sub('@([A-Z]+)@', lambda match: parts[match[1]], page).encode())


def packed(mesh: formats.Mesh, poses: Sequence[Pose]) -> tuple[dict[str, Any], bytes]:
    """
    Return a mesh as viewer/mesh.js unpacks it.

    :return: the header; and deflated whole numbers: x of all vertices, y, z in steps from the
        middle, the level (0 doubtful to 255 sure) of each scalar, and the faces
    """
    vertices = mesh.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    edges = vertices[mesh.faces[:, 0]] - vertices[mesh.faces[:, 1]]
    # no less than what fits into 30 bits
    step = max(float(np.median(np.linalg.norm(edges, axis=1))) / _STEPS_PER_EDGE, size * 2e-9)
    scalars = _scalars(mesh)
    numbers = [*np.rint((vertices - middle) / (step or 1.0)).T]
    numbers += [item.levels(mesh.attributes[item.name]) for item in scalars]
    numbers += [mesh.faces.ravel()]
    header = {
        'vertices': len(vertices), 'faces': len(mesh.faces), 'step': step, 'size': size,
        'middle': middle.tolist(), 'scalars': [asdict(item) for item in scalars],
        'colours': colours(np.arange(256), 255.0, Settings().colour_map).tolist(),
        'cameras': [_moved(pose, middle)[:3].ravel().round(6).tolist() for pose in poses],
        'view': _view(mesh, poses, middle)}
    return header, zlib.compress(b''.join(map(_coded, numbers)))


def _coded(values: NDArray[Any]) -> bytes:
    """Return whole numbers as differences, their signs in the lowest bits, byte by byte."""
    steps = np.asarray(np.diff(values.astype(np.int32), prepend=np.int32(0)), np.int32)
    signed = ((steps << 1) ^ (steps >> 31)).astype('<u4')
    return signed.view(np.uint8).reshape(-1, 4).T.tobytes()


def _scalars(mesh: formats.Mesh) -> list[Scalar]:
    """Return what a mesh's vertices carry, on the scales of the PLY files' colours."""
    found = []
    for name, values in mesh.attributes.items():
        finite = values[np.isfinite(values)]
        top = float(np.percentile(finite, ROBUST_MAXIMUM)) if len(finite) else 0.0
        if name == 'likelihood':
            exponent = floor(log10(top)) if top > 0 else 0
            digits = str(exponent).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))
            factor = 10.0 ** -exponent
            unit = f'{f"× 10{digits}" if exponent else "1"} / (px² m)'
            found.append(Scalar(name, unit, factor, 0.0, factor * top))
        elif name == 'sigma':
            found.append(Scalar(name, 'mm', 1e3, 1e3 * top, 0.0))
        elif name == 'confidence':
            found.append(Scalar(name, '', 1.0, 0.0, 1.0))
    return found


def _view(
    mesh: formats.Mesh, poses: Sequence[Pose], middle: NDArray[np.float64]
) -> dict[str, list[float]]:
    """Return from where the page looks first, about which point it turns, and what is up."""
    T_world_camera = good_view(mesh.vertices, mesh.faces, poses, FOCAL, 1 / _ASPECT)
    eye, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
    depth = (mesh.vertices - eye) @ forward
    ahead = depth[depth > 0]
    pivot = eye + (float(np.median(ahead)) if len(ahead) else 1.0) * forward
    return {
        'eye': (eye - middle).tolist(), 'pivot': (pivot - middle).tolist(),
        'forward': forward.tolist(), 'upward': upward(poses).tolist()}


def _moved(T_world_camera: Pose, middle: NDArray[np.float64]) -> Pose:
    """Return a pose relative to the middle of the mesh."""
    moved = T_world_camera.copy()
    moved[:3, 3] -= middle
    return moved
