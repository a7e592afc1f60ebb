# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The player in its own process."""
from pathlib import Path
import subprocess

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from gr2t_ros.tools.recorder import DEPTH_TOPIC, record

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.serialization import deserialize_message
from ros_for_tests import Isolation, LIMIT, Observer, plane_views
from sensor_msgs.msg import Image

from gr2t_ros.ros.outputs import outputs_profile

COUNT = 3


def play(isolation: Isolation, *arguments: object) -> tuple[int, str]:
    """Return the exit code and the output."""
    player = isolation.run(
        'gr2t_ros.ros.bag_player', *arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    output, _ = player.communicate(timeout=LIMIT)
    return player.returncode, output


def test_every_image_arrives_as_it_was_recorded(tmp_path: Path) -> None:
    isolation = Isolation()
    views = plane_views(COUNT)
    record(tmp_path / 'plane', views)
    observer = Observer(isolation)
    player = None
    try:
        profile = outputs_profile(10)
        profile.durability = profile.durability.VOLATILE
        images = observer.collect(Image, DEPTH_TOPIC, profile)
        player = isolation.run('gr2t_ros.ros.bag_player', tmp_path / 'plane', '--rate', 2)
        observer.spin_until(lambda: len(images) == COUNT, 'the images')
        assert player.wait(LIMIT) == 0
        for data, view in zip(images, views):
            image = deserialize_message(data, Image)
            depth = np.frombuffer(image.data, np.float32).reshape(image.height, image.width)
            np.testing.assert_array_equal(depth, view.depth)
    finally:
        if player:
            player.kill()
            player.wait()
        observer.close()


def test_unknown_types_are_skipped_and_a_missing_subscriber_is_said(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg('float64 value', 'acme_msgs/msg/Reading'))
    with Writer(tmp_path / 'bag', version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        reading = types.types['acme_msgs/msg/Reading']
        text = types.types['std_msgs/msg/String']
        for topic, message in (('/acme', reading(value=1.0)), ('/text', text(data='hello'))):
            kind = message.__msgtype__
            connection = bag.add_connection(topic, kind, typestore=types)
            bag.write(connection, 0, types.serialize_cdr(message, kind))
    code, output = play(Isolation(), tmp_path / 'bag', '--wait', 0.1)
    assert code == 0
    assert 'skipped /acme: acme_msgs/msg/Reading is not installed' in output
    assert 'nobody subscribes to /text after 0.1 s' in output
    assert 'played 1 messages' in output


def test_recordings_that_cannot_be_played(tmp_path: Path) -> None:
    """One line says why, and the exit code is 2."""
    types = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / 'one.bag') as bag:
        text = types.types['std_msgs/msg/String']
        connection = bag.add_connection('/text', text.__msgtype__, typestore=types)
        bag.write(connection, 0, types.serialize_ros1(text(data='hello'), text.__msgtype__))
    (tmp_path / 'two.mcap').write_bytes(b'no recording')
    for name, words in (('one.bag', 'is a ROS 1 recording'), ('two.mcap', 'cannot read'),
                        ('three', 'no such file')):
        code, output = play(Isolation(), tmp_path / name)
        assert code == 2
        assert words in output
        assert name in output
        assert output.count('\n') == 1
