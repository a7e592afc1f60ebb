# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages to views: each depth image finds its camera and its pose."""
from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.camera import Camera
from ..core.poses import (
    HISTORY,
    listed,
    NotYet,
    plain,
    Pose,
    PoseBuffer,
    seconds,
    TransformTree,
)
from ..core.view import View
from ..errors import FrameError
from ..settings import Settings
from . import messages

_MAX_CAMERAS = 16  # frames of which a camera_info is kept
# Medians beyond these are no scene, but millimetres taken for metres or the reverse.
_TOO_FAR, _TOO_NEAR = 100.0, 0.01  # metres


@dataclass
class _Image:
    depth: NDArray[np.float32]
    frame: str
    stamp_ns: int
    received_ns: int | None


class FrameAssembler:
    """
    Turns the messages of a recording or of live topics into views.

    An image waits until a message has brought its pose and its camera. It is given up when it
    has waited for settings.max_wait_for_pose, when too many wait, or at the end (flush). Every
    image that was read is returned, waiting, or counted in `dropped`.

    Its camera is the latest camera_info of its frame and size. Its pose is that of its frame in
    the world frame at its stamp: from tf, or from the pose messages that settings.pose_source
    names. Those give the camera's pose, or where they have a child_frame_id other than the
    image's frame, that frame's, and tf leads on to the image's. The past of tf reaches back far
    enough for images to come late; should its time jump back, see PoseBuffer. Not safe for use
    by several threads at once.

    Where no world_frame is set it is that of the pose messages, or the root of the tf tree above
    the camera at the first image that has a pose, provided that something moves between the two.

    read: images read so far. dropped: images that gave no view, by reason. explanations: for each
    reason, and for transforms that were left out, the sentence of the first case. tree: the frames
    known to tf. world_frame: the frame of the views' poses; '' until it is known.

    :param settings: of which the input's count
    :param rectified: whether the images are rectified, so that camera_info's P counts, not K and D
    :param max_waiting: images that may wait for their poses
    """

    def __init__(self, settings: Settings, *, rectified: bool, max_waiting: int = 10) -> None:
        history = HISTORY + settings.max_wait_for_pose
        self.read = 0
        self.dropped: Counter[str] = Counter()
        self.explanations: dict[str, str] = {}
        self.tree = TransformTree(history)
        self.world_frame = plain(settings.world_frame)
        self._settings = settings
        self._rectified = rectified
        self._max_waiting = max_waiting
        self._max_wait_ns = int(settings.max_wait_for_pose * 1e9)
        self._history = history
        self._now_ns = 0
        # of each frame the last two cameras, each with the stamp from which on it holds
        self._cameras: dict[str, list[tuple[int, Camera]]] = {}
        self._bad_cameras: dict[str, FrameError] = {}
        self._camera_frame = ''
        self._pose_frames = ('', '')
        self._poses = PoseBuffer(f'the {settings.pose_source} message', history)
        self._images: deque[_Image] = deque()
        self._views: list[View] = []

    @property
    def waiting(self) -> int:
        """Return the number of images that wait."""
        return len(self._images)

    def on_camera_info(self, msg: Any) -> None:
        """
        Take a camera_info; where it says something new it holds from its stamp on.

        :param msg: sensor_msgs/CameraInfo
        """
        frame = self._camera_frame = plain(msg.header.frame_id)
        self._bad_cameras.pop(frame, None)
        known = self._cameras.pop(frame, [])
        try:
            camera = messages.camera(msg, rectified=self._rectified)
        except FrameError as error:
            self._bad_cameras[frame] = error
            known = []
        else:
            # the same object while nothing changes: it keeps its rays
            if not known or known[-1][1] != camera:
                known = [*known[-1:], (messages.stamp_ns(msg.header), camera)]
        self._cameras[frame] = known
        if len(self._cameras) > _MAX_CAMERAS:
            oldest = next(iter(self._cameras))
            del self._cameras[oldest]
            self._bad_cameras.pop(oldest, None)

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
                self._explain(error)

    def on_pose(self, msg: Any) -> None:
        """
        Take a pose message.

        :param msg: the message that settings.pose_source names
        """
        try:
            item = messages.pose(msg, self._settings.pose_source)
        except FrameError as error:
            self._explain(error)
            item = messages.unknown_pose(msg)
        if (item.parent, item.child) != self._pose_frames:
            self._pose_frames = (item.parent, item.child)
            self._poses = PoseBuffer(self._poses.name, self._history)
        self._poses.add(item.stamp_ns, item.T_parent_child)

    def on_depth(self, msg: Any, received_ns: int | None = None) -> None:
        """
        Take a depth image.

        :param msg: sensor_msgs/Image, or sensor_msgs/CompressedImage of compressedDepth
        :param received_ns: now, by any clock; None: it may wait for as long as there is room
        """
        self.read += 1
        self._now_ns = received_ns or 0
        try:
            depth = self._in_range(messages.depth(msg))
        except FrameError as error:
            self._drop(error)
            return
        frame, stamp_ns = plain(msg.header.frame_id), messages.stamp_ns(msg.header)
        self._images.append(_Image(depth, frame, stamp_ns, received_ns))
        if len(self._images) > self._max_waiting:
            self._sort(room=self._max_waiting)

    def ready(self, now_ns: int | None = None) -> list[View]:
        """
        Return the views of the images that have their poses now, in order of arrival.

        :param now_ns: by the clock of on_depth's received_ns; None: when the last image came
        """
        self._now_ns = now_ns or self._now_ns
        self._sort(room=self._max_waiting)
        views, self._views = self._views, []
        return views

    def flush(self) -> list[View]:
        """Return as `ready` does, and give up on the images that still wait."""
        self._sort(room=0)
        return self.ready()

    def _sort(self, room: int) -> None:
        """Make views of the images that have all they need, and give up on the oldest others."""
        images, self._images = self._images, deque()
        # an image that has no pose yet speaks for those of its frame with later stamps
        refused: dict[str, tuple[int, NotYet]] = {}
        for i, image in enumerate(images):
            stamp_ns, reason = refused.get(image.frame, (0, None))
            if reason is None or image.stamp_ns < stamp_ns:
                try:
                    self._views.append(self._view(image))
                    continue
                except NotYet as error:
                    reason = error
                    refused[image.frame] = (image.stamp_ns, error)
                except FrameError as error:
                    self._drop(error)
                    continue
            received_ns = image.received_ns
            if received_ns is not None and self._now_ns - received_ns > self._max_wait_ns:
                why = f'after max_wait_for_pose ({self._settings.max_wait_for_pose:g} s)'
            elif len(self._images) + len(images) - i > room:
                why = f'with {room} later images waiting' if room else 'at the end'
            else:
                self._images.append(image)
                continue
            self._drop(FrameError(reason.reason, f'{reason} (given up {why})'))

    def _view(self, image: _Image) -> View:
        frame = image.frame or self._camera_frame
        if self._settings.pose_source == 'tf':
            T_world_camera = self._pose_by_tf(frame, image.stamp_ns)
        else:
            T_world_camera = self._pose_by_message(frame, image.stamp_ns)
        camera = self._camera(frame, image)
        return View(image.depth, camera, np.array(T_world_camera), image.stamp_ns)

    def _camera(self, frame: str, image: _Image) -> Camera:
        frame = frame if frame in self._cameras else ''
        if frame in self._bad_cameras:
            raise FrameError(self._bad_cameras[frame].reason, str(self._bad_cameras[frame]))
        if frame not in self._cameras:
            raise NotYet('no_camera_info', (
                f'the depth images are of frame {image.frame}, but camera_info only of '
                f'{listed(self._cameras)}: choose the camera_info of these images'
            ) if self._cameras else (
                'no camera_info has been received: choose its topic, or start its publisher'))
        known = self._cameras[frame]
        height, width = image.depth.shape
        fitting = [item for item in known if (item[1].height, item[1].width) == (height, width)]
        if not fitting:
            camera = known[-1][1]
            raise FrameError(
                'image_size', f'depth image is {width}x{height} pixels, but its camera_info is '
                f'for {camera.width}x{camera.height}: choose the camera_info of these images')
        since = [camera for since_ns, camera in fitting if since_ns <= image.stamp_ns]
        return since[-1] if since else fitting[0][1]

    def _pose_by_tf(self, frame: str, stamp_ns: int) -> Pose:
        """Return T_world_camera."""
        if not frame:
            raise FrameError(
                'no_frame_id', 'neither the depth images nor their camera_info have a frame_id: '
                'set it in the camera\'s driver, or use a pose topic')
        world = self.world_frame or self.tree.root(frame)
        if not self.world_frame and not self.tree.moves(frame):
            known = self.tree.frames()
            if frame in known:
                why = (f'its transforms up to {world} are all static; publish the camera\'s pose, '
                       f'or set world_frame to {world} if the camera stands still')
            else:
                why = f'tf knows {listed(known) or "no frame yet"}; publish the camera\'s pose'
            raise NotYet('unconnected_frames', f'no pose of the camera frame {frame} at '
                         f'{seconds(stamp_ns)}: {why}')
        T_world_camera = self._transform(world, frame, stamp_ns, ' or set world_frame')
        self.world_frame = world
        return T_world_camera

    def _pose_by_message(self, frame: str, stamp_ns: int) -> Pose:
        """Return T_world_camera."""
        T_parent_child = self._poses.lookup(stamp_ns)
        parent, child = self._pose_frames
        world = self.world_frame or parent
        if not world:
            raise FrameError(
                'no_world_frame', 'the pose messages have no frame_id: set world_frame')
        T_world_camera = T_parent_child
        if child and frame and child != frame:
            hint = f': the {self._settings.pose_source} messages are of {child}'
            T_world_camera = T_world_camera @ self._transform(child, frame, stamp_ns, hint)
        if parent and parent != world:
            T_world_parent = self._transform(world, parent, stamp_ns, ' or set world_frame')
            T_world_camera = T_world_parent @ T_world_camera
        self.world_frame = world
        return T_world_camera

    def _transform(self, target: str, source: str, stamp_ns: int, hint: str) -> Pose:
        try:
            return self.tree.lookup(target, source, stamp_ns)
        except NotYet as error:
            if error.reason != 'unconnected_frames':
                raise
            raise NotYet(error.reason, f'{error}; publish it{hint}') from None

    def _in_range(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Make depths outside depth_min and depth_max invalid, in place."""
        low, high = self._settings.depth_min, self._settings.depth_max
        inside = (depth >= low) & (depth <= high)
        if inside.any():
            depth[~inside] = np.nan
            return depth
        valid = depth[~np.isnan(depth)]
        if not len(valid):
            raise FrameError('no_valid_depth', 'depth image has no valid pixel')
        median = float(np.median(valid))
        if _TOO_NEAR < median < _TOO_FAR:
            raise FrameError(
                'no_valid_depth', f'no depth of the image lies within depth_min {low:g} m and '
                f'depth_max {high:g} m; their median is {median:.3g} m')
        raise FrameError(
            'depth_unit', f'the depths have a median of {median:.3g} m, as if their unit were '
            'taken wrongly: 16UC1 and mono16 images must be in millimetres, 32FC1 in metres')

    def _drop(self, error: FrameError) -> None:
        self.dropped[error.reason] += 1
        self._explain(error)

    def _explain(self, error: FrameError) -> None:
        self.explanations.setdefault(error.reason, str(error))
