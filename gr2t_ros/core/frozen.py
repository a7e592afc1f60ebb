# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A density as it is at a moment, for another thread to ask while views go on to change the original.

Fresh memory costs ten times what it takes to copy into memory that is there. So whoever wants the
copy makes room for it, in its own thread, and the original is held up for the copying only.
"""
from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .blocks import Blocks
from .ray_march import Density
from .voxel_density import VoxelDensity

Room = dict[str, NDArray[Any]]

# fields of Blocks that answer questions; `value` and `touched` are for adding views
ASKING = ('table_key', 'table_block', 'key', 'expected', 'coefficient', 'neighbour', 'filtered')
_MARGIN = 1.1  # for the blocks that come before the copy is made


def room_for(density: Density, fields: Sequence[str] = ASKING) -> Room:
    """Return memory for a frozen copy; any thread may ask."""
    if not isinstance(density, VoxelDensity):
        return {}
    return {
        name: np.ones((int(_MARGIN * len(used)), *used.shape[1:]), used.dtype)
        for name, used in _used(density.blocks, fields).items()}


def frozen(density: Density, room: Room, fields: Sequence[str] = ASKING) -> Density:
    """
    Return a density that answers as this one does now, and to which no view can be added.

    :param density: just refreshed
    :param room: of room_for; what does not fit gets memory of its own
    :param fields: of Blocks that the copy has; others than ASKING: it answers nothing
    """
    twin = copy(density)
    if isinstance(density, VoxelDensity) and isinstance(twin, VoxelDensity):
        kept: dict[str, Any] = {
            name: getattr(density.blocks, name)[:0] for name in Blocks._fields
            if name not in ('size', *fields)}
        for name, used in _used(density.blocks, fields).items():
            kept[name] = room.get(name, used[:0])[:len(used)]
            if len(kept[name]) < len(used):
                kept[name] = np.empty_like(used)
            np.copyto(kept[name], used)
        twin.blocks = density.blocks._replace(**kept)
        twin._stale = []  # the list is the original's, which goes on
    return twin  # the exact one only ever appends to its arrays


def _used(blocks: Blocks, fields: Sequence[str]) -> Room:
    """Return the parts of the lattice's arrays that are in use."""
    capacity = len(blocks.key)
    arrays = {name: getattr(blocks, name) for name in fields}
    return {
        name: array if name.startswith('table') else array[:len(array) // capacity * blocks.size]
        for name, array in arrays.items()}
