# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parts of a map that no longer fit into memory, finished, on the disk."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time

from ..core.colour import Colouring
from ..core.view_mesh import ViewMesh
from ..errors import Gr2tError
from .ply import write_view

_NAME = 'view_{:06d}.ply'


class Parts:
    """
    Writes the meshes of keyframes that leave memory, each as a PLY file: a sink of Reconstruction.

    directory: where they are, None before the first. keyframes, vertices, edges, faces: written.

    :param make_directory: called before the first part; returns the folder
    """

    def __init__(self, make_directory: Callable[[], Path]) -> None:
        self._make_directory = make_directory
        self.directory: Path | None = None
        self.keyframes = self.vertices = self.edges = self.faces = 0

    def __call__(self, number: int, mesh: ViewMesh, colouring: Colouring) -> None:
        """
        Write a keyframe's mesh; the file is whole and on the disk when this returns.

        :raises Gr2tError: if it cannot be written
        """
        if self.directory is None:
            try:
                self.directory = self._make_directory()
            except OSError as error:
                raise Gr2tError(
                    f'cannot make the folder {error.filename}: {error.strerror}') from error
        written = write_view(self.directory / _NAME.format(number), number, mesh, colouring)
        self.keyframes += 1
        self.vertices += written.vertices
        self.edges += written.edges
        self.faces += written.faces

    def __str__(self) -> str:
        """Return what was written, and where; '' before the first."""
        if not self.keyframes:
            return ''
        return (
            f'{self.keyframes} keyframes that left memory are in {self.directory}: '
            f'{self.vertices} vertices, {self.edges} edges, {self.faces} faces')


def new_directory(parent: Path) -> Path:
    """Make a folder that nobody else has, parts_YEARMONTHDAY_HOURMINUTESECOND."""
    stem = time.strftime('parts_%Y%m%d_%H%M%S')
    number = 1
    while True:
        path = parent / (stem if number == 1 else f'{stem}_{number}')
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            if not path.is_dir():
                raise
            number += 1


def emptied(directory: Path) -> Path:
    """Make a folder, or remove the parts of a former map from it."""
    directory.mkdir(parents=True, exist_ok=True)
    for path in directory.glob(_NAME.replace('{:06d}', '*')):
        path.unlink()
    return directory
