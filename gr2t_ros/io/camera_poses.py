# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where a camera was at a stamp: by tf, or by pose messages."""
from __future__ import annotations

from typing import Any

from ..core.poses import HISTORY, MAX_DISORDER_NS, NotYet, Pose, PoseBuffer, seconds
from ..errors import FrameError
from ..settings import Settings
from . import messages
from .jumps import JumpWatch
from .world import World


class CameraPoses:
    """
    Poses of one camera in the world.

    They come from where settings.pose_source says. Pose messages give the camera's pose, or where
    they have a child_frame_id other than the camera's frame, that frame's, and tf leads on to the
    camera's.

    Where no world frame is set it is that of the pose messages, or the root of the tf tree above
    the camera at the first stamp that has a pose, provided that something moves between the two.

    :param settings: parameters
    :param world: shared by all cameras
    """

    def __init__(self, settings: Settings, world: World) -> None:
        self._source = settings.pose_source
        self._world = world
        self._history = HISTORY + settings.max_wait_for_pose
        self._frames = ('', '')  # of the messages: parent, child
        self._poses = PoseBuffer(f'the {self._source} message', self._history)
        self._watch = JumpWatch()

    def on_pose(self, msg: Any) -> None:
        """
        Take a pose message; one that holds no pose says that none is known at its stamp.

        :param msg: the message that settings.pose_source names
        :raises FrameError: if it holds no pose
        """
        error = None
        try:
            item = messages.pose(msg, self._source)
        except FrameError as found:
            error = found
            item = messages.unknown_pose(msg)
        if (item.parent, item.child) != self._frames:
            self._frames = (item.parent, item.child)
            self._poses = PoseBuffer(self._poses.name, self._history)
            self._watch = JumpWatch()
        self._poses.add(item.stamp_ns, item.T_parent_child)
        if jump := self._watch.add(item.stamp_ns, item.T_parent_child):
            self._world.explain_jump(
                jump, f'the pose of {item.child or "the camera"} in the {self._source} messages',
                item.parent, item.stamp_ns)
        if error:
            raise error

    def forget(self, now_ns: int) -> None:
        """
        Forget poses of another time.

        :param now_ns: the stamp that the clock went back to
        """
        if len(self._poses) and self._poses.newest_ns > now_ns + MAX_DISORDER_NS:
            self._poses = PoseBuffer(self._poses.name, self._history)

    def lookup(self, frame: str, stamp_ns: int) -> Pose:
        """
        Return T_world_camera.

        :param frame: the camera's; '' if its messages do not say
        :param stamp_ns: nanoseconds
        :raises NotYet: if a later message may bring it
        :raises FrameError: if no message can
        """
        if self._source == 'tf':
            return self._by_tf(frame, stamp_ns)
        return self._by_message(frame, stamp_ns)

    def _by_tf(self, frame: str, stamp_ns: int) -> Pose:
        if not frame:
            raise FrameError(
                'no_frame_id', 'neither the depth images nor their camera_info have a frame_id: '
                'set it in the camera\'s driver, or use a pose topic')
        tree = self._world.tree
        world = self._world.frame or tree.root(frame)
        if not self._world.frame and not tree.moves(frame):
            if frame in tree.frames():
                why = (f'its transforms up to {world} are all static; publish the camera\'s pose, '
                       f'or set world_frame to {world} if the camera stands still')
            else:
                known = self._world.frames()
                why = f'tf knows {known or "no frame yet"}; publish the camera\'s pose'
            raise NotYet('unconnected_frames', f'no pose of the camera frame {frame} at '
                         f'{seconds(stamp_ns)}: {why}')
        root = tree.root(frame)
        hint = ' or set world_frame' + (
            f' to {root}, the root above {frame}' if root != frame else '')
        T_world_camera = self._world.transform(world, frame, stamp_ns, hint)
        self._world.frame = world
        self._world.watch(frame)
        return T_world_camera

    def _by_message(self, frame: str, stamp_ns: int) -> Pose:
        T_parent_child = self._poses.lookup(stamp_ns)
        parent, child = self._frames
        world = self._world.frame or parent
        if not world:
            raise FrameError(
                'no_world_frame', 'the pose messages have no frame_id: set world_frame')
        T_world_camera = T_parent_child
        if child and frame and child != frame:
            hint = f': the {self._source} messages are of {child}'
            T_child_camera = self._world.transform(child, frame, stamp_ns, hint)
            T_world_camera = T_world_camera @ T_child_camera
        if parent and parent != world:
            T_world_parent = self._world.transform(
                world, parent, stamp_ns, ' or set world_frame')
            T_world_camera = T_world_parent @ T_world_camera
        self._world.frame = world
        return T_world_camera
