# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Any kind of recording gives the same views; the topics to use are found, or asked for."""
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import re

import bags_for_tests as bags
from bags_for_tests import DEPTH, INFO, Message
import numpy as np
import pytest

from gr2t_ros.core.view import View
from gr2t_ros.errors import InputError
from gr2t_ros.io import topics
from gr2t_ros.io.bags import Bag
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.io.views import views
from gr2t_ros.settings import Settings


def read(paths: Sequence[Path], start: float = 0.0, duration: float | None = None,
         **options: str) -> list[View]:
    """Return all views of a recording, by its guessed topics."""
    with Bag(paths) as bag:
        sources = topics.choose(bag, **options)
        settings = Settings(pose_source=sources.poses.source,
                            world_frame=sources.poses.world_frame)
        assembler = FrameAssembler(settings, rectified=sources.depth.rectified, max_waiting=50)
        found = list(views(bag, sources, assembler, start, duration))
        assert not bag.damage
        assert not assembler.dropped
        return found


def check(found: Sequence[View], indices: Sequence[int]) -> None:
    """Compare views with what was written."""
    assert [view.stamp_ns for view in found] == [bags.stamp(index) for index in indices]
    for view, index in zip(found, indices, strict=True):
        np.testing.assert_array_equal(view.depth, bags.depth(index) / np.float32(1000))
        np.testing.assert_allclose(view.T_world_camera, bags.pose(index), atol=1e-9)
        assert (view.camera.width, view.camera.height) == (bags.WIDTH, bags.HEIGHT)
        assert (view.camera.fx, view.camera.cx) == (bags.FOCAL, 15.5)


@pytest.mark.parametrize('kind', bags.KINDS)
def test_every_kind_of_recording_gives_the_same_views(tmp_path: Path, kind: str) -> None:
    check(read([bags.write(tmp_path / 'scan', bags.scan(3), kind)]), range(3))


def test_a_recording_in_parts_is_read_as_one(tmp_path: Path) -> None:
    messages = sorted(bags.scan(4), key=lambda message: message.log_ns)
    middle = len(messages) // 2
    parts = [bags.write(tmp_path / 'one', messages[:middle]),
             bags.write(tmp_path / 'two', messages[middle:], 'mcap bare')]
    check(read(parts), range(4))
    check(read(parts[::-1]), range(4))


def test_poses_in_another_recording(tmp_path: Path) -> None:
    messages = bags.scan(3)
    tf = [message for message in messages if message.topic.startswith('/tf')]
    rest = [message for message in messages if not message.topic.startswith('/tf')]
    check(read([bags.write(tmp_path / 'camera', rest, 'rosbag1'),
                bags.write(tmp_path / 'tf', tf, 'rosbag1 lz4')]), range(3))


def test_start_and_duration_keep_static_transforms_and_the_camera(tmp_path: Path) -> None:
    messages = [message for message in bags.scan(300) if message.topic != INFO]
    path = bags.write(tmp_path / 'scan', [*messages, bags.camera_info(0)])
    # log times: image i comes i / 10 s + 65 ms after the first message
    check(read([path], start=20.0, duration=0.3), [200, 201, 202])
    check(read([path], start=29.7), [297, 298, 299])


@pytest.mark.parametrize('kind', [
    'PoseStamped', 'PoseWithCovarianceStamped', 'Odometry', 'TransformStamped'])
@pytest.mark.parametrize('ros', ['mcap', 'rosbag1'])
def test_the_only_pose_topic_is_taken_where_there_is_no_tf(
    tmp_path: Path, kind: str, ros: str
) -> None:
    messages = [message for message in bags.scan(3) if not message.topic.startswith('/tf')]
    poses = [bags.pose_message(index - 0.5, kind) for index in range(5)]
    check(read([bags.write(tmp_path / 'scan', [*messages, *poses], ros)]), range(3))


def choose(tmp_path: Path, messages: Sequence[Message], **options: str) -> topics.Sources:
    """Return the topics that are chosen of a recording with these messages."""
    path = tmp_path / f'bag{len(list(tmp_path.iterdir()))}'
    with Bag([bags.write(path, messages)]) as bag:
        return topics.choose(bag, **options)


def test_real_recording_of_a_realsense(data: Path) -> None:
    with Bag([data / 'bags' / 'kitchen_sweep']) as bag:
        assert topics.choose(bag) == topics.Sources(
            depth=topics.DepthTopic('/camera/camera/depth/image_rect_raw', compressed=False,
                                    rectified=True, frame='camera_depth_optical_frame'),
            camera_info='/camera/camera/depth/camera_info',
            poses=topics.PoseTopics('tf', '', ('/tf', '/tf_static'), 'map'))


@pytest.mark.parametrize('name', [
    'ROS_example.bag', 'embag_test.bag', 'jsk_watercan.bag', 'nav2_turtlebot.mcap',
    'tf_example.bag', 'tf_example'])
def test_recordings_of_others_are_read_and_have_no_depth(data: Path, name: str) -> None:
    with Bag([data / 'bags' / name]) as bag:
        assert sum(1 for _ in bag.messages(bag.topics)) == bag.count
        assert not bag.damage
        with pytest.raises(InputError, match=r'holds no depth images .*; record the depth topic'):
            topics.choose(bag)


def test_tf_of_others_is_understood(data: Path) -> None:
    with Bag([data / 'bags' / 'nav2_turtlebot.mcap']) as bag:
        found = topics.choose_poses(bag, 'oakd_rgb_camera_optical_frame')
        assert (found.source, found.world_frame) == ('tf', 'map')
        with pytest.raises(InputError, match="several pose topics, and tf does not move 'other'"):
            topics.choose_poses(bag, 'other')
    with Bag([data / 'bags' / 'tf_example']) as bag, pytest.raises(
            InputError, match=r"tf does not know 'other'.* but .*; record the"):
        topics.choose_poses(bag, 'other')
    # one topic, two types of messages
    with Bag([data / 'bags' / 'jsk_watercan.bag']) as bag:
        assert len(bag.topics['/tf'].types) == 2
        found = topics.choose_poses(bag, 'left_camera_optical_frame')
        assert found.source == 'tf'


def test_colour_and_infrared_images_are_not_depth(tmp_path: Path) -> None:
    rgb = np.zeros((4, 12), np.uint8)
    messages = [
        *bags.scan(), bags.image(0, '/camera/color/image_raw', rgb, 'rgb8'),
        bags.image(0, '/camera/infra1/image_rect_raw', rgb, 'mono8'),
        bags.image(0, '/camera/depth/colorized', rgb, 'rgb8'),
        bags.compressed(0, '/camera/depth/image_rect_raw/compressed', '16UC1; jpeg')]
    assert choose(tmp_path, messages).depth.name == DEPTH


def test_a_raw_image_goes_before_its_compressed_sibling(tmp_path: Path) -> None:
    sibling = f'{DEPTH}/compressedDepth'
    assert choose(tmp_path, [*bags.scan(), bags.compressed(0, sibling)]).depth.name == DEPTH
    alone = [message for message in bags.scan() if message.topic != DEPTH]
    found = choose(tmp_path, [*alone, bags.compressed(0, sibling)])
    assert found.depth == topics.DepthTopic(
        sibling, compressed=True, rectified=True, frame=bags.OPTICAL)
    assert found.camera_info == INFO


def test_several_depth_topics_are_listed_as_options_to_copy(tmp_path: Path) -> None:
    aligned = '/camera/aligned_depth_to_color/image_raw'
    messages = [*bags.scan(), bags.image(0, aligned)]
    with pytest.raises(InputError) as raised:
        choose(tmp_path, messages)
    assert str(raised.value).splitlines()[1:] == [
        f'  --depth-topic {aligned}', f'  --depth-topic {DEPTH}']
    found = choose(tmp_path, messages, depth=aligned)
    assert (found.depth.name, found.depth.rectified) == (aligned, False)


@pytest.mark.parametrize(('depth_topic', 'infos', 'expected'), [
    ('/a/depth/image', ['/a/depth/camera_info', '/a/color/camera_info'], '/a/depth/camera_info'),
    ('/zed/depth/depth_registered', ['/zed/depth/depth_registered/camera_info', '/b/camera_info'],
     '/zed/depth/depth_registered/camera_info'),
    ('/a/depth/image', ['/elsewhere/camera_info'], '/elsewhere/camera_info')])
def test_camera_info_is_the_sibling_or_the_only_one(
    tmp_path: Path, depth_topic: str, infos: list[str], expected: str
) -> None:
    messages = [*bags.tf_to_camera(3), bags.image(0, depth_topic),
                *(bags.camera_info(0, name) for name in infos)]
    assert choose(tmp_path, messages).camera_info == expected


def test_several_camera_infos_are_listed_as_options_to_copy(tmp_path: Path) -> None:
    messages = [*bags.tf_to_camera(3), bags.image(0, '/a/depth/image'),
                bags.camera_info(0, '/b/camera_info'), bags.camera_info(0, '/c/camera_info')]
    with pytest.raises(InputError, match='holds no /a/depth/camera_info') as raised:
        choose(tmp_path, messages)
    assert '  --camera-info-topic /b/camera_info\n' in str(raised.value)
    assert choose(tmp_path, messages, camera_info='/c/camera_info').camera_info == '/c/camera_info'


def still(index: float) -> Message:
    """Return a /tf message that never changes."""
    return bags.transform(index, T=np.eye(4))


def test_tf_goes_before_pose_topics_if_it_moves_the_camera(tmp_path: Path) -> None:
    pose = bags.pose_message(0)
    assert choose(tmp_path, [*bags.scan(), pose]).poses.source == 'tf'
    frozen = [message for message in bags.scan() if message.topic != '/tf']
    frozen += [still(index) for index in range(4)]
    assert choose(tmp_path, [*frozen, pose]).poses.source == 'pose'
    # a camera that stands still, said by /tf, is a camera too
    assert choose(tmp_path, frozen).poses.source == 'tf'


def test_pose_topics_are_chosen_by_option_or_kind(tmp_path: Path) -> None:
    messages = [message for message in bags.scan() if message.topic != '/tf']
    messages += [bags.pose_message(0, 'Odometry', '/odom'),
                 bags.pose_message(0, 'PoseStamped', '/slam/pose')]
    with pytest.raises(InputError, match='several pose topics') as raised:
        choose(tmp_path, messages)
    assert str(raised.value).splitlines()[1:] == [
        '  --pose-topic /odom', '  --pose-topic /slam/pose']
    found = choose(tmp_path, messages, pose='/slam/pose').poses
    assert (found.source, found.topic) == ('pose', '/slam/pose')
    assert choose(tmp_path, messages, pose_source='odometry').poses.topic == '/odom'
    with pytest.raises(InputError, match='no poses of the kind pose_source:=transform'):
        choose(tmp_path, messages, pose_source='transform')


def test_the_world_frame_is_the_root_though_it_is_published_late(tmp_path: Path) -> None:
    messages = [*bags.scan(40), bags.transform(20, 'earth', 'map')]
    assert choose(tmp_path, messages).poses.world_frame == 'earth'


def test_a_fixed_camera_needs_its_world_frame_named(tmp_path: Path) -> None:
    messages = [message for message in bags.scan() if message.topic != '/tf']
    with pytest.raises(InputError, match=r'static transforms only.*--world-frame camera_link'):
        choose(tmp_path, messages)
    assert choose(tmp_path, messages, world_frame='camera_link').poses.source == 'tf'
    with pytest.raises(InputError, match=r"does not connect .* with the world frame 'mars'"):
        choose(tmp_path, messages, world_frame='mars')


@pytest.mark.parametrize(('option', 'name', 'match'), [
    ('depth', '/camera/dept/image_rect_raw', f'holds no topic (.|\n)*  --depth-topic {DEPTH}$'),
    ('depth', '/tf', f'/tf is a topic of tf2_msgs/msg/TFMessage; add\n  --depth-topic {DEPTH}$'),
    ('camera_info', DEPTH, f'sensor_msgs/msg/Image; add\n  --camera-info-topic {INFO}$'),
    ('pose', DEPTH, '--pose-topic /tf\n')])
def test_a_wrong_option_is_answered_with_the_right_ones(
    tmp_path: Path, option: str, name: str, match: str
) -> None:
    with pytest.raises(InputError, match=match):
        choose(tmp_path, bags.scan(), **{option: name})


def test_what_cannot_be_decoded_is_counted_and_the_rest_used(tmp_path: Path) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(3), 'mcap bare')
    content = bytearray(path.read_bytes())
    at = content.index(b'16UC1')
    content[at:at + 5] = b'\xff\xff\xff\xff\xff'  # no text: its encoding cannot be decoded
    path.write_bytes(content)
    with Bag([path]) as bag:
        found = list(bag.messages(bag.topics))
        assert len(found) == bag.count - 1
        assert bag.damage == f'1 messages on {DEPTH} could not be decoded'


def test_damage_that_shows_while_reading_costs_no_other_message(tmp_path: Path) -> None:
    large = np.random.default_rng(0).integers(0, 1000, (240, 320), np.uint16)
    messages = [bags.image(index, data=large) for index in range(100)]
    path = bags.write(tmp_path / 'scan', messages, 'mcap storage zstd')
    file = path / 'scan.mcap'
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 1000] = bytes(1000)
    file.write_bytes(content)
    with Bag([path]) as bag:
        assert (bag.count, bag.damage) == (100, '')
        stamps = [log_ns for _, _, log_ns in bag.messages(bag.topics)]
        # a chunk holds eight
        assert 92 <= len(stamps) < 100
        assert stamps == sorted(set(stamps))
        assert (stamps[0], stamps[-1]) == (messages[0].log_ns, messages[-1].log_ns)
        assert re.fullmatch(
            rf'{file} is damaged \(.*\): {len(stamps)} messages of 100 can be read; \d+ of '
            rf'{len(content)} bytes are damaged or lost: from byte \d+ to \d+, after 4.\d s',
            bag.damage)
        assert [log_ns for _, _, log_ns in bag.messages(bag.topics)] == stamps


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'rosbag1'])
def test_messages_twice_out_of_order_and_of_other_times(tmp_path: Path, kind: str) -> None:
    """Each image that is in order is used once; the others are counted."""
    messages = bags.scan(20)
    late = [replace(message, log_ns=message.log_ns + 1_000_000_000)
            for message in messages if message.topic == '/tf'][::3]
    twice = [replace(bags.image(index), log_ns=bags.image(index).log_ns + 3_000_000)
             for index in range(5, 10)]
    # an hour later, an hour before, and two that were logged in the wrong order
    other = [replace(bags.image(index, data=bags.depth(0)), log_ns=bags.image(7).log_ns + 1)
             for index in (36_007, -36_000)]
    swapped = [replace(bags.image(index), log_ns=bags.image(27 - index).log_ns)
               for index in (13, 14)]
    kept = [message for message in messages if message not in late and not (
        message.topic == DEPTH and message.log_ns in (item.log_ns for item in swapped))]
    path = bags.write(tmp_path / 'scan', [*kept, *late, *twice, *other, *swapped], kind)
    with Bag([path]) as bag:
        sources = topics.choose(bag)
        assembler = FrameAssembler(
            Settings(world_frame=sources.poses.world_frame), rectified=True, max_waiting=50)
        found = list(views(bag, sources, assembler))
        assert bag.damage == ''
    assert sorted(view.stamp_ns for view in found) == [bags.stamp(index) for index in range(20)]
    assert assembler.dropped.pop('duplicate') == 5
    assert assembler.dropped.total() == 2
    assert assembler.read == 27


def test_the_folder_of_a_killed_recorder(tmp_path: Path) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(4))
    rest = bags.write(tmp_path / 'rest', [bags.image(4), bags.transform(5.5)], 'mcap bare')
    (path / 'metadata.yaml').unlink()
    (path / 'scan.mcap').rename(path / 'scan_0.mcap')
    rest.rename(path / 'scan_1.mcap')
    with Bag([path]) as bag:
        assert bag.topics[DEPTH].count == 5
        assert f'{path} has no metadata.yaml that can be read' in bag.damage
    (path / 'other_0.mcap').touch()
    with pytest.raises(InputError, match='files of several recordings; name those of one'):
        Bag([path])


def test_files_that_metadata_does_not_name_yet_and_names_that_are_gone(tmp_path: Path) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(4))
    rest = bags.write(tmp_path / 'rest', [bags.image(4)], 'mcap bare')
    rest.rename(path / 'scan_1.mcap')
    with Bag([path]) as bag:
        assert (bag.topics[DEPTH].count, bag.damage) == (5, '')
    (path / 'scan.mcap').unlink()
    with Bag([path]) as bag:
        assert (bag.topics[DEPTH].count, bag.damage) == (1, f'{path} lacks scan.mcap')
