# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The table of parameters takes texts and refuses what is wrong by name."""
from dataclasses import fields

import pytest

from gr2t_ros.errors import InputError
from gr2t_ros.settings import Settings


def test_values_may_be_texts_as_on_the_command_line():
    settings = Settings().updated({
        'threads': '2', 'depth_max': '3.5', 'snapshot_on_exit': 'true', 'world_frame': '12',
        'ray_stride': 2.0})
    assert settings.threads == 2 and settings.depth_max == 3.5
    assert settings.snapshot_on_exit is True and settings.world_frame == '12'
    assert settings.ray_stride == 2 and isinstance(settings.ray_stride, int)
    assert Settings().threads == 0


@pytest.mark.parametrize('value', [
    '[front, arm/rear]', ' ["front", \'arm/rear\']', 'front,arm/rear', ['front', 'arm/rear']])
def test_lists_of_names(value):
    assert Settings().updated({'cameras': value}).cameras == ('front', 'arm/rear')


@pytest.mark.parametrize('value', ['[]', '', [], ['']])
def test_no_name_is_one_camera_without_a_name(value):
    assert Settings().updated({'cameras': value}).cameras == ('',)


@pytest.mark.parametrize(('values', 'sentence'), [
    ({'cameras': '[front, front]'}, 'cameras must hold different names of topics'),
    ({'cameras': ['front', '']}, 'cameras must hold different names of topics'),
    ({'cameras': '3d'}, 'cameras must hold different names of topics'),
    ({'cameras': 3}, r'cameras must be a list of texts, such as \[front, rear\], not 3'),
    ({'thread': 2}, 'unknown parameter thread; did you mean threads?'),
    ({'xyzzy': 2}, 'unknown parameter xyzzy; known: pixel_bandwidth'),
    ({'depth_max': 'far'}, "depth_max must be a number, not 'far'"),
    ({'depth_max': 'nan'}, 'depth_max must be a number'),
    ({'depth_max': True}, 'depth_max must be a number'),
    ({'ray_stride': 1.5}, 'ray_stride must be a whole number, not 1.5'),
    ({'ray_stride': 0}, r'ray_stride must lie in \[1, 64\] px, not 0'),
    ({'snapshot_on_exit': 'yes'}, 'snapshot_on_exit must be true or false'),
    ({'start': 'nearest'}, "start must be one of robust, observed, not 'nearest'"),
    ({'depth_min': 3, 'depth_max': 2}, r'depth_min \(3 m\) must be below depth_max \(2 m\)'),
    ({'world_frame': 3}, 'world_frame must be a text'),
])
def test_what_is_wrong_is_named(values, sentence):
    with pytest.raises(InputError, match=sentence):
        Settings().updated(values)


def test_every_parameter_has_a_help_and_its_default_is_in_range():
    Settings()
    for item in fields(Settings):
        assert item.metadata['help'].endswith('.'), item.name
        low, high = item.metadata['low'], item.metadata['high']
        assert (low is None) == (high is None)
        if type(item.default) in (int, float):
            assert low <= item.default <= high
