# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Every command in README.md runs, every link leads somewhere.

The commands of a code block run in order in a folder of their own, on small bags and meshes; of
`ros2 run` and `ros2 service call` what they start or call. Three kinds do not run: those that need
more of an installed ROS 2 (launch, rviz2, rosdep, colcon), those that would start these tests or
the demo again (make), and those that fetch from the network (pip). Of these the files, targets,
arguments and names are checked; test_demo.py and test_package.py run what is behind some of them.
"""
from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import fields
from importlib import import_module
import os
from pathlib import Path
import re
import shlex
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import trimesh

from gr2t_ros.settings import Settings
from gr2t_ros.tools import cli

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / 'README.md').read_text(encoding='utf-8')
# runs a script with smaller images, and without Open3D, which takes long to import
SMALL_BENCHMARK = """
from functools import partial
import runpy, sys
from gr2t_ros.tools import simulate
simulate.simulated_views = partial(simulate.simulated_views, width=64, height=48)
sys.modules['open3d'] = None
sys.argv = sys.argv[1:]
sys.path.insert(0, 'benchmarks')
runpy.run_path(sys.argv[0], run_name='__main__')
"""
SMALL = ('--width', '96', '--height', '72')  # of simulated images
OF_OTHERS = ('ros2 launch realsense2_camera rs_launch.py',)


def blocks() -> Iterator[list[str]]:
    """Yield the commands of each code block, comments and line breaks taken out."""
    for text in re.findall(r'^```bash\n(.*?)^```', README, re.M | re.S):
        lines = text.replace('\\\n', ' ').splitlines()
        yield [' '.join(line.partition(' #')[0].split()) for line in lines if line.strip()]


BLOCKS = list(blocks())


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small recording of a simulated tabletop."""
    pytest.importorskip('embreex', reason='the ray caster embreex is not installed')
    path = tmp_path_factory.mktemp('recording') / 'bag'
    assert cli.main(['simulate', 'tabletop', str(path), '--views', '4', *SMALL]) == 0
    return path


@pytest.fixture
def folder(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working folder: it looks like a checkout, with a bag and a mesh in it."""
    (tmp_path / 'BAG').symlink_to(bag)
    for name in ('config', 'benchmarks'):
        (tmp_path / name).symlink_to(ROOT / name)
    trimesh.creation.icosphere(subdivisions=3, radius=0.08).export(tmp_path / 'bunny.ply')
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_it_stays_short() -> None:
    assert len(README.splitlines()) < 150


@pytest.mark.parametrize('file', ['README.md', 'CONTRIBUTING.md', *(
    str(path.relative_to(ROOT)) for path in sorted(ROOT.glob('docs/*.md')))])
def test_links_lead_to_files_and_headings(file: str) -> None:
    text = (ROOT / file).read_text(encoding='utf-8')
    for link in re.findall(r'\]\(\s*([^)\s]+)\s*\)', text):
        if '://' in link:
            continue
        name, _, heading = link.partition('#')
        target = (ROOT / file).parent / name if name else ROOT / file
        assert target.exists(), link
        headings = {
            re.sub(r'[^\w -]', '', line.lstrip('# ').lower()).replace(' ', '-')
            for line in (target.read_text(encoding='utf-8').splitlines() if heading else ())
            if line.startswith('#')}
        assert not heading or heading in headings, link


def test_every_reason_for_a_dropped_image_is_explained() -> None:
    page = (ROOT / 'docs' / 'nothing_shows_up.md').read_text(encoding='utf-8')
    explained = set(re.findall(r'^\| `(\w+)` \|', page, re.M))
    source = ''.join(
        path.read_text(encoding='utf-8') for path in (ROOT / 'gr2t_ros').rglob('*.py'))
    reasons = {
        reason for call in (
            r"(?:FrameError|NotYet)\(\s*'(\w+)'", r"\.lost\['(\w+)'\]", r"\.drop\(\w+, '(\w+)'\)")
        for reason in re.findall(call, source)}
    assert len(reasons) > 10
    assert explained == reasons - {'empty_map'}  # of a snapshot


def test_parameters_that_it_sets_exist() -> None:
    known = {item.name for item in fields(Settings)}
    for name, value in re.findall(r'-p (\w+):=(\S+)', README):
        assert name in known
        Settings().updated({name: value})
    known |= {'gr2t_node', *(path.stem for path in ROOT.glob('config/*.yaml'))}
    for name in re.findall(r'`(\w+_\w+)`', README):  # such as `depth_bandwidth`
        assert name in known or name.isupper(), name


RUN_HERE = [
    block for block in BLOCKS if re.match(r'gr2t |python -m |python benchmarks', block[0])]
CHECKED_ONLY = [command for block in BLOCKS if block not in RUN_HERE for command in block]


@pytest.mark.parametrize('block', RUN_HERE, ids=lambda block: block[0])
def test_block_runs(block: list[str], folder: Path) -> None:
    for command in block:
        words = shlex.split(command)
        if words[0] == 'gr2t':
            small = ['--views', '4', *SMALL] if words[1] == 'simulate' else []
            assert cli.main([*words[1:], *small]) == 0
        elif words[:2] == ['python', '-m']:
            play(words[2], words[3:])
        else:
            assert words[0] == 'python'
            benchmark(words[1:])
        if '-o' in words and words[1] == 'replay':
            rows = [line for line in README.splitlines() if line.startswith('| `out/')]
            for name in re.findall(
                    r'`(out/[\w.]+)`', ''.join(row for row in rows if 'with `--' not in row)):
                if name == 'out/parts':  # of what does not fit into memory
                    continue
                assert (folder / name).stat().st_size > 0


def play(module: str, arguments: list[str]) -> None:
    """Run the player, without waiting long for a subscriber."""
    isolation = pytest.importorskip('ros_for_tests', reason='ROS 2 is not installed').Isolation()
    process = isolation.run(module, *arguments, '--wait', '0.1', stderr=subprocess.PIPE)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert 'played' in error


def benchmark(words: list[str]) -> None:
    """Run a benchmark on small images."""
    done = subprocess.run(
        [sys.executable, '-c', SMALL_BENCHMARK, *words], capture_output=True, text=True,
        timeout=120, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert done.returncode == 0, done.stderr
    assert 'distance to the truth' in done.stdout


@pytest.mark.parametrize('command', CHECKED_ONLY, ids=str)
def test_command_names_what_exists(command: str, request: pytest.FixtureRequest) -> None:
    words = shlex.split(command)
    if command in OF_OTHERS:
        return
    if words[0] in ('export', 'rviz2'):
        path = re.search(r'\$\(ros2 pkg prefix --share gr2t_ros\)/(\S+)', command)
        assert path and (ROOT / path[1]).is_file()
    elif words[0] == 'make':
        assert re.search(rf'^{words[1]}:', (ROOT / 'Makefile').read_text(), re.M)
    elif words[:2] == ['ros2', 'launch']:
        check_launch(*words[2:])
    elif words[:2] == ['ros2', 'run']:
        request.getfixturevalue('folder')
        run_node(*words[2:])
    elif words[:3] == ['ros2', 'service', 'call']:
        request.getfixturevalue('folder')
        call_service(*words[3:])
    elif words[0] == 'colcon':
        package = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('name')
        assert words[1:] == ['build', '--packages-select', package]
    elif 'pip' in words[0]:
        check_pip(words[1:])
    elif words[0] == '.':
        assert words[1] in ('.venv/bin/activate', 'install/setup.bash')  # made by the others
    else:
        assert words[0] == 'rosdep' or words[:3] == ['python3', '-m', 'venv'], 'check this too'


def check_launch(package: str, file: str, *arguments: str) -> None:
    """Compare a call of ros2 launch with the arguments that the file declares."""
    assert package == 'gr2t_ros'
    declared = {item.name for item in fields(Settings)} | {
        node.value for node in ast.walk(ast.parse((ROOT / 'launch' / file).read_text()))
        if isinstance(node, ast.Constant)}
    for name, value in (item.split(':=') for item in arguments):
        assert name in declared
        if name == 'preset':
            assert (ROOT / 'config' / f'{value}.yaml').is_file()


def run_node(package: str, executable: str, *arguments: str) -> None:
    """Start the node as ros2 run would, and interrupt it."""
    assert (package, executable) == ('gr2t_ros', 'gr2t_node')
    ros = pytest.importorskip('ros_for_tests', reason='ROS 2 is not installed')
    with ros.NodeProcess(ros.Isolation(), Path.cwd(), *arguments[1:]) as node:
        log = node.wait_for('subscribed to')
        assert node.stop(signal.SIGINT) == 0
    heard = re.search(r'subscribed to (.*)', log)[1].split(', ')
    for topic in re.findall(r'-r \S+?:=(\S+)', ' '.join(arguments)):
        assert topic in heard


def call_service(name: str, kind: str) -> None:
    """Call a service of the node, whose map is empty."""
    ros = pytest.importorskip('ros_for_tests', reason='ROS 2 is not installed')
    package, _, message = kind.partition('/srv/')
    isolation = ros.Isolation()
    with ros.NodeProcess(isolation, Path.cwd()) as node:
        observer = ros.Observer(isolation)
        try:
            answer = observer.call(
                getattr(import_module(f'{package}.srv'), message), name.removeprefix('/gr2t/'))
        finally:
            observer.close()
        assert not answer.success and 'nothing to save' in answer.message
        assert node.stop() == 0


def check_pip(words: list[str]) -> None:
    """Check the constraints and the extras that pip is called with."""
    assert (ROOT / words[words.index('-c') + 1]).is_file()
    extras = re.fullmatch(r'\.\[(.*)\]', words[-1])[1]
    for extra in extras.split(','):
        assert f"'{extra}': [" in (ROOT / 'setup.py').read_text()
