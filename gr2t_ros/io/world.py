# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The frame that the map is built in, and the transforms that lead to it."""
from __future__ import annotations

from typing import Any

import numpy as np

from ..core.poses import HISTORY, listed, NotYet, plain, Pose, seconds, TransformTree
from ..errors import FrameError
from ..settings import Settings
from . import messages
from .jumps import JumpWatch


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
        self._watched: dict[str, JumpWatch] = {}  # of frames between the world and a camera

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
            if not static and item.child in self._watched:
                self._look_for_jump(item)

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

    def watch(self, camera_frame: str) -> None:
        """Notice from now on where a transform between the world and a camera jumps."""
        for frame in self.tree.moving(self.frame, camera_frame):
            self._watched.setdefault(frame, JumpWatch())

    def _look_for_jump(self, item: messages.StampedPose) -> None:
        jump = self._watched[item.child].add(item.stamp_ns, item.T_parent_child)
        if jump is not None:
            self.explain_jump(
                jump, f'frame {item.child}', item.parent, item.stamp_ns,
                f'set world_frame to {item.child}, which does not jump'
                if len(self._watched) > 1 else '')

    def explain_jump(
        self, jump: tuple[float, float], what: str, parent: str, stamp_ns: int, way_out: str = ''
    ) -> None:
        """
        Say what jumped, once.

        :param jump: of JumpWatch
        :param way_out: what to do about it; '': take other poses
        """
        way_out = way_out or 'take the poses of an odometry that does not jump, where there is one'
        self.explanations.setdefault('world_jump', (
            f'{what} jumped by {jump[0]:.2f} m and {np.degrees(jump[1]):.1f} degrees in '
            f'{parent or "the world"} about {seconds(stamp_ns)}, as where SLAM corrects itself: '
            f'what is in the map stays where it was, and surfaces may stand twice; {way_out}'))

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
