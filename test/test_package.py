# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is around the code: the descriptions agree, and pip and colcon install all of it."""
from __future__ import annotations

import ast
from importlib import metadata
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from typing import Any
import xml.etree.ElementTree as ElementTree
import zipfile

import pytest

ROOT = Path(__file__).resolve().parents[1]

# import name -> (requirement in setup.py, rosdep key), where they differ from the import's name
KEYS = {
    'backports': ('backports-zstd', 'python3-rosbags-pip'),  # rosbags needs it too
    'compression': ('backports-zstd', 'python3-rosbags-pip'),  # the same, from Python 3.14 on
    'cv2': ('opencv-python-headless', 'python3-opencv'),
    'llvmlite': ('numba', 'python3-numba'),
    'plyfile': ('plyfile', 'python3-plyfile-pip'),
    'rosbags': ('rosbags', 'python3-rosbags-pip'),
    'trimesh': ('trimesh', 'python3-trimesh-pip'),
    'yaml': ('PyYAML', 'python3-yaml'),
}


def declared(name: str) -> Any:
    """Return a literal argument of the call of setup() in setup.py."""
    for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg == name:
            return ast.literal_eval(node.value)
    raise KeyError(name)


def requirement_name(text: str) -> str:
    """Return the name in a requirement, as pip compares names."""
    return re.sub(r'[-_.]+', '-', re.split(r'[!<>=;\[ ]', text.strip())[0]).lower()


def test_version_is_the_same_in_all_places() -> None:
    in_package = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('version')
    changes = re.findall(
        r'^(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(), re.M)
    assert in_package == declared('version') == changes[0]


def test_package_xml_is_valid() -> None:
    pytest.importorskip('catkin_pkg', reason='catkin_pkg is not installed')
    from catkin_pkg.package import parse_package

    warnings: list[str] = []
    package = parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.package_format == 3
    assert package.get_build_type() == 'ament_python'


def test_every_library_that_is_imported_is_declared() -> None:
    imported = set()
    for file in (ROOT / 'gr2t_ros').rglob('*.py'):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(str(node.module).split('.')[0])
    imported -= {*sys.stdlib_module_names, 'gr2t_ros'}
    depends = {
        str(node.text) for node in ElementTree.parse(ROOT / 'package.xml').getroot()
        if node.tag in ('depend', 'exec_depend')}
    required = {requirement_name(text) for text in declared('install_requires')}
    for name in imported - {'embreex'}:  # an extra
        requirement, key = KEYS.get(name, (name, f'python3-{name}'))
        if name in depends:  # a ROS package
            continue
        assert requirement.lower() in required, f'{name} is missing in setup.py'
        assert key in depends, f'{name} is missing in package.xml'


def test_every_requirement_is_pinned() -> None:
    pinned = {
        requirement_name(line) for file in (ROOT / 'constraints').glob('*.txt')
        for line in file.read_text().splitlines() if not line.startswith('#')}
    required = [
        line for distro in ('kilted', 'jazzy')
        for line in (ROOT / 'scripts' / 'tf2_msgs' / f'{distro}.txt').read_text().splitlines()
        if not line.startswith('#')]
    required += metadata.requires('gr2t_ros') or []
    assert {requirement_name(text) for text in required} <= pinned


@pytest.mark.parametrize('command', ['gr2t', 'gr2t_node'])
def test_command_has_its_function(command: str) -> None:
    if command == 'gr2t_node':
        pytest.importorskip('rclpy', reason='no ROS 2 here')
    entry, = metadata.entry_points(group='console_scripts', name=command)
    assert callable(entry.load())


def test_ament_index_finds_the_share_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    packages = pytest.importorskip('ament_index_python.packages', reason='no ROS 2 here')
    if not (Path(sys.prefix) / 'share' / 'gr2t_ros').exists():
        pytest.skip('gr2t_ros is not installed in this environment')
    monkeypatch.setenv('AMENT_PREFIX_PATH', sys.prefix)
    share = Path(packages.get_package_share_directory('gr2t_ros'))
    assert_share_is_complete(share)


@pytest.mark.parametrize('file', sorted(ROOT.glob('launch/*')), ids=lambda file: str(file.name))
def test_launch_file_parses(file: Path) -> None:
    tree = ast.parse(file.read_text())
    functions = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    assert 'generate_launch_description' in functions


def copy_of_checkout(folder: Path) -> Path:
    """Copy what belongs to the package, so that building leaves nothing in the checkout."""
    copy = folder / 'gr2t_ros'
    copy.mkdir(parents=True)
    for name in ('package.xml', 'setup.py', 'setup.cfg', 'pyproject.toml', 'LICENSE'):
        shutil.copy(ROOT / name, copy)
    for name in ('gr2t_ros', 'resource', 'config', 'launch'):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns('__pycache__'))
    return copy


def run(command: list[str], folder: Path, **extra: str) -> str:
    """Run a command; fail with its output, or return it."""
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **extra}, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
    return done.stdout


def assert_share_is_complete(share: Path) -> None:
    """Compare an installed share folder with the checkout."""
    for file in (ROOT / 'package.xml', *ROOT.glob('config/*'), *ROOT.glob('launch/*.launch.py')):
        installed = share / file.relative_to(ROOT)
        assert installed.read_bytes() == file.read_bytes(), installed


def test_wheel_holds_all(tmp_path: Path) -> None:
    if int(metadata.version('setuptools').split('.')[0]) < 71:
        pytest.importorskip('wheel', reason='this setuptools makes no wheel by itself')
    copy = copy_of_checkout(tmp_path)
    run([sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation',
         '--wheel-dir', str(tmp_path), str(copy)], tmp_path)
    wheel, = tmp_path.glob('*.whl')
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / 'wheel')
    data, = (tmp_path / 'wheel').glob('*.data/data')
    assert_share_is_complete(data / 'share' / 'gr2t_ros')
    assert (data / 'share/ament_index/resource_index/packages/gr2t_ros').is_file()
    modules = {file.relative_to(ROOT) for file in (ROOT / 'gr2t_ros').rglob('*.py')}
    assert all((tmp_path / 'wheel' / module).is_file() for module in modules)
    info, = (tmp_path / 'wheel').glob('*.dist-info')
    assert 'gr2t_node = gr2t_ros.ros:main' in (info / 'entry_points.txt').read_text()


def test_colcon_builds_and_tests_it(tmp_path: Path) -> None:
    beside_python = Path(sys.executable).parent
    path = f'{beside_python}{os.pathsep}{os.environ["PATH"]}'
    colcon = shutil.which('colcon', path=path)
    if colcon is None:
        pytest.skip('colcon is not installed')
    tests = copy_of_checkout(tmp_path / 'src') / 'test'
    tests.mkdir()
    shutil.copy(ROOT / 'test' / 'test_share.py', tests)
    here = {'PATH': path, 'COLCON_HOME': str(tmp_path / 'home')}
    run([colcon, 'build'], tmp_path, **here)
    prefix = tmp_path / 'install' / 'gr2t_ros'
    assert_share_is_complete(prefix / 'share' / 'gr2t_ros')
    assert (prefix / 'share/ament_index/resource_index/packages/gr2t_ros').is_file()
    commands = prefix / 'lib' / 'gr2t_ros'
    assert os.access(commands / 'gr2t_node', os.X_OK)
    # The shell that sources it runs the installed copy, with the installed presets.
    shell = f'. {tmp_path}/install/local_setup.sh && '
    assert 'replay' in run(['sh', '-c', f'{shell}{commands / "gr2t"} --help'], tmp_path, **here)
    found = run(['sh', '-c', f'{shell}{sys.executable} -c "from gr2t_ros import share; '
                             'print(share.share_directory())"'], tmp_path, **here)
    assert Path(found.strip().splitlines()[-1]) == prefix / 'share' / 'gr2t_ros'

    run([colcon, 'test'], tmp_path, **here)
    assert 'Summary: 4 tests, 0 errors, 0 failures' in run(
        [colcon, 'test-result'], tmp_path, **here)
