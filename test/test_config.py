# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameter files, displays, the Fast DDS profile and launch files agree with the node."""
import ast
from dataclasses import fields
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

from gr2t_ros.settings import Settings

PROJECT = Path(__file__).resolve().parents[1]
CONFIG = PROJECT / 'config'
LAUNCH = sorted((PROJECT / 'launch').glob('*.launch.py'))


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
        assert given[item.name] == item.default
        assert type(given[item.name]) is type(item.default), item.name


def test_gr2t_yaml_says_what_each_parameter_is() -> None:
    """The comment above it: its help, unit, range or choices."""
    text = (CONFIG / 'gr2t.yaml').read_text()
    for item in fields(Settings):
        match = re.search(rf'((?:^ +# .*\n)+) +{item.name}: ', text, re.MULTILINE)
        assert match, item.name
        comment = ' '.join(match[1].replace('#', ' ').split())
        meta = item.metadata
        assert meta['help'] in comment
        if meta['unit']:
            assert f' {meta["unit"]}, ' in comment
        if meta['low'] is not None:
            low, high = re.search(r'(\S+) to (\S+)$', comment).groups()
            assert (float(low), float(high)) == (meta['low'], meta['high'])
        assert ' | '.join(meta['choices']) in comment


@pytest.mark.parametrize('path', sorted(CONFIG.glob('*.yaml')), ids=lambda path: path.stem)
def test_presets_can_be_used(path: Path) -> None:
    given = parameters(path)
    settings = Settings().updated(given)
    for name, value in given.items():
        assert getattr(settings, name) == value
        assert type(value) is type(getattr(settings, name)), f'{name} needs a decimal point'


def test_displays_get_what_was_sent_before_they_started() -> None:
    """RViz listens volatile unless told otherwise, and then shows nothing."""
    content = yaml.safe_load((CONFIG / 'gr2t.rviz').read_text())
    displays = {
        item['Topic']['Value']: item['Topic']
        for item in content['Visualization Manager']['Displays'] if 'Topic' in item}
    assert displays.keys() == {'/gr2t/mesh', '/gr2t/points'}
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
    """All that can be told of them without the package launch, of which there is no wheel."""
    tree = ast.parse(path.read_text(), str(path))
    assert 'generate_launch_description' in {
        item.name for item in tree.body if isinstance(item, ast.FunctionDef)}
    names = {
        call.args[0].value for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'LaunchConfiguration'
        and isinstance(call.args[0], ast.Constant)}
    declared = {
        call.args[0].value for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'DeclareLaunchArgument'}
    assert names <= declared
    given = {item.name for item in fields(Settings)} & declared
    if 'live' in path.name:
        assert given == {'pose_source', 'world_frame', 'snapshot_directory'}


@pytest.mark.parametrize('path', LAUNCH, ids=lambda path: path.name)
def test_launch_files_load(path: Path) -> None:
    pytest.importorskip('launch_ros', reason='launch is not installed (it has no wheel)')
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    description = get_launch_description_from_python_launch_file(str(path))
    assert description.entities
