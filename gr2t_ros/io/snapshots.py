# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: the map as a PLY file with a new name each time."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import time

import numpy as np

from ..core.reconstruction import Reconstruction
from ..core.view_mesh import ViewMesh
from ..errors import Gr2tError, InputError
from .files import Folder
from .ply import write_views, Written

_STEP = 0.2  # s of marching between two looks at whether to go on


@dataclass(frozen=True)
class Snapshot:
    """
    What was saved.

    :param file: the path and the counts
    :param likelihood: least and largest of the vertices, 1 / (px^2 m)
    :param elsewhere: what of the map is in other files, as a sentence
    """

    file: Written
    likelihood: tuple[float, float]
    elsewhere: str = ''

    def __str__(self) -> str:
        """Return the path, ': ' and what the file holds."""
        file = self.file
        stride = f', every {file.stride}th ray' if file.stride > 1 else ''
        return (
            f'{file.path}: {file.vertices} vertices, {file.edges} edges, {file.faces} faces'
            f'{stride}, likelihood {self.likelihood[0]:.3g} to {self.likelihood[1]:.3g} '
            '/ (px^2 m)' + (f'; {self.elsewhere}' if self.elsewhere else ''))


def save_snapshot(
    reconstruction: Reconstruction, folder: Folder,
    interrupted: Callable[[], bool] = lambda: False,
) -> Snapshot:
    """
    March all rays that wait, and write all keyframes' meshes into a new file named after the time.

    Names are never used twice, since viewers keep a mesh by its name.

    :param folder: that gets the file
    :param interrupted: asked all the while; True: leave no file and raise
    :raises InputError: if there is nothing to save yet
    :raises Gr2tError: if the file cannot be written, or the writing was interrupted
    """
    if not reconstruction.keyframes:
        raise InputError('there is nothing to save yet: no frame has been integrated')

    def go_on() -> None:
        if interrupted():
            raise Gr2tError('interrupted: the node was told to stop')

    ranges: list[tuple[float, float]] = []

    def meshes(stride: int) -> Iterator[tuple[int, ViewMesh]]:
        ranges.clear()
        for number, mesh in reconstruction.meshes(stride):
            go_on()
            if len(mesh.vertices):
                likelihood = mesh.vertex_likelihood
                ranges.append((float(likelihood.min()), float(likelihood.max())))
            yield number, mesh

    while reconstruction.finish(_STEP).waiting:
        go_on()
    expected = sum(
        int(np.count_nonzero(keyframe.rays.converged)) for keyframe in reconstruction.keyframes)
    with folder.new_file(time.strftime('mesh_%Y%m%d_%H%M%S'), '.ply') as path:
        file = write_views(
            path, meshes, reconstruction.colouring(), expected_vertices=expected)
    low, high = zip(*ranges) if ranges else ((0.0,), (0.0,))
    return Snapshot(file, (min(low), max(high)))
