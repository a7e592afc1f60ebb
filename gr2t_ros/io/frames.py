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
from ..core.poses import listed, MAX_DISORDER_NS, NotYet, seconds
from ..core.view import View
from ..errors import FrameError
from ..settings import Settings
from . import messages
from .camera_poses import CameraPoses
from .world import World

_MAX_CAMERAS = 16  # frames of which a camera_info is kept
_TWICE_NS = 250_000_000  # an image that comes twice is older by less; more is a loop
_MAX_SEEN = 20  # images whose stamps are kept to notice it
_MAX_BYTES = 1 << 29  # of the images that wait
_LARGE = 1 << 22  # pixels; smaller images may come a moment before their camera_info
_MAX_STAMP_NS = (1 << 31) * 1_000_000_000  # what ROS's messages can say
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
    Turns the messages of one camera, of a recording or live, into views.

    An image waits until a message has brought its pose and its camera. It is given up when it
    has waited for settings.max_wait_for_pose, when too many wait, or at the end (flush). Every
    image that was read is returned, waiting, or counted in `dropped`.

    Its camera is the latest camera_info of its frame and size, its pose that of its frame in the
    world at its stamp (see CameraPoses). The past of poses reaches back far enough for images to
    come late; should their time jump back, see PoseBuffer. Not safe for use by several threads at
    once. An image that comes twice, with one stamp, is used once.

    read: images read so far. dropped: images that gave no view, by reason. explanations: for each
    reason, and for poses that were left out, the sentence of the first case. world: where the
    views are. waits: seconds from its receipt that each live image took to become a view, for
    whoever empties the list.

    :param settings: of which the input's count
    :param world: shared with other cameras; None: its own
    :param name: of the camera, where there are several
    :param rectified: whether the images are rectified, so that camera_info's P counts, not K and D
    :param max_waiting: images that may wait for their poses
    """

    def __init__(
        self, settings: Settings, world: World | None = None, *, name: str = '',
        rectified: bool, max_waiting: int = 10,
    ) -> None:
        self.read = 0
        self.dropped: Counter[str] = Counter()
        self.explanations: dict[str, str] = {}
        self.waits: list[float] = []
        self.world = world or World(settings)
        self._settings = settings
        self._name = name
        self._rectified = rectified
        self._max_waiting = max_waiting
        self._max_wait_ns = int(settings.max_wait_for_pose * 1e9)
        self._offset_ns = round(settings.time_offset * 1e9)
        self._now_ns = 0
        # of each frame the last two cameras, each with the stamp from which on it holds
        self._cameras: dict[str, list[tuple[int, Camera]]] = {}
        self._bad_cameras: dict[str, FrameError] = {}
        self._camera_frame = ''
        self._poses = CameraPoses(settings, self.world)
        self._masks: dict[int, NDArray[np.bool_]] = {}  # by stamp
        self._newest_ns = 0  # of the views, by the images' clock
        self._older = False  # whether the last image was of another time
        self._seen: dict[tuple[str, int], None] = {}  # frames and stamps of the last images
        self._images: deque[_Image] = deque()
        self._views: list[View] = []

    @property
    def waiting(self) -> int:
        """Return the number of images that wait."""
        return len(self._images)

    def update(self, settings: Settings) -> None:
        """Take parameters that may change: depth_min and depth_max hold from the next image on."""
        self._settings = settings

    def on_camera_info(self, msg: Any) -> None:
        """
        Take a camera_info; where it says something new it holds from its stamp on.

        :param msg: sensor_msgs/CameraInfo
        """
        frame = self._camera_frame = messages.frame_name(msg.header.frame_id)
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

    def on_mask(self, msg: Any) -> None:
        """
        Take a mask: of the image with its stamp, or of all where its stamp is 0.

        :param msg: sensor_msgs/Image, see messages.mask
        """
        try:
            self._masks[messages.stamp_ns(msg.header)] = messages.mask(msg)
        except FrameError as error:
            self._explain(error)
        while len(self._masks) > 2 * self._max_waiting + 2:
            del self._masks[next(stamp for stamp in self._masks if stamp)]

    def on_pose(self, msg: Any) -> None:
        """
        Take a pose message.

        :param msg: the message that settings.pose_source names
        """
        try:
            self._poses.on_pose(msg)
        except FrameError as error:
            self._explain(error)

    def on_depth(self, msg: Any, received_ns: int | None = None) -> None:
        """
        Take a depth image.

        :param msg: sensor_msgs/Image, or sensor_msgs/CompressedImage of compressedDepth
        :param received_ns: now, by any clock; None: it may wait for as long as there is room
        """
        self.read += 1
        self._now_ns = received_ns or 0
        frame, stamp_ns = messages.frame_name(msg.header.frame_id), messages.stamp_ns(msg.header)
        try:
            self._check_stamp(frame, stamp_ns)
            self._check_size(frame, *messages.size(msg))
            depth = self._in_range(messages.depth(msg))
            self._watch_clock(stamp_ns)
        except FrameError as error:
            self._drop(error)
            return
        self._remember(frame, stamp_ns)
        self._images.append(_Image(depth, frame, stamp_ns, received_ns))
        if len(self._images) > self._room:
            self._sort(self._room)

    @property
    def _room(self) -> int:
        """Return how many images may wait: of huge ones fewer."""
        largest = max((image.depth.nbytes for image in self._images), default=1)
        return min(self._max_waiting, max(1, _MAX_BYTES // largest))

    def _check_stamp(self, frame: str, stamp_ns: int) -> None:
        if not 0 <= min(stamp_ns, stamp_ns + self._offset_ns) < _MAX_STAMP_NS:
            raise FrameError(
                'bad_stamp', f'an image has the stamp {seconds(stamp_ns)}, which no clock has: '
                'its driver writes wrong headers')
        # further back than MAX_DISORDER_NS it is a stray, until another one comes
        if any(_TWICE_NS < seen_ns - stamp_ns <= MAX_DISORDER_NS for _, seen_ns in self._seen):
            self._seen.clear()
        if (frame, stamp_ns) in self._seen:
            raise FrameError(
                'duplicate', f'an image of {seconds(stamp_ns)} came a second time: it is used '
                'once; does the topic have two publishers, or the recording a part twice?')

    def _remember(self, frame: str, stamp_ns: int) -> None:
        if stamp_ns:  # 0: of a driver that writes none
            self._seen[frame, stamp_ns] = None
            if len(self._seen) > _MAX_SEEN:
                del self._seen[next(iter(self._seen))]

    def is_of_another_time(self, now_ns: int) -> bool:
        """Tell whether images were taken well after a stamp, so that the clock went back to it."""
        return self._newest_ns > now_ns + MAX_DISORDER_NS

    def forget(self, now_ns: int) -> None:
        """
        Give up on what belongs to another time.

        :param now_ns: the stamp that the clock went back to
        """
        images, self._images = self._images, deque()
        for image in images:
            if image.stamp_ns > now_ns + MAX_DISORDER_NS:
                self._drop(FrameError(
                    'time_jump', 'an image still waited for its pose when the clock went back to '
                    f'{seconds(now_ns)}'))
            else:
                self._images.append(image)
        self._poses.forget(now_ns)
        self._seen.clear()
        self._masks = {stamp: mask for stamp, mask in self._masks.items() if not stamp}
        self._newest_ns, self._older = 0, False

    def _watch_clock(self, stamp_ns: int) -> None:
        """Notice that the clock went back, by two images in a row: one may be a defect."""
        if not self.is_of_another_time(stamp_ns):
            self._older = False
            return
        if not self._older:
            self._older = True
            raise FrameError(
                'time_jump', f'an image is of {seconds(stamp_ns)}, but one of '
                f'{seconds(self._newest_ns)} came before: it is left out; if the next is as old, '
                'the clock went back')
        self.forget(stamp_ns)
        self.world.go_back(stamp_ns)

    def ready(self, now_ns: int | None = None) -> list[View]:
        """
        Return the views of the images that have their poses now, in order of arrival.

        :param now_ns: by the clock of on_depth's received_ns; None: when the last image came
        """
        self._now_ns = now_ns or self._now_ns
        self._sort(self._room)
        views, self._views = self._views, []
        return views

    def flush(self) -> list[View]:
        """Return as `ready` does, and give up on the images that still wait."""
        self._sort(0)
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
                    if image.received_ns is not None:
                        self.waits.append(1e-9 * (self._now_ns - image.received_ns))
                    continue
                except NotYet as error:
                    reason = error
                    if error.reason != 'no_mask':  # others may have theirs
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
        stamp_ns = image.stamp_ns + self._offset_ns
        T_world_camera = self._poses.lookup(frame, stamp_ns)
        camera = self._camera(frame, image)
        depth = self._unmasked(image)
        self._newest_ns = max(self._newest_ns, image.stamp_ns)
        return View(
            depth, camera, np.array(T_world_camera), stamp_ns, self._name, frame)

    def _unmasked(self, image: _Image) -> NDArray[np.float32]:
        """Make the depths that the mask hides invalid."""
        if not self._settings.use_mask:
            return image.depth
        mask = self._masks.get(image.stamp_ns, self._masks.get(0))
        if mask is None:
            raise NotYet(
                'no_mask', f'no mask of the image of {seconds(image.stamp_ns)} came on '
                'depth/mask: publish it with the image\'s stamp, or one for all with stamp 0')
        if mask.shape != image.depth.shape:
            height, width = image.depth.shape
            raise FrameError(
                'mask_size', f'the mask is {mask.shape[1]}x{mask.shape[0]} pixels, but the depth '
                f'image {width}x{height}: make masks of the depth camera\'s images')
        image.depth[mask] = np.nan
        if np.isnan(image.depth).all():
            raise FrameError('no_valid_depth', 'the mask hides all valid depths of the image')
        return image.depth

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
        fitting = self._fitting(known, *image.depth.shape)
        since = [camera for since_ns, camera in fitting if since_ns <= image.stamp_ns]
        return since[-1] if since else fitting[0][1]

    def _check_size(self, frame: str, height: int, width: int) -> None:
        """Refuse a large image of another size than its camera before it costs memory."""
        frame = frame or self._camera_frame
        known = self._cameras.get(frame) or self._cameras.get('')
        if known and height * width > _LARGE:
            self._fitting(known, height, width)

    def _fitting(
        self, known: list[tuple[int, Camera]], height: int, width: int
    ) -> list[tuple[int, Camera]]:
        fitting = [item for item in known if (item[1].height, item[1].width) == (height, width)]
        if not fitting:
            camera = known[-1][1]
            raise FrameError(
                'image_size', f'depth image is {width}x{height} pixels, but its camera_info is '
                f'for {camera.width}x{camera.height}: choose the camera_info of these images')
        return fitting

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
