# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a recording hold the depth images, their camera and its poses."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import difflib
from typing import Any

from ..errors import InputError
from .bag_files import Topic
from .bags import Bag

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage')
POSES = {  # message type -> Settings.pose_source
    'geometry_msgs/msg/PoseStamped': 'pose',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'pose_with_covariance',
    'nav_msgs/msg/Odometry': 'odometry',
    'geometry_msgs/msg/TransformStamped': 'transform',
}

_COMPRESSED = '/compressedDepth'
_SETTLED_NS = 5_000_000_000  # log time after which a tree has its root
_ENCODINGS = ('16UC1', 'mono16', '32FC1')


@dataclass(frozen=True)
class DepthTopic:
    """
    The topic of the depth images.

    :param compressed: whether it is image_transport's compressedDepth
    :param rectified: whether its images are: the last part of the name (of the raw topic) holds
        'rect', as ROS's drivers and image_proc name them; then camera_info's P counts, not K and D
    :param frame: frame_id of its first image, without a leading slash
    """

    name: str
    compressed: bool
    rectified: bool
    frame: str

    @property
    def base(self) -> str:
        """Return the name of the topic that was compressed."""
        return _base(self.name)


@dataclass(frozen=True)
class PoseTopics:
    """
    Where the poses are.

    :param source: as Settings.pose_source
    :param topic: the pose messages' topic; empty where tf is the source
    :param transforms: topics of tf messages, static ones included: of use with a pose topic too
    :param world_frame: the root above the camera, where tf is the source and none was asked for
    """

    source: str
    topic: str
    transforms: tuple[str, ...]
    world_frame: str = ''


@dataclass(frozen=True)
class Sources:
    """All that a reconstruction reads from a recording."""

    depth: DepthTopic
    camera_info: str
    poses: PoseTopics


def choose(
    bag: Bag, *, depth: str = '', camera_info: str = '', pose: str = '', pose_source: str = 'tf',
    world_frame: str = '',
) -> Sources:
    """
    Choose the topics; those that are given are not guessed.

    :param pose_source: see choose_poses, as for world_frame
    :raises InputError: where there are none, or several: with the options to choose among them
    """
    depth_topic = choose_depth(bag, depth)
    return Sources(
        depth=depth_topic,
        camera_info=choose_camera_info(bag, depth_topic, camera_info),
        poses=choose_poses(
            bag, depth_topic.frame, pose, pose_source=pose_source, world_frame=world_frame))


def choose_depth(bag: Bag, given: str = '') -> DepthTopic:
    """
    Choose the depth topic: the only one that is named so and holds depth.

    :raises InputError: see choose
    """
    if given:
        return _depth_topic(bag, _given(bag, given, (IMAGE, COMPRESSED_IMAGE), '--depth-topic'))
    images = [topic for topic in _of(bag, (IMAGE, COMPRESSED_IMAGE)) if _may_be_depth(topic)]
    named = [topic for topic in images if 'depth' in topic.name.lower()]
    depth = [topic for topic in named if _encoding(bag, topic) in _ENCODINGS]
    names = {topic.name for topic in depth}
    depth = [topic for topic in depth
             if topic.types != (COMPRESSED_IMAGE,) or _base(topic.name) not in names]
    if len(depth) == 1:
        return _depth_topic(bag, depth[0])
    if depth:
        raise InputError(_options(
            f'{bag.name} holds several depth topics', '--depth-topic', depth))
    other = [topic for topic in images
             if topic not in named and _encoding(bag, topic) in _ENCODINGS]
    if other:
        raise InputError(_options(
            f'{bag.name} holds no topic named depth; if one of its images is depth',
            '--depth-topic', other))
    if named:
        raise InputError(
            f'{bag.name} holds no depth images: {named[0].name} has the encoding '
            f'{_encoding(bag, named[0])!r}; {", ".join(_ENCODINGS)} can be used')
    raise InputError(
        f'{bag.name} holds no depth images (sensor_msgs/Image or compressedDepth); record the '
        'depth topic too. ' + _contents(bag))


def choose_camera_info(bag: Bag, depth: DepthTopic, given: str = '') -> str:
    """
    Choose the camera_info: the depth topic's sibling, or else the only one.

    :raises InputError: see choose
    """
    if given:
        return _given(bag, given, (CAMERA_INFO,), '--camera-info-topic').name
    infos = {topic.name: topic for topic in _of(bag, (CAMERA_INFO,))}
    sibling = f'{depth.base.rpartition("/")[0]}/camera_info'
    for name in (sibling, f'{depth.base}/camera_info'):  # image_transport's way, and ZED's
        if name in infos:
            return name
    if len(infos) == 1:
        return next(iter(infos))
    if infos:
        raise InputError(_options(
            f'{bag.name} holds no {sibling}, but several others', '--camera-info-topic',
            infos.values()))
    raise InputError(
        f'{bag.name} holds no camera_info for {depth.name}; record {sibling} too')


def choose_poses(
    bag: Bag, frame: str, given: str = '', *, pose_source: str = 'tf', world_frame: str = '',
) -> PoseTopics:
    """
    Choose the poses: tf where it moves the camera, or else the only pose topic.

    :param frame: the depth images' frame
    :param given: a topic of poses, or of tf messages
    :param pose_source: another than tf: only topics of that kind
    :param world_frame: empty: the root above the camera, with a /tf message on the way
    :raises InputError: see choose
    """
    transforms = _transform_topics(bag)
    candidates = _of(bag, [kind for kind, source in POSES.items()
                           if pose_source in ('tf', source)])
    if given:
        topic = _given(bag, given, (*POSES, *TRANSFORMS), '--pose-topic')
        if topic.types[0] in TRANSFORMS:
            return PoseTopics('tf', '', transforms)
        return _pose_topic(topic, transforms)
    tree = _Frames(bag, transforms, frame, world_frame)
    if pose_source == 'tf' and (tree.moving or (tree.linked and not candidates)):
        return PoseTopics('tf', '', transforms, world_frame or tree.chain(frame)[-1])
    if len(candidates) == 1:
        return _pose_topic(candidates[0], transforms)
    if candidates:
        raise InputError(_options(
            f'{bag.name} holds several pose topics, and tf does not move {frame!r}',
            '--pose-topic', candidates))
    if pose_source != 'tf':
        raise InputError(f'{bag.name} holds no poses of the kind pose_source:={pose_source}')
    raise InputError(
        f'{bag.name} holds no poses of the camera (frame {frame}): {tree.complaint()}')


class _Frames:
    """
    What a recording's tf says of one frame: read until the frame is seen to move.

    And a little further, since what the highest frame holds may be published late.
    """

    def __init__(self, bag: Bag, topics: Sequence[str], frame: str, world_frame: str) -> None:
        self.frame = frame
        self.world_frame = world_frame.lstrip('/')
        self.parents: dict[str, str] = {}
        self.dynamic: dict[str, tuple[float, ...]] = {}  # child -> its first transform
        self.moved: set[str] = set()
        enough_ns = bag.begin_ns + _SETTLED_NS
        for topic, message, log_ns in bag.messages(topics):
            for item in message.transforms:
                self._add(item, is_static(topic))
            if log_ns > enough_ns and self.moving:
                break

    def _add(self, item: Any, static: bool) -> None:
        child, parent = item.child_frame_id.lstrip('/'), item.header.frame_id.lstrip('/')
        if child == parent:
            return
        if not static:
            pose = _numbers(item.transform)
            first = self.dynamic.setdefault(child, pose)
            if self.parents.get(child, parent) != parent or first != pose:
                self.moved.add(child)
        self.parents[child] = parent

    def chain(self, frame: str) -> list[str]:
        """Return a frame and those above it."""
        found = [frame]
        while (parent := self.parents.get(found[-1])) is not None and parent not in found:
            found.append(parent)
        return found

    @property
    def linked(self) -> bool:
        """Return whether tf leads to the world frame, or without one through a /tf message."""
        above = self.chain(self.frame)
        if self.world_frame:
            return self.world_frame in above or above[-1] in self.chain(self.world_frame)
        return any(frame in self.dynamic for frame in above)

    @property
    def moving(self) -> bool:
        """Return whether the frame is linked and moves."""
        if not self.linked:
            return False
        return any(frame in self.moved for frame in (
            *self.chain(self.frame), *(self.chain(self.world_frame) if self.world_frame else ())))

    def complaint(self) -> str:
        """Return why there is no pose, and what to do."""
        above = self.chain(self.frame)
        if not self.parents:
            return 'record /tf and /tf_static, or a pose topic, too'
        if self.world_frame:
            return (f'tf does not connect {self.frame!r} with the world frame '
                    f'{self.world_frame!r}; known are {", ".join(self._names())}')
        if len(above) == 1:
            return (f'tf does not know {self.frame!r}, the frame of the depth images, but '
                    f'{", ".join(self._names())}; record the transforms to it, in /tf_static too')
        return (f'tf leads from {self.frame!r} to {above[-1]!r} by static transforms only, so '
                'the camera never moves; record what localises it too, or for a fixed camera '
                f'give --world-frame {above[-1]}')

    def _names(self) -> list[str]:
        names = sorted({*self.parents, *self.parents.values()})
        return [*names[:8], '...'] if len(names) > 8 else names


def _numbers(transform: Any) -> tuple[float, ...]:
    # messages of two files are of two classes, and never equal
    place, turn = transform.translation, transform.rotation
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def is_static(topic: str) -> bool:
    """Return whether a topic of tf messages holds static ones."""
    return topic.rpartition('/')[2] == 'tf_static'


def _transform_topics(bag: Bag) -> tuple[str, ...]:
    names = [topic.name for topic in _of(bag, TRANSFORMS)]
    # where robots have namespaces the plain names are the common tree
    plain = [name for name in names if name.lstrip('/') in ('tf', 'tf_static')]
    return tuple(plain if any(not is_static(name) for name in plain) else names)


def _pose_topic(topic: Topic, transforms: tuple[str, ...]) -> PoseTopics:
    return PoseTopics(POSES[topic.types[0]], topic.name, transforms)


def _depth_topic(bag: Bag, topic: Topic) -> DepthTopic:
    first = bag.first(topic.name)
    if first is None:
        raise InputError(f'no message on {topic.name} can be read')
    return DepthTopic(
        name=topic.name, compressed=topic.types == (COMPRESSED_IMAGE,),
        rectified='rect' in _base(topic.name).rpartition('/')[2],
        frame=first.header.frame_id.lstrip('/'))


def _base(name: str) -> str:
    return name.removesuffix(_COMPRESSED)


def _may_be_depth(topic: Topic) -> bool:
    return topic.types == (IMAGE,) or topic.name.endswith(_COMPRESSED)


def _encoding(bag: Bag, topic: Topic) -> str:
    first = bag.first(topic.name)
    if topic.types == (IMAGE,):
        return getattr(first, 'encoding', '')
    return str(getattr(first, 'format', '')).partition(';')[0].strip()


def _of(bag: Bag, kinds: Iterable[str]) -> list[Topic]:
    return [topic for topic in bag.topics.values()
            if topic.count and set(topic.types) <= set(kinds)]


def _given(bag: Bag, name: str, kinds: Sequence[str], option: str) -> Topic:
    """Return the topic that the user named."""
    topic = bag.topics.get(name) or bag.topics.get(f'/{name}')
    if topic is not None and topic.count and set(topic.types) <= set(kinds):
        return topic
    fit = _of(bag, kinds)
    near = difflib.get_close_matches(name, [item.name for item in fit], n=1)
    fit = [item for item in fit if item.name in near] or fit
    if topic is None:
        problem = f'{bag.name} holds no topic {name}'
    elif not topic.count:
        problem = f'{bag.name} holds no message on {name}'
    else:
        problem = f'{name} is a topic of {", ".join(topic.types)}'
    if not fit:
        raise InputError(f'{problem}, and none that {option} can name. {_contents(bag)}')
    raise InputError(_options(problem, option, fit))


def _options(problem: str, option: str, topics: Iterable[Topic]) -> str:
    """Return a sentence with options to copy, a line each."""
    lines = [f'  {option} {topic.name}' for topic in topics]
    lines.insert(0, f'{problem}; add one of' if len(lines) > 1 else f'{problem}; add')
    return '\n'.join(lines)


def _contents(bag: Bag) -> str:
    names = [f'{topic.name} ({", ".join(topic.types)})' for topic in bag.topics.values()]
    if len(names) > 10:
        names[10:] = [f'and {len(names) - 10} more: see gr2t info']
    return f'It holds {", ".join(names)}' if names else 'It is empty'
