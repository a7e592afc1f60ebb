# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Camera poses in the TUM format, a line each: timestamp tx ty tz qx qy qz qw."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from .files import whole_file

Pose = NDArray[np.float64]

_WORST_QUATERNION = 0.05  # a length that differs more from 1 is a mistake, not rounding


def read(path: Path) -> tuple[list[int], list[Pose]]:
    """
    Read camera poses.

    :return: stamps in nanoseconds; (4, 4) T_world_camera each (optical frame)
    :raises InputError: naming the file and the line that cannot be used
    """
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'cannot read the trajectory {path}: {error}') from error
    stamps: list[int] = []
    poses: list[Pose] = []
    for number, line in enumerate(lines, 1):
        words = line.partition('#')[0].split()
        if not words:
            continue
        try:
            stamp, x, y, z, *quaternion = (float(word) for word in words)
        except ValueError:
            quaternion = []
        length = float(np.linalg.norm(quaternion))
        if (len(quaternion) != 4 or not np.isfinite((stamp, x, y, z)).all()
                or not abs(length - 1.0) < _WORST_QUATERNION):
            raise InputError(
                f'{path}, line {number}: not "timestamp tx ty tz qx qy qz qw" with a unit '
                'quaternion')
        stamps.append(round(stamp * 1e9))
        if stamps[-1] < 0 or (len(stamps) > 1 and stamps[-1] < stamps[-2]):
            raise InputError(f'{path}, line {number}: timestamps must be positive and increase')
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        T_world_camera[:3, 3] = x, y, z
        poses.append(T_world_camera)
    if not poses:
        raise InputError(f'{path} has no poses')
    return stamps, poses


def write(path: Path, poses: Iterable[tuple[int, Pose]]) -> None:
    """
    Write camera poses in the order of their stamps.

    :param poses: (stamp in nanoseconds, (4, 4) T_world_camera of the optical frame) each
    :raises Gr2tError: if the file cannot be written
    """
    lines = ['# timestamp tx ty tz qx qy qz qw: s, m, the camera\'s optical frame in the world']
    for stamp_ns, T_world_camera in sorted(poses, key=lambda item: item[0]):
        numbers = *T_world_camera[:3, 3], *Rotation.from_matrix(T_world_camera[:3, :3]).as_quat()
        seconds = f'{stamp_ns // 10 ** 9}.{stamp_ns % 10 ** 9:09d}'
        lines.append(' '.join([seconds, *(f'{number:.9f}' for number in numbers)]))
    with whole_file(path) as stream:
        stream.write('\n'.join([*lines, '']).encode())
