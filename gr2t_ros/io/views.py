# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recording's depth images with their poses."""
from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from ..core.view import View
from .bags import Bag
from .frames import FrameAssembler
from .topics import is_static, Sources

# Poses are also read this long before the first image and after the last one, seconds: an image
# lies between two poses, and a recording writes a pose later than an image of the same time.
_BEFORE, _AFTER = 10.0, 1.0


def views(
    bag: Bag, sources: Sources, assembler: FrameAssembler, start: float = 0.0,
    duration: float | None = None,
) -> Iterator[View]:
    """
    Read a recording as views, one at a time, in order; what is dropped the assembler counts.

    :param sources: the topics to use
    :param assembler: a new one
    :param start: seconds of log time from the recording's begin
    :param duration: seconds; None: up to the end
    """
    for topic, message in _messages(bag, sources, start, duration):
        if topic == sources.depth.name:
            assembler.on_depth(message)
        elif topic == sources.camera_info:
            assembler.on_camera_info(message)
        elif topic == sources.poses.topic:
            assembler.on_pose(message)
        else:
            assembler.world.on_transforms(message, static=is_static(topic))
        yield from assembler.ready()
    yield from assembler.flush()


def _messages(
    bag: Bag, sources: Sources, start: float, duration: float | None
) -> Iterator[tuple[str, Any]]:
    transforms = sources.poses.transforms
    static = [topic for topic in transforms if is_static(topic)]
    others = [topic for topic in (sources.poses.topic, sources.camera_info, *transforms) if topic]
    begin = bag.begin_ns + round(start * 1e9)
    end = None if duration is None else begin + round(duration * 1e9)
    parts: list[tuple[Collection[str], int | None, int | None]] = []
    if start > 0:
        early = begin - round(_BEFORE * 1e9)
        parts += [(static, None, early), (others, early, begin)]
        info = bag.first(sources.camera_info)  # it may be published once only
        if info is not None:
            yield sources.camera_info, info
    parts.append(([sources.depth.name, *others], begin, end))
    if end is not None:
        parts.append((others, end, end + round(_AFTER * 1e9)))
    for part in parts:
        for topic, message, _ in bag.messages(*part):
            yield topic, message
