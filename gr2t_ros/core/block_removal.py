# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Blocks that leave the lattice, in place; what rays see of those that stay does not change."""
from __future__ import annotations

import mmap

from numba import njit, uint64
import numpy as np
from numpy.typing import NDArray

from .blocks import Blocks, COEFFICIENTS, first_slot, Floats, slot_of, VOXELS
from .compiled import uncounted
from .vector import ROW

_SELF = 13  # of the 27 neighbours


def without(
    blocks: Blocks, watched: NDArray[np.bool_], since: int
) -> tuple[Blocks, NDArray[np.int32], NDArray[np.int32]]:
    """
    Remove the blocks that no ray needs and that no recent view touched.

    :param blocks: just refreshed
    :param watched: (size,) the blocks that rays' search intervals need; those about them that
        their spline depends on stay, too
    :param since: blocks touched after this change stay
    :return: the lattice; for each former block its number now, (size,) int32, 0: removed; (n,)
        int32, the blocks beside removed ones, whose coefficients are to be computed again
    """
    size = blocks.size
    needed = np.zeros(size, np.bool_)
    _mark_needed(blocks.neighbour, watched, np.zeros(size, np.bool_), needed)
    needed |= blocks.touched[:size] > since
    renumbered = np.zeros(size, np.int32)
    beside = np.zeros(size, np.bool_)
    end = int(_remove(blocks, size, needed, renumbered, beside))
    blocks.key[end:size] = -1
    blocks.neighbour[end:size] = 0
    blocks.touched[end:size] = 0
    blocks.filtered[end:size] = 0
    for values, each in (
            (blocks.value, VOXELS), (blocks.expected, VOXELS), (blocks.coefficient, COEFFICIENTS)):
        values[end * each:size * each] = 0
        _give_back(values, end * each, size * each)
    border = renumbered[beside]
    return blocks._replace(size=end), renumbered, np.sort(border[border > 0])


@njit(cache=True, nogil=True)
def _mark_needed(
    neighbour: NDArray[np.int32], watched: NDArray[np.bool_], asked: NDArray[np.bool_],
    needed: NDArray[np.bool_],
) -> None:
    """Mark what a spline asks, in and beyond a block, and whose values that is made of."""
    for block in range(1, len(watched)):
        if watched[block]:
            for n in range(8):
                asked[neighbour[block, _SELF + n // 4 * 9 + n // 2 % 2 * 3 + n % 2]] = True
    for block in range(1, len(asked)):
        if asked[block]:
            for n in range(27):
                needed[neighbour[block, n]] = True


@uncounted()
def _remove(
    blocks: Blocks, size: int, needed: NDArray[np.bool_], renumbered: NDArray[np.int32],
    beside: NDArray[np.bool_],
) -> int:
    """
    Fill the places of those that go with the last ones; return the number of blocks.

    :param beside: where to mark the neighbours of those that go
    """
    for block in range(1, size):
        if not needed[block]:
            _erase(blocks.table_key, blocks.table_block, blocks.key[block])
            for n in range(27):
                other = blocks.neighbour[block, n]
                blocks.neighbour[other, 26 - n] = 0
                beside[other] = True
            # its first coefficients stood behind the rows of the block before it, see copy_margins
            rows = blocks.neighbour[block, _SELF - 1] * COEFFICIENTS + 8
            for line in range(64):
                for x in range(3):
                    blocks.coefficient[rows + line * ROW + x] = 0
    block, end = 1, size
    while block < end:
        if not needed[block]:
            end -= 1
            while end > block and not needed[end]:
                end -= 1
            if end == block:
                break
            _move(blocks, end, block)
            renumbered[end] = block
        else:
            renumbered[block] = block
        block += 1
    return end


@uncounted()
def _erase(
    table_key: NDArray[np.int64], table_block: NDArray[np.int32], key: np.int64
) -> None:
    """Remove a key from the hash: those behind it that it pushed away move up."""
    mask = uint64(len(table_key) - 1)
    hole = uint64(slot_of(table_key, table_block, key))
    slot = (hole + uint64(1)) & mask
    while table_block[slot] != 0:
        home = first_slot(table_key, table_key[slot])
        if ((slot - home) & mask) >= ((slot - hole) & mask):
            table_key[hole], table_block[hole] = table_key[slot], table_block[slot]
            hole = slot
        slot = (slot + uint64(1)) & mask
    table_block[hole] = 0


@uncounted()
def _move(blocks: Blocks, source: int, target: int) -> None:
    """Put a block where there is none now."""
    key = blocks.key[source]
    blocks.table_block[slot_of(blocks.table_key, blocks.table_block, key)] = target
    blocks.key[target] = key
    blocks.touched[target] = blocks.touched[source]
    blocks.filtered[target] = blocks.filtered[source]
    for n in range(27):
        other = blocks.neighbour[source, n]
        blocks.neighbour[target, n] = other
        if other != 0:
            blocks.neighbour[other, 26 - n] = target
    blocks.neighbour[target, _SELF] = target
    for n in range(VOXELS):
        blocks.value[target * VOXELS + n] = blocks.value[source * VOXELS + n]
        blocks.expected[target * VOXELS + n] = blocks.expected[source * VOXELS + n]
    for n in range(COEFFICIENTS):
        blocks.coefficient[target * COEFFICIENTS + n] = (
            blocks.coefficient[source * COEFFICIENTS + n])


def _give_back(values: Floats, begin: int, end: int) -> None:
    """Return the pages between two places, which hold zeros, to the system."""
    pages = values.base
    if isinstance(pages, memoryview):
        pages = pages.obj
    if not (isinstance(pages, mmap.mmap) and hasattr(mmap, 'MADV_DONTNEED')):
        return
    first = -(-4 * begin // mmap.PAGESIZE) * mmap.PAGESIZE
    length = 4 * end // mmap.PAGESIZE * mmap.PAGESIZE - first
    if length > 0:
        pages.madvise(mmap.MADV_DONTNEED, first, length)
