# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: the map's fused mesh as a PLY file with a new name each time."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import time

from ..core.reconstruction import Reconstruction
from ..errors import Gr2tError, InputError
from .files import Folder
from .ply import write_fused, Written

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
        return (
            f'{file.path}: {file.vertices} vertices, {file.faces} faces, '
            f'likelihood {self.likelihood[0]:.3g} to {self.likelihood[1]:.3g} / (px^2 m)'
            + (f'; {self.elsewhere}' if self.elsewhere else ''))


def save_snapshot(
    reconstruction: Reconstruction, folder: Folder,
    interrupted: Callable[[], bool] = lambda: False,
) -> Snapshot:
    """
    March all rays that wait, and write the fused mesh into a new file named after the time.

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

    while reconstruction.finish(_STEP).waiting:
        go_on()
    reconstruction.fuse()
    go_on()
    mesh = reconstruction.fused_mesh()
    go_on()
    with folder.new_file(time.strftime('mesh_%Y%m%d_%H%M%S'), '.ply') as path:
        file = write_fused(path, mesh, reconstruction.colouring())
    likelihood = mesh.vertex_likelihood
    if not len(likelihood):
        return Snapshot(file, (0.0, 0.0))
    return Snapshot(file, (float(likelihood.min()), float(likelihood.max())))
