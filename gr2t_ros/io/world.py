# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The frame that the map is built in, and the transforms that lead to it."""
from __future__ import annotations

from typing import Any

from ..core.poses import HISTORY, listed, NotYet, plain, Pose, TransformTree
from ..errors import FrameError
from ..settings import Settings
from . import messages


class World:
    """
    What all cameras share. Not safe for use by several threads at once, but for `frames`.

    frame: of the views' poses; '' until it is known. tree: the transforms of tf. explanations: for
    each reason for which a transform was left out, the sentence of the first case. went_back: the
    stamps that the clock went back to, nanoseconds.

    :param settings: of which world_frame and max_wait_for_pose count
    """

    def __init__(self, settings: Settings) -> None:
        self.frame = plain(settings.world_frame)
        self.tree = TransformTree(HISTORY + settings.max_wait_for_pose)
        self.explanations: dict[str, str] = {}
        self.went_back: list[int] = []

    def on_transforms(self, msg: Any, static: bool) -> None:
        """
        Take a tf message.

        :param msg: tf2_msgs/TFMessage
        :param static: whether it came on /tf_static
        """
        for item in messages.transforms(msg):
            try:
                self.tree.add(*item, static)
            except FrameError as error:
                self.explanations.setdefault(error.reason, str(error))

    def go_back(self, now_ns: int) -> None:
        """
        Forget the transforms of another time.

        :param now_ns: the stamp that the clock went back to
        """
        self.tree.forget(now_ns)
        self.went_back.append(now_ns)

    def frames(self) -> str:
        """Return the frames that tf knows, as text."""
        return listed(self.tree.frames())

    def transform(self, target: str, source: str, stamp_ns: int, hint: str) -> Pose:
        """
        Return T_target_source by tf.

        :param hint: what to do where the frames are not connected, after 'publish it'
        :raises FrameError: see TransformTree.lookup
        """
        try:
            return self.tree.lookup(target, source, stamp_ns)
        except NotYet as error:
            if error.reason != 'unconnected_frames':
                raise
            raise NotYet(error.reason, f'{error}; publish it{hint}') from None
