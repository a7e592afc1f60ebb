# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Large marker messages as the bytes that go over the wire (CDR, little endian).

A Python object for each of a mesh's points costs a second per hundred thousand triangles; these
bytes take milliseconds, and a publisher sends them as they are.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import struct

import numpy as np
from numpy.typing import NDArray

_ADD, _DELETE, _DELETE_ALL = 0, 2, 3
_LINE_LIST, _TRIANGLE_LIST = 5, 11
_ENCAPSULATION = b'\x00\x01\x00\x00'


@dataclass(frozen=True, eq=False)
class Marker:
    """
    Triangles or lines as visualization_msgs/Marker draws them: without indices.

    :param id: the marker that it replaces; without points that marker is deleted
    :param points: (n, 3) float64, metres, three a triangle, two a line
    :param colours: (n, 3) uint8, red green blue
    :param width: of lines, metres; None: triangles
    """

    id: int
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    width: float | None = None


def marker_array(frame_id: str, namespace: str, items: Sequence[Marker]) -> bytes:
    """Return the MarkerArray that replaces or deletes each of the markers."""
    message = _Message()
    message.numbers('<I', len(items))
    for item in items:
        _marker(message, frame_id, namespace, item, _ADD if len(item.points) else _DELETE)
    return message.whole()


def no_markers(frame_id: str, namespace: str) -> bytes:
    """Return the MarkerArray that deletes all markers."""
    message = _Message()
    message.numbers('<I', 1)
    nothing = Marker(0, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    _marker(message, frame_id, namespace, nothing, _DELETE_ALL)
    return message.whole()


def _marker(
    message: _Message, frame_id: str, namespace: str, item: Marker, action: int
) -> None:
    # without a stamp, and locked to its frame, a viewer draws it where that frame is now
    message.numbers('<iI', 0, 0)
    message.text(frame_id)
    message.text(namespace)
    message.numbers(
        '<iii', item.id, _TRIANGLE_LIST if item.width is None else _LINE_LIST, action)
    message.numbers('<7d', 0, 0, 0, 0, 0, 0, 1)  # pose
    message.numbers('<3d', 1 if item.width is None else item.width, 1, 1)  # scale
    message.numbers('<4f', 0, 0, 0, 1)  # colour: its alpha multiplies those below
    message.numbers('<iI', 0, 0)  # lifetime: for ever
    message.numbers('<?', True)  # frame_locked
    message.numbers('<I', len(item.points))
    message.array(item.points, '<f8')
    message.numbers('<I', len(item.colours))
    rgba = np.ones((len(item.colours), 4), np.float32)
    rgba[:, :3] = item.colours / np.float32(255.0)
    message.array(rgba, '<f4')
    message.text('')  # texture_resource
    message.numbers('<iI', 0, 0)  # texture: header, format, data
    message.text('')
    message.text('')
    message.numbers('<I', 0)
    message.numbers('<I', 0)  # uv_coordinates
    message.text('')  # text
    message.text('')  # mesh_resource
    message.text('')  # mesh_file: filename, data
    message.numbers('<I', 0)
    message.numbers('<?', False)  # mesh_use_embedded_materials


class _Message:
    """CDR: each number is aligned to its own size, counted from behind the encapsulation."""

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = [_ENCAPSULATION]
        self._size = 0

    def numbers(self, types: str, *values: float) -> None:
        """
        Append numbers.

        :param types: as struct has them, all of one size
        """
        self._align(struct.calcsize(f'={types[-1]}'))
        self._append(struct.pack(types, *values))

    def text(self, text: str) -> None:
        data = text.encode() + b'\x00'
        self.numbers('<I', len(data))
        self._append(data)

    def array(self, values: NDArray[np.float64] | NDArray[np.float32], dtype: str) -> None:
        """Append numbers without their count."""
        if values.size:
            flat = np.ascontiguousarray(values, dtype).reshape(-1)
            self._align(flat.itemsize)
            self._append(flat.view(np.uint8).data)

    def whole(self) -> bytes:
        return b''.join(self._parts)

    def _align(self, size: int) -> None:
        self._append(bytes(-self._size % size))

    def _append(self, data: bytes | memoryview) -> None:
        self._parts.append(data)
        self._size += len(data)
