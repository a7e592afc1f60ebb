# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: the map as a PLY file with a new name each time."""
from __future__ import annotations

from pathlib import Path
import time

import numpy as np

from ..core.reconstruction import Reconstruction
from ..errors import InputError
from .ply import write_views, Written


def save_snapshot(reconstruction: Reconstruction, directory: str, colour_map: str) -> Written:
    """
    Write all keyframes' meshes into a new file, named after the time.

    Names are never used twice, since viewers keep a mesh by its name.

    :param directory: made when needed; ~ is the home
    :param colour_map: one of the choices of Settings.colour_map
    :raises InputError: if there is nothing to save yet
    :raises Gr2tError: if the file cannot be written
    """
    if not reconstruction.keyframes:
        raise InputError('there is nothing to save yet: no frame has been integrated')
    path = new_path(Path(directory).expanduser())
    expected = sum(
        int(np.count_nonzero(keyframe.rays.converged)) for keyframe in reconstruction.keyframes)
    return write_views(
        path, reconstruction.meshes, reconstruction.colour_scale(), colour_map,
        expected_vertices=expected)


def new_path(directory: Path) -> Path:
    """Return a name that is not in use: mesh_YEARMONTHDAY_HOURMINUTESECOND.ply."""
    stem = time.strftime('mesh_%Y%m%d_%H%M%S')
    path = directory / f'{stem}.ply'
    number = 1
    while path.exists():
        number += 1
        path = directory / f'{stem}_{number}.ply'
    return path
