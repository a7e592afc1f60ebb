# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Small parts of a surface, which are mostly noise."""
from __future__ import annotations

from numba import int64, njit
import numpy as np
from numpy.typing import NDArray

from .fused_surface import Surface, used


def without_islands(whole: Surface, fewest: int) -> Surface:
    """
    Return a surface without its small parts, but for those that may go on in other blocks.

    :param fewest: triangles of a part that stays
    """
    part = _parts(len(whole.vertices), whole.faces)
    size = np.bincount(part[whole.faces[:, 0]], minlength=len(part))
    size[part[whole.outside]] = fewest
    return used(whole._replace(faces=whole.faces[size[part[whole.faces[:, 0]]] >= fewest]))


@njit(cache=True, nogil=True)
def _parts(count: int, faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return for each vertex one that stands for all that it is connected with."""
    parent = np.arange(count)
    for n in range(len(faces)):
        a, b, c = int64(faces[n, 0]), int64(faces[n, 1]), int64(faces[n, 2])
        for other in (b, c):
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[other] != other:
                parent[other] = parent[parent[other]]
                other = parent[other]
            parent[max(a, other)] = min(a, other)
            a = min(a, other)
    for n in range(count):
        parent[n] = parent[parent[n]]  # smaller ones are done
    return parent
