# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameter files, displays, the Fast DDS profile and launch files agree with the node."""
import argparse
import ast
from collections.abc import Callable
from dataclasses import fields
from importlib.util import module_from_spec, spec_from_file_location
import json
from pathlib import Path
import re
import runpy
import sys
from types import ModuleType
from typing import Any
import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import NDArray
import pytest
import yaml

from gr2t_ros.settings import Settings
from gr2t_ros.tools import options

PROJECT = Path(__file__).resolve().parents[1]
CONFIG = PROJECT / 'config'
LAUNCH = sorted((PROJECT / 'launch').glob('*.launch.py'))
Depths = NDArray[np.float64]


def script(name: str) -> ModuleType:
    """Return a script as a module."""
    spec = spec_from_file_location(name, PROJECT / 'scripts' / f'{name}.py')
    assert spec and spec.loader
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


write_parameters = script('write_parameters')


def parameters(path: Path) -> dict[str, object]:
    """Return what a parameter file sets."""
    content = yaml.safe_load(path.read_text())
    assert list(content) == ['/**']
    assert list(content['/**']) == ['ros__parameters']
    return content['/**']['ros__parameters']


def test_gr2t_yaml_holds_every_parameter_with_its_default() -> None:
    given = parameters(CONFIG / 'gr2t.yaml')
    assert list(given) == [item.name for item in fields(Settings)]
    for item in fields(Settings):
        default = list(item.default) if isinstance(item.default, tuple) else item.default
        assert given[item.name] == default
        assert type(given[item.name]) is type(default), item.name


@pytest.mark.parametrize(('file', 'text'), [
    (CONFIG / 'gr2t.yaml', write_parameters.yaml_text()),
    (PROJECT / 'docs' / 'parameters.md', write_parameters.markdown_text()),
], ids=lambda item: getattr(item, 'name', ''))
def test_generated_files_are_those_of_the_table(file: Path, text: str) -> None:
    """After a change of settings.py: scripts/write_parameters.py."""
    assert file.read_text(encoding='utf-8') == text
    for item in fields(Settings):
        meta = item.metadata
        assert meta['help'] in ' '.join(text.replace('#', ' ').split()), item.name
        for word in (item.name, meta['unit'], *meta['choices']):
            assert word in text


def test_the_command_line_takes_every_parameter() -> None:
    """As the YAML file writes it."""
    parser = argparse.ArgumentParser()
    options.add_arguments(parser)
    given = [f'-p{item.name}:={write_parameters.value_text(item.default)}'
             for item in fields(Settings)]
    assert options.settings(parser.parse_args(given)) == Settings()


def test_the_node_declares_every_parameter() -> None:
    """With the table's help, unit, range and choices, as `ros2 param describe` shows them."""
    rclpy = pytest.importorskip('rclpy', reason='ROS 2 is not installed')
    from gr2t_ros.ros.parameters import read_parameters
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node(
        'gr2t', context=context, automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False)
    try:
        assert read_parameters(node) == Settings()
        for item in fields(Settings):
            value = node.get_parameter(item.name).value
            assert (tuple(value) if isinstance(value, list) else value) == item.default
            described, meta = node.describe_parameter(item.name), item.metadata
            assert described.description.startswith(meta['help'])
            assert meta['unit'] in described.description
            assert described.read_only == (not meta['live'])
            assert all(word in described.additional_constraints for word in meta['choices'])
            ranges = [*described.floating_point_range, *described.integer_range]
            assert [(span.from_value, span.to_value) for span in ranges] == (
                [] if meta['low'] is None else [(meta['low'], meta['high'])]), item.name
    finally:
        node.destroy_node()
        context.try_shutdown()


PRESETS = {path.stem: path for path in write_parameters.presets()}

# Of each preset the source's standard deviation of the noise at the depth z, and what the preset
# may add to it: all in metres.
LAWS = {
    'realsense_d400': (lambda z: stereo_noise(z, 0.08, 424, 0.05), 0.0005),
    'kinect_v1': (lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2, 0.0),
    'azure_kinect': (lambda z: 0.017 * (z / 3.86) ** 2, 0.001),
    'zed': (lambda z: 0.03 * (z / 3) ** 2, 0.001),
    'tabletop_scan': (lambda z: stereo_noise(z, 0.08, 424, 0.095), 0.001),
    'room_scan': (lambda z: stereo_noise(z, 0.08, 424, 0.095), 0.002),
}


def stereo_noise(z: Depths, disparity: float, focal: float, baseline: float) -> Depths:
    """Return Keselman et al. 2017, equation 2: disparity noise and focal length in pixels."""
    return z ** 2 * disparity / (focal * baseline)


def test_there_is_a_preset_for_each_sensor_and_scene() -> None:
    assert PRESETS.keys() == LAWS.keys()


@pytest.mark.parametrize('path', PRESETS.values(), ids=lambda path: path.stem)
def test_presets_can_be_used(path: Path) -> None:
    given = parameters(path)
    settings = Settings().updated(given)
    for name, value in given.items():
        assert getattr(settings, name) == value
        assert type(value) is type(getattr(settings, name)), f'{name} needs a decimal point'


@pytest.mark.parametrize('name', LAWS)
def test_presets_follow_their_sources(name: str) -> None:
    """Over the whole range: within 20 % of the law, and what is added to it."""
    source, added = LAWS[name]
    settings = Settings().updated(parameters(PRESETS[name]))
    z = np.linspace(settings.depth_min, settings.depth_max, 200)
    bandwidth = settings.depth_bandwidth + settings.depth_bandwidth_quadratic * z ** 2
    assert (bandwidth > 0.8 * source(z)).all()
    assert (bandwidth < 1.2 * source(z) + added).all()


def test_sources_agree_where_they_overlap() -> None:
    """The Kinect's measured noise is above the one derived from its disparities, and near it."""
    z = np.linspace(2.0, 4.0, 50)
    settings = Settings().updated(parameters(PRESETS['kinect_v1']))
    bandwidth = settings.depth_bandwidth + settings.depth_bandwidth_quadratic * z ** 2
    assert np.abs(bandwidth / (0.001425 * z ** 2) - 1).max() < 0.2


def test_displays_get_what_was_sent_before_they_started() -> None:
    """RViz listens volatile unless told otherwise, and then shows nothing."""
    content = yaml.safe_load((CONFIG / 'gr2t.rviz').read_text())
    displays = {
        item['Topic']['Value']: item['Topic']
        for item in content['Visualization Manager']['Displays'] if 'Topic' in item}
    assert displays.keys() == {f'/gr2t/{name}' for name in (
        'fused_mesh', 'mesh', 'edges', 'points', 'attention', 'next_views')}
    enabled = [
        item['Topic']['Value'] for item in content['Visualization Manager']['Displays']
        if item['Enabled'] and 'Topic' in item]
    assert enabled == ['/gr2t/fused_mesh']
    for topic in displays.values():
        assert topic['Durability Policy'] == 'Transient Local'
        assert topic['Reliability Policy'] == 'Reliable'


def test_the_fast_dds_profile_holds_large_messages() -> None:
    """An image of 640 x 480 floats fits its shared memory many times; other machines are met."""
    space = '{http://www.eprosima.com}'
    root = ElementTree.parse(CONFIG / 'fastdds.xml').getroot()
    descriptors = {
        item.findtext(f'{space}type'): item
        for item in root.iter(f'{space}transport_descriptor') if len(item)}
    assert descriptors.keys() == {'SHM', 'UDPv4'}
    assert int(descriptors['SHM'].findtext(f'{space}segment_size')) == 16 << 20
    assert root.find(f'.//{space}interfaceWhiteList') is None


@pytest.mark.parametrize('path', LAUNCH, ids=lambda path: path.name)
def test_launch_files_parse(path: Path) -> None:
    """All that can be told of some without the package launch, which has no wheel."""
    tree = ast.parse(path.read_text(), str(path))
    assert 'generate_launch_description' in {
        item.name for item in tree.body if isinstance(item, ast.FunctionDef)}


@pytest.mark.parametrize('path', LAUNCH, ids=lambda path: path.name)
def test_launch_files_load(path: Path) -> None:
    pytest.importorskip('launch_ros', reason='launch is not installed (it has no wheel)')
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    description = get_launch_description_from_python_launch_file(str(path))
    assert description.entities


class Recorded:
    """Stands for each class of launch: keeps what it is called with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    def perform(self, context: dict[str, str]) -> str:
        """Return an argument's value; an unknown one is an error."""
        return context[self.args[0]]


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], dict[str, Any]]:
    """Return what runs a launch file, with launch replaced, and returns its names."""
    classes = {
        'launch': ['LaunchDescription'],
        'launch.actions': [
            'DeclareLaunchArgument', 'ExecuteProcess', 'IncludeLaunchDescription',
            'OpaqueFunction'],
        'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
        'launch.substitutions': ['LaunchConfiguration'],
        'launch_ros': [],
        'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterValue'],
        'ament_index_python': [],
        'ament_index_python.packages': [],
    }
    for name, members in classes.items():
        module = ModuleType(name)
        for member in members:
            setattr(module, member, type(member, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(
        sys.modules['ament_index_python.packages'], 'get_package_share_directory',
        lambda _: str(PROJECT), raising=False)
    return lambda name: runpy.run_path(str(PROJECT / 'launch' / name))


@pytest.fixture
def live(launched: Callable[[str], dict[str, Any]]) -> Callable[..., list[dict[str, Any]]]:
    """Return what calls live.launch.py with arguments; it returns what each node gets."""
    def start(**given: str) -> list[dict[str, Any]]:
        module = launched('live.launch.py')
        entities = module['generate_launch_description']().args[0]
        context = {
            item.args[0]: item.kwargs['default_value'] for item in entities
            if type(item).__name__ == 'DeclareLaunchArgument'}
        assert given.keys() <= context.keys()
        return [node.kwargs for node in module['nodes']({**context, **given})]

    return start


def test_a_recording_is_played_into_the_live_node(
    launched: Callable[[str], dict[str, Any]]
) -> None:
    entities = launched('replay.launch.py')['generate_launch_description']().args[0]
    by_class = {type(item).__name__: item for item in entities}
    included = by_class['IncludeLaunchDescription'].args[0].args[0]
    assert Path(included) == PROJECT / 'launch' / 'live.launch.py' and Path(included).is_file()
    command = by_class['ExecuteProcess'].kwargs['cmd']
    assert command[:3] == ['ros2', 'bag', 'play']
    declared = {item.args[0] for item in entities if type(item).__name__.startswith('Declare')}
    assert declared == {
        item.args[0] for item in command if type(item).__name__ == 'LaunchConfiguration'}


@pytest.mark.parametrize('preset', [*PRESETS, 'gr2t'])
def test_a_preset_brings_its_file_and_its_topics(
    preset: str, live: Callable[..., list[dict[str, Any]]]
) -> None:
    """The topics are those that its file names; scenes take a RealSense's."""
    node, = live(preset=preset)
    file, values = node['parameters']
    assert Path(file) == CONFIG / f'{preset}.yaml'
    assert values == {'use_sim_time': False}
    topics = dict(node['remappings'])
    named = re.findall(r'^#.* (/[\w/]+)$', (CONFIG / f'{preset}.yaml').read_text(), re.M)
    assert [topics['depth/image'], topics['depth/camera_info']] == (named or [
        '/camera/camera/depth/image_rect_raw', '/camera/camera/depth/camera_info'])


def test_what_is_given_wins(live: Callable[..., list[dict[str, Any]]]) -> None:
    """Over the user's file, which wins over the preset."""
    node, rviz = live(
        preset='zed', rviz='true', camera='/zed2', params_file='mine.yaml', depth_max='4',
        world_frame='12', camera_info_topic='/info', use_sim_time='true', cameras='[front, rear]')
    preset, file, values = node['parameters']
    assert preset.endswith('zed.yaml') and file == 'mine.yaml'
    text = values.pop('world_frame')
    assert (text.args, text.kwargs) == (('12',), {'value_type': str})
    assert values == {'depth_max': 4.0, 'use_sim_time': True, 'cameras': ['front', 'rear']}
    assert type(values['depth_max']) is float
    assert dict(node['remappings']) == {
        'depth/image': '/zed2/depth/depth_registered', 'depth/camera_info': '/info',
        'pose': 'pose'}
    assert Path(rviz['arguments'][1]).is_file() and rviz['arguments'][2:] == ['-f', '12']


def test_the_foxglove_layout_shows_the_map() -> None:
    """As an exported layout: panels, and a tree that holds all of them."""
    content = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    panels = content['configById']

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        return leaves(node['first']) + leaves(node['second'])

    assert sorted(leaves(content['layout'])) == sorted(panels)
    view, = (panel for name, panel in panels.items() if name.startswith('3D!'))
    visible = [name for name, topic in view['topics'].items() if topic['visible']]
    assert visible == ['/gr2t/fused_mesh']
    assert view['topics']['/gr2t/points']['colorField'] == 'likelihood'
