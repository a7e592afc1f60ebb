# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""An assembler of frames, and what it is given."""
from __future__ import annotations

from messages_for_tests import camera_info, image, tf, transform
import numpy as np
from scipy.spatial.transform import Rotation

from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.settings import Settings

MS = 1_000_000
S = 1_000_000_000
DEPTH = np.full((6, 8), 1500, np.uint16)


def at(x, turn=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, turn, 0]).as_matrix()
    T[0, 3] = x
    return T


def assembler(max_waiting=10, rectified=False, info=True, **settings):
    frames = FrameAssembler(
        Settings(**settings), rectified=rectified, max_waiting=max_waiting)
    if info:
        frames.on_camera_info(camera_info())
    return frames


def move(frames, *stamps_ns, parent='map', child='camera', x=1.0, static=False):
    for stamp_ns in stamps_ns:
        frames.world.on_transforms(
            tf(transform(parent, child, stamp_ns, at(x * stamp_ns / S))), static)


def depth(stamp_ns, pixels=DEPTH, **fields):
    return image(pixels, stamp_ns=stamp_ns, **fields)


def settled(frames, seen=0):
    """Return the last views; with those seen before all images must be accounted for."""
    views = frames.ready() + frames.flush()
    assert frames.waiting == 0
    assert frames.read == seen + len(views) + sum(frames.dropped.values())
    return views


def lost(frames, reason, count=1, seen=0):
    """Expect images to be dropped for one reason, and return its sentence."""
    settled(frames, seen)
    assert dict(frames.dropped) == {reason: count}
    return frames.explanations[reason]
