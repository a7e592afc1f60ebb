# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is said of messages that were left out, and of what they show."""
from messages_for_tests import camera_info, image, tf, transform
import numpy as np
import pytest

from gr2t_ros.io.messages import MAX_BYTES
from gr2t_ros.ros.intake import Intake
from gr2t_ros.ros.timings import Timings
from gr2t_ros.settings import Settings

PERIOD_NS = 50_000_000
DEPTH = np.full((6, 8), 1500, np.uint16)


def taken(intake: Intake) -> list[str]:
    """Take all messages; return what is said."""
    said = []
    while intake.queued:
        intake.take()
        said += intake.news()
    return said


def intake_of(**settings: object) -> Intake:
    return Intake(
        Settings(**settings), {'': False}, lambda: None, Timings(), lambda stamp_ns: None)


def test_a_full_queue_is_explained_once_and_counted() -> None:
    intake = intake_of(queue_size=2)
    for i in range(5):
        intake.on_depth(image(DEPTH, '16UC1', i * PERIOD_NS))
    line, = taken(intake)
    assert 'lower the frame rate' in line
    assert line.endswith('[queue_full: said once, then counted]')
    assert intake.cameras[''].dropped['queue_full'] == 3
    assert 'lower the frame rate' in intake.cameras[''].explanations['queue_full']


def test_an_image_that_a_defect_costs_is_counted() -> None:
    intake = intake_of()
    camera = intake.cameras['']

    def broken(*_: object) -> None:
        raise ZeroDivisionError('a defect')

    camera.assembler.on_depth = broken
    intake.on_depth(image(DEPTH, '16UC1', 0))
    with pytest.raises(ZeroDivisionError):
        intake.take()
    assert camera.dropped == {'error': 1} and camera.waiting == 0


def test_a_jump_of_the_world_is_said_once_and_drops_nothing() -> None:
    intake = intake_of(world_frame='map')
    intake.on_camera_info(camera_info())
    said: list[str] = []
    x = 0.0
    for i in range(16):
        x += 0.12 if i in (4, 12) else 0.0
        stamp_ns = i * PERIOD_NS
        for parent, child, place in (('map', 'odom', x), ('odom', 'camera', 0.1 * i)):
            T = np.eye(4)
            T[0, 3] = place
            intake.on_transforms(tf(transform(parent, child, stamp_ns, T)), static=False)
        intake.on_depth(image(DEPTH, '16UC1', stamp_ns))
        said += taken(intake)
    line, = said
    assert line.startswith('frame odom jumped') and line.endswith('[world_jump: said once]')
    assert not intake.cameras[''].dropped


def test_an_image_that_is_too_large_is_not_queued() -> None:
    intake = intake_of()
    intake.on_depth(image(DEPTH, data=np.zeros(MAX_BYTES + 1, np.uint8)))
    intake.on_mask(image(DEPTH, data=np.zeros(MAX_BYTES + 1, np.uint8)))
    assert intake.queued == 0
    assert intake.cameras[''].dropped == {'image_size': 1}
    image_line, mask_line = intake.news()
    assert image_line.endswith(
        'MB of data; up to 168 are taken [image_size: said once, then counted]')
    assert mask_line.endswith('[mask: said once]')
