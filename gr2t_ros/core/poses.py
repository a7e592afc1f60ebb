# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Poses in time: interpolation between stamped poses, and a tree of them as tf publishes it."""
from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError

Pose = NDArray[np.float64]

# Stamps rounded to a millisecond still find their pose: the nearest is held, which moves a camera
# at 1 m/s by 1 mm. Further out a pose would be invented.
EXTRAPOLATION_NS = 1_000_000
# Between poses further apart than this a moving camera may have been anywhere; one that has the
# same pose at both ends (to 1 mm and 1 mrad) stood still.
MAX_GAP_NS = 1_000_000_000
_STILL = 1e-3
# Messages of one transform come out of order by less (publishers stamp up to 1 s ahead); more is
# a clock that went back.
MAX_DISORDER_NS = 2_000_000_000
HISTORY = 30.0  # seconds
MAX_SAMPLES = 100_000  # of one transform; 25 MB
_MAX_FRAMES = 10_000  # of a tree: a publisher that names each anew must not fill the memory
_NAMES_SHOWN = 12


class TransformError(FrameError):
    """There is no pose at a stamp, and waiting does not bring it."""


class NotYet(FrameError):
    """There is no pose at a stamp yet: a later message may bring it."""


def interpolate(T_a: Pose, T_b: Pose, fraction: float) -> Pose:
    """
    Move from one pose to another: linearly, and at constant speed about one axis (slerp).

    :param T_a: (4, 4) float64; likewise T_b. Rotations of less than 1e-5 rad are left out.
    :param fraction: 0 gives T_a, 1 gives T_b
    :return: (4, 4) float64
    """
    R_a = T_a[:3, :3]
    turn, _ = cv2.Rodrigues(R_a.T @ T_b[:3, :3])
    T = np.eye(4)
    T[:3, :3] = R_a @ cv2.Rodrigues(fraction * turn)[0]
    T[:3, 3] = T_a[:3, 3] + fraction * (T_b[:3, 3] - T_a[:3, 3])
    return T


def inverse(T: Pose) -> Pose:
    """
    Invert a rigid transform.

    :param T: (4, 4) float64
    """
    T_inverse = np.eye(4)
    T_inverse[:3, :3] = T[:3, :3].T
    T_inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return T_inverse


def _frozen(T: Pose) -> Pose:
    T = np.array(T, np.float64)
    T.flags.writeable = False
    return T


def plain(frame: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 wrote."""
    return frame.lstrip('/')


class PoseBuffer:
    """
    Stamped poses of one thing, of the last seconds.

    Poses may come out of order; of two with one stamp the later counts. After a jump back in time
    (two poses in a row that are more than MAX_DISORDER_NS older than the newest) the history
    starts anew; a single one so old is left out. A pose of NaN says that the pose is not known at
    its stamp, so that none is interpolated up to the next.

    :param name: of the poses, for errors: 'the transform from a to b'
    :param history: seconds before the newest pose that are kept at least
    :param max_samples: poses kept at most
    """

    def __init__(
        self, name: str, history: float = HISTORY, max_samples: int = MAX_SAMPLES
    ) -> None:
        self.name = name
        self._history_ns = int(history * 1e9)
        self._max_samples = max_samples
        self._stamps: list[int] = []
        self._poses: list[Pose] = []
        self._stray: tuple[int, Pose] | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int:
        """Return the newest pose's stamp, nanoseconds; there must be one."""
        return self._stamps[-1]

    def add(self, stamp_ns: int, T: Pose) -> None:
        """
        Add a pose.

        :param stamp_ns: nanoseconds
        :param T: (4, 4) float64
        """
        stamps, poses = self._stamps, self._poses
        T = _frozen(T)
        if stamps and stamp_ns < stamps[-1] - MAX_DISORDER_NS:
            if self._stray is None:
                self._stray = (stamp_ns, T)
                return
            stamps.clear()
            poses.clear()
            self._insert(*self._stray)
        self._stray = None
        self._insert(stamp_ns, T)
        # a quarter at a time, so that adding stays cheap
        quarter = len(stamps) // 4
        if len(stamps) > self._max_samples or stamps[quarter] < stamps[-1] - self._history_ns:
            del stamps[:quarter]
            del poses[:quarter]

    def _insert(self, stamp_ns: int, T: Pose) -> None:
        stamps, poses = self._stamps, self._poses
        if not stamps or stamp_ns > stamps[-1]:
            stamps.append(stamp_ns)
            poses.append(T)
            return
        i = bisect_left(stamps, stamp_ns)
        if stamps[i] == stamp_ns:
            poses[i] = T
        else:
            stamps.insert(i, stamp_ns)
            poses.insert(i, T)

    def lookup(self, stamp_ns: int) -> Pose:
        """
        Return the pose at a stamp.

        :param stamp_ns: nanoseconds
        :return: (4, 4) float64, not to be written to
        :raises NotYet: if the stamp is newer than the newest pose
        :raises TransformError: if it is older than the oldest, in a gap, or the pose is NaN
        """
        stamps, poses = self._stamps, self._poses
        i = bisect_left(stamps, stamp_ns)
        if i == len(stamps):
            if not stamps:
                raise NotYet('no_pose', f'{self.name} has not been received yet')
            if stamp_ns - stamps[-1] > EXTRAPOLATION_NS:
                raise NotYet('no_pose', f'{self.name} is needed at {seconds(stamp_ns)}, but the '
                             f'newest received is of {seconds(stamps[-1])}')
            T = poses[-1]
        elif stamps[i] == stamp_ns:
            T = poses[i]
        elif i == 0:
            if stamps[0] - stamp_ns > EXTRAPOLATION_NS:
                raise TransformError(
                    'pose_too_old', f'{self.name} is needed at {seconds(stamp_ns)}, but the '
                    f'oldest known is of {seconds(stamps[0])}')
            T = poses[0]
        else:
            T = self._between(stamp_ns, i)
        if not np.isfinite(T).all():
            raise TransformError(
                'bad_pose', f'{self.name} at {seconds(stamp_ns)} is no pose: it was sent with '
                'numbers that are not finite, or with a quaternion that is not of length 1')
        return T

    def _between(self, stamp_ns: int, i: int) -> Pose:
        begin_ns, end_ns = self._stamps[i - 1:i + 1]
        T_begin, T_end = self._poses[i - 1:i + 1]
        step = T_end - T_begin
        if not np.isfinite(step).all():
            return step
        if end_ns - begin_ns > MAX_GAP_NS and np.abs(step).max() > _STILL:
            raise TransformError(
                'pose_gap', f'{self.name} is needed at {seconds(stamp_ns)}, but between '
                f'{seconds(begin_ns)} and {seconds(end_ns)} none was received, and it moved')
        return interpolate(T_begin, T_end, (stamp_ns - begin_ns) / (end_ns - begin_ns))


class _Link:
    """What leads from a frame to its parent: a pose that never changes, or a buffer of them."""

    def __init__(self, parent: str, poses: Pose | PoseBuffer) -> None:
        self.parent = parent
        self.poses = poses

    def lookup(self, stamp_ns: int) -> Pose:
        return self.poses.lookup(stamp_ns) if isinstance(self.poses, PoseBuffer) else self.poses


class TransformTree:
    """
    The tree of frames that tf messages describe, with its recent past.

    Each frame has one parent. A transform from another parent, or one that is static where the
    former was not (or the reverse), replaces the former with its history. The frames' names are
    taken without leading slashes. Not safe for use by several threads at once.

    :param history: seconds, see PoseBuffer
    :param max_samples: poses kept of one transform, at most
    """

    def __init__(self, history: float = HISTORY, max_samples: int = MAX_SAMPLES) -> None:
        self._history = history
        self._max_samples = max_samples
        self._links: dict[str, _Link] = {}

    def add(
        self, parent: str, child: str, stamp_ns: int, T_parent_child: Pose, static: bool = False
    ) -> None:
        """
        Add a transform.

        :param parent: frame; likewise child
        :param stamp_ns: nanoseconds; a static transform holds at all times
        :param T_parent_child: (4, 4) float64, metres; NaN: not known at this stamp
        :raises TransformError: if a frame has no name, or the tree would become a loop
        """
        parent, child = plain(parent), plain(child)
        link = self._links.get(child)
        if link is None or link.parent != parent:
            self._check(parent, child)
        if static:
            if not np.isfinite(T_parent_child).all():
                raise TransformError(
                    'bad_transform', f'the static transform from {child} to {parent} is left '
                    'out: its numbers are not finite, or its quaternion is not of length 1')
            self._links[child] = _Link(parent, _frozen(T_parent_child))
            return
        former = ''
        if link and isinstance(link.poses, PoseBuffer):
            if link.parent == parent:
                link.poses.add(stamp_ns, T_parent_child)
                return
            if 0 < link.poses.newest_ns - stamp_ns < MAX_DISORDER_NS:
                return  # a late message from the former parent
            former = f' (it led to {link.parent} until {seconds(stamp_ns)})'
        poses = PoseBuffer(
            f'the transform from {child} to {parent}{former}', self._history, self._max_samples)
        poses.add(stamp_ns, T_parent_child)
        self._links[child] = _Link(parent, poses)

    def _check(self, parent: str, child: str) -> None:
        if not parent or not child:
            raise TransformError(
                'bad_transform', f'a transform from frame {child!r} to frame {parent!r} is left '
                'out: both need a name')
        if child not in self._links and len(self._links) >= _MAX_FRAMES:
            raise TransformError(
                'bad_transform', f'the transform from {child} to {parent} is left out: there are '
                f'{_MAX_FRAMES} others; a publisher names its frames anew each time')
        chain = self._chain(parent)
        if child in chain:
            loop = ' -> '.join([child, *chain[:chain.index(child) + 1]])
            raise TransformError(
                'transform_loop', f'the transform from {child} to {parent} is left out: it '
                f'closes a loop ({loop}); stop one of its publishers')

    def lookup(self, target: str, source: str, stamp_ns: int) -> Pose:
        """
        Return the transform that maps coordinates of one frame to another.

        :param target: frame; likewise source
        :param stamp_ns: nanoseconds
        :return: (4, 4) float64 T_target_source, not to be written to
        :raises NotYet: if the frames are not connected, or the stamp is newer than a transform
        :raises TransformError: see PoseBuffer.lookup
        """
        target, source = plain(target), plain(source)
        up_source, up_target = self._chain(source), self._chain(target)
        if up_source[-1] != up_target[-1]:
            why = self._why_unconnected(target, source)
            raise NotYet(
                'unconnected_frames',
                f'no transform from {source} to {target} at {seconds(stamp_ns)}: {why}')
        # what both have in common cancels out
        while len(up_source) > 1 and len(up_target) > 1 and up_source[-2] == up_target[-2]:
            up_source.pop()
            up_target.pop()
        T_common_source = self._product(up_source[:-1], stamp_ns)
        if len(up_target) == 1:
            return T_common_source
        return inverse(self._product(up_target[:-1], stamp_ns)) @ T_common_source

    def frames(self) -> list[str]:
        """Return the names of all frames, sorted; any thread may ask."""
        links = self._links.copy()
        return sorted(links.keys() | {link.parent for link in links.values()})

    def root(self, frame: str) -> str:
        """Return the frame's highest ancestor; itself where it has no parent or is unknown."""
        return self._chain(plain(frame))[-1]

    def moves(self, frame: str) -> bool:
        """Return whether a transform on the way from the frame to its root can change."""
        return any(isinstance(self._links[name].poses, PoseBuffer)
                   for name in self._chain(plain(frame))[:-1])

    def moving(self, target: str, source: str) -> list[str]:
        """Return the frames between two whose transform to their parent can change, from below."""
        up, down = self._chain(plain(source)), self._chain(plain(target))
        return [frame for frame in [*(name for name in up if name not in down),
                                    *(name for name in down if name not in up)]
                if frame in self._links and isinstance(self._links[frame].poses, PoseBuffer)]

    def forget(self, now_ns: int) -> None:
        """
        Forget transforms of another time, as the clock went back; static ones, sent once, stay.

        :param now_ns: the stamp that the clock went back to; what fits it stays
        """
        self._links = {child: link for child, link in self._links.items()
                       if not isinstance(link.poses, PoseBuffer)
                       or link.poses.newest_ns <= now_ns + MAX_DISORDER_NS}

    def _chain(self, frame: str) -> list[str]:
        """Return the frame and its ancestors up to the root."""
        chain = [frame]
        while link := self._links.get(chain[-1]):
            chain.append(link.parent)
        return chain

    def _product(self, chain: list[str], stamp_ns: int) -> Pose:
        T = np.eye(4)
        for i, frame in enumerate(chain):
            T_parent_frame = self._links[frame].lookup(stamp_ns)
            T = T_parent_frame @ T if i else T_parent_frame
        return T

    def _why_unconnected(self, target: str, source: str) -> str:
        known = self.frames()
        if not known:
            return 'no tf message has been received'
        unknown = [frame for frame in (source, target) if frame not in known]
        if unknown:
            return f'tf does not know {" and ".join(unknown)}, only {listed(known)}'
        parts = [listed(frame for frame in known if self.root(frame) == self.root(end))
                 for end in (source, target)]
        return f'tf is in separate parts, one of {parts[0]}, the other of {parts[1]}'


def step(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Return how far two poses are apart, metres and radians."""
    cosine = (np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(T_b[:3, 3] - T_a[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))


def seconds(stamp_ns: int) -> str:
    """Return a stamp as text."""
    return f'{stamp_ns * 1e-9:.3f} s'


def listed(frames: Iterable[str]) -> str:
    """Return frames' names as text, not too many of them."""
    names = sorted(frames)
    more = len(names) - _NAMES_SHOWN
    return ', '.join(names[:_NAMES_SHOWN]) + (f' and {more} more' if more > 0 else '')
