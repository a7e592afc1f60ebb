# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compressed depth images to pixels: PNG and RVL. Nothing here trusts the data."""
from __future__ import annotations

import struct
from typing import Any

import cv2
from numba import njit
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError

MAX_PIXELS = 1 << 25  # of an image; 134 MB as float32, four times the largest depth camera

_PNG = b'\x89PNG\r\n\x1a\n'
_PNG_CHUNK = struct.Struct('>I4s')  # length of the content, name; a checksum follows
_PNG_HEADER = struct.Struct('>8xIIBB')  # the first chunk: width, height, bits, colour type
_RVL_SIZE = struct.Struct('<II')  # columns, rows
HEAD = len(_PNG) + _PNG_HEADER.size  # bytes that tell the size


def size(head: bytes, *, rvl: bool) -> tuple[int, int]:
    """
    Return an image's height and width, pixels, as its data say; (0, 0): they do not.

    :param head: the first HEAD bytes
    :param rvl: whether it is RVL, not PNG
    """
    width = height = 0
    if rvl and len(head) >= _RVL_SIZE.size:
        width, height = _RVL_SIZE.unpack_from(head)
    elif not rvl and head.startswith(_PNG) and len(head) >= HEAD:
        width, height, _, _ = _PNG_HEADER.unpack_from(head, len(_PNG))
    return height, width


def check_size(height: int, width: int) -> None:
    """
    Refuse sizes that no depth image has.

    :raises FrameError: if it is so
    """
    if height <= 0 or width <= 0 or height * width > MAX_PIXELS:
        raise FrameError(
            'image_size', f'depth image is {width}x{height} pixels; from 1 to {MAX_PIXELS} are '
            'taken')


def damaged(what: str) -> FrameError:
    """Return the error of an image whose data cannot be decompressed."""
    return FrameError('damaged_image', f'compressed depth image is damaged: {what}')


def png(data: bytes) -> NDArray[np.uint16]:
    """
    Decode a PNG.

    :return: (h, w) uint16
    :raises FrameError: if it is damaged, or not of 16 bits of grey
    """
    if not data.startswith(_PNG):
        raise damaged('its data are no PNG')
    chunks = _png_chunks(data)
    if not chunks[0].startswith(b'IHDR', 4) or len(chunks[0]) < _PNG_HEADER.size:
        raise damaged('its PNG has no header')
    width, height, bits, colour = _PNG_HEADER.unpack_from(chunks[0])
    check_size(height, width)
    if (bits, colour) != (16, 0):
        raise damaged(f'its PNG has {bits} bits and colour type {colour}, not 16 bits of grey')
    clean = np.frombuffer(_PNG + b''.join(chunks), np.uint8)
    try:
        image: Any = cv2.imdecode(clean, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint16 or image.shape != (height, width):
        raise damaged('its PNG cannot be decoded')
    return np.asarray(image)


def _png_chunks(data: bytes) -> list[bytes]:
    """
    Return those chunks of a PNG that the image needs; the last is IEND.

    OpenCV believes a damaged length and takes gigabytes; the other chunks only add to what can
    go wrong in it.
    """
    chunks = []
    at, name = len(_PNG), b''
    while name != b'IEND':
        end = at + _PNG_CHUNK.size
        if end <= len(data):
            length, name = _PNG_CHUNK.unpack_from(data, at)
            end += length + 4
        if end > len(data):
            raise damaged('its PNG is cut off')
        if name in (b'IHDR', b'IDAT', b'IEND'):
            chunks.append(data[at:end])
        at = end
    return chunks


def rvl(data: bytes) -> NDArray[np.uint16]:
    """
    Decode RVL, see _decode_rvl.

    :return: (h, w) uint16
    :raises FrameError: if it is damaged
    """
    if len(data) < _RVL_SIZE.size:
        raise damaged(f'{len(data)} bytes of RVL')
    width, height = _RVL_SIZE.unpack_from(data)
    check_size(height, width)
    words = np.array(np.frombuffer(data, '<u4', len(data) // 4 - 2, 8), np.uint32)
    pixels = np.zeros(height * width, np.uint16)
    if not _decode_rvl(words, pixels):
        raise damaged(f'its RVL does not make {width}x{height} pixels')
    return pixels.reshape(height, width)


@njit(cache=True, nogil=True)
def _decode_rvl(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """
    Decode RVL (Wilson, Fast Lossless Depth Image Compression, 2017).

    Runs of zeros and of others take turns; each other is the zigzag-coded difference to the one
    before. Numbers are groups of three bits, the lowest first, in nibbles whose top bit says that
    more follow; nibbles fill 32-bit words from the top.

    :param words: (n,) uint32
    :param pixels: (m,) uint16, zero, filled
    :return: whether the words made exactly m pixels
    """
    nibbles = 8 * len(words)
    at = 0  # nibble
    filled = 0
    left = 0  # others left in this run
    previous = 0
    zeros_next = True
    while filled < len(pixels) or left != 0:
        value = 0
        shift = 0
        more = True
        while more:
            if at == nibbles or shift > 30:
                return False
            nibble = (int(words[at >> 3]) >> (28 - 4 * (at & 7))) & 15
            at += 1
            value |= (nibble & 7) << shift
            shift += 3
            more = nibble & 8 != 0
        if left > 0:
            previous = (previous + ((value >> 1) ^ -(value & 1))) & 0xffff
            pixels[filled] = previous
            filled += 1
            left -= 1
        else:
            if value > len(pixels) - filled:
                return False
            if zeros_next:
                filled += value
            else:
                left = value
            zeros_next = not zeros_next
    return True
