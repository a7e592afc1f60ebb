# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Make, or bring up to date, the virtual environment that `make` runs everything in.

Where ROS 2 is sourced its rclpy and its numpy are used; elsewhere they come as wheels, and
tf2_msgs, of which there is no wheel, is built. Runs on the standard library alone.
"""
import argparse
import hashlib
import json
import os
from pathlib import Path
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parents[1]
OLDEST, NEWEST = (3, 10), (3, 13)
WHEELS = ('kilted', 'jazzy')
# What the environment is made from: a change in one of these remakes it.
SOURCES = ('setup.py', 'setup.cfg', 'constraints/*.txt', 'scripts/setup_venv.py',
           'scripts/tf2_msgs/**/*.*')

PROBE = """
import importlib.util, json, os, sys, sysconfig
numpy = None
if os.environ.get('ROS_DISTRO'):
    try:
        import rclpy
        from numpy import __version__ as numpy
    except ImportError:
        pass
print(json.dumps({
    'version': sys.version_info[:2], 'prefix': sys.base_prefix,
    'executable': getattr(sys, '_base_executable', sys.executable),
    'venv': all(map(importlib.util.find_spec, ('venv', 'ensurepip'))), 'numpy': numpy,
    'header': os.path.join(sysconfig.get_path('include'), 'Python.h')}))
"""

CHECK = """
from rclpy.type_support import check_for_type_support
from tf2_msgs.msg import TFMessage
import gr2t_ros, numba
check_for_type_support(TFMessage)
"""


class SetupError(Exception):
    """Something is missing: one sentence that says what, and the way out."""


class Log:
    """Keeps the whole output in a file and shows where things stand."""

    def __init__(self, path: Path, steps: int) -> None:
        self.path = path
        self.start = time.monotonic()
        self._steps = steps
        self._step = 0
        self._shown = self.start
        self._tty = sys.stdout.isatty()
        path.write_text('')

    def step(self, what: str) -> None:
        """Begin the next step."""
        self._step += 1
        print(f'[{self._step}/{self._steps}] {what}', flush=True)

    def line(self, text: str) -> None:
        """Take one line of output: live on a terminal, else one every ten seconds."""
        with self.path.open('a') as file:
            file.write(text)
        now = time.monotonic()
        text = text.strip()
        if text.startswith('Installing collected packages'):
            text = f'installing {text.count(",") + 1} packages'
        if self._tty:
            width = shutil.get_terminal_size().columns - 6
            print(f'\r\033[K    {text[:width]}', end='', flush=True)
        elif now - self._shown > 10:
            self._shown = now
            print(f'    {now - self.start:3.0f} s: {text[:80]}', flush=True)

    def end(self) -> None:
        """Clear the live line."""
        if self._tty:
            print('\r\033[K', end='', flush=True)


def clean_environment(**extra: str) -> 'dict[str, str]':
    """Return this process's environment without what would mislead another interpreter."""
    # The first is inherited from a Python that the ROS wheels have started anew; another
    # environment's Python would then not look for its own libraries.
    mislead = ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'PYTHONHOME', 'MAKEFLAGS', 'MFLAGS', 'MAKELEVEL')
    return {**{k: v for k, v in os.environ.items() if k not in mislead}, **extra}


def run(command: 'list[object]', failure: str, log: Log, **extra: str) -> None:
    """Run a command, its output to the log; on failure show the end of it."""
    words = [str(word) for word in command]
    with log.path.open('a') as file:
        file.write(f'$ {" ".join(words)}\n')
    with subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding='utf-8',
            errors='replace', env=clean_environment(**extra), cwd=str(ROOT)) as process:
        for text in process.stdout or ():
            log.line(text)
    log.end()
    if process.returncode:
        for text in log.path.read_text().splitlines()[-15:]:
            print(f'    {text[:150]}', flush=True)
        raise SetupError(f'{failure}; the whole output is in {log.path}')


def probe(python: str) -> dict:
    """Ask an interpreter what it is."""
    try:
        answer = subprocess.run(
            [python, '-c', PROBE], check=True, stdout=subprocess.PIPE, encoding='utf-8',
            env=clean_environment())
    except (OSError, subprocess.CalledProcessError) as error:
        raise SetupError(f'{python} cannot be run ({error}): name a Python 3.10 to 3.13 with '
                         'make venv PYTHON=...') from None
    return json.loads(answer.stdout)


def check_machine(python: dict, sourced: str) -> None:
    """Raise SetupError for the first thing that the set-up needs and the machine lacks."""
    version = '.'.join(map(str, python['version']))
    if not OLDEST <= tuple(python['version']) <= NEWEST:
        raise SetupError(
            f'Python {version} ({python["executable"]}) is not one of 3.10 to 3.13: name another '
            'with make venv PYTHON=python3.12')
    if not python['venv']:
        raise SetupError(
            f'Python {version} ({python["executable"]}) has no venv module: install it '
            f'(Debian and Ubuntu: apt install python{version}-venv)')
    if sourced:
        if not python['numpy']:
            raise SetupError(
                f'ROS 2 {sourced} is sourced, but {python["executable"]} cannot import its rclpy: '
                'name the Python that it was built for (make venv PYTHON=/usr/bin/python3), or '
                'use a shell without ROS for the wheels')
        return
    if (sys.platform, platform.machine()) != ('linux', 'x86_64'):
        raise SetupError(
            f'there are no ROS 2 wheels for {sys.platform} on {platform.machine()}: install ROS 2 '
            'and source its setup.bash first')
    if not shutil.which('cmake'):
        raise SetupError('cmake is missing (Debian and Ubuntu: apt install cmake)')
    for variable, names in (('CC', ('cc', 'gcc', 'clang')), ('CXX', ('c++', 'g++', 'clang++'))):
        if not os.environ.get(variable) and not any(map(shutil.which, names)):
            raise SetupError(
                f'a {"C++" if variable == "CXX" else "C"} compiler is missing (Debian and Ubuntu: '
                'apt install build-essential)')
    if not os.path.isfile(python['header']):
        raise SetupError(
            f'the C headers of Python {version} are missing ({python["header"]}; Debian and '
            f'Ubuntu: apt install python{version}-dev)')


def build_tf2_msgs(venv: Path, log: Log) -> None:
    """Generate, compile and install the messages of /tf into the environment."""
    python = venv / 'bin' / 'python'
    include, site, numpy = subprocess.run(
        [str(python), '-c', 'import numpy, sysconfig; print(sysconfig.get_path("include"), '
         'sysconfig.get_path("purelib"), numpy.get_include(), sep="\\n")'],
        check=True, stdout=subprocess.PIPE, encoding='utf-8', env=clean_environment(),
    ).stdout.splitlines()
    # The wheels' CMake files name the headers of the interpreter that they were built with.
    built_with = r'[^;"\s]*/cp3\d+-cp3\d+/'
    for file in venv.glob('share/*/cmake/*.cmake'):
        text = file.read_text()
        new = re.sub(built_with + r'include/python3\.\d+', include, text)
        new = re.sub(built_with + r'lib/python3\.\d+/site-packages/numpy/\w+/include', numpy, new)
        new = re.sub(built_with + r'lib/python3\.\d+/site-packages', site, new)
        if new != text:
            file.write_text(new)
    here = {'PATH': f'{venv / "bin"}{os.pathsep}{os.environ["PATH"]}',
            'AMENT_PREFIX_PATH': str(venv), 'CMAKE_PREFIX_PATH': str(venv)}
    failure = 'building tf2_msgs failed'
    with tempfile.TemporaryDirectory(prefix='tf2_msgs-') as build:
        run(['cmake', '-S', ROOT / 'scripts' / 'tf2_msgs', '-B', build,
             f'-DCMAKE_INSTALL_PREFIX={venv}', '-DCMAKE_BUILD_TYPE=Release',
             f'-DPython3_EXECUTABLE={python}', '-DBUILD_TESTING=OFF'], failure, log, **here)
        run(['cmake', '--build', build, '--target', 'install', '--parallel',
             os.cpu_count() or 1], failure, log, **here)


def link_share(venv: Path) -> None:
    """
    Put the package's share folder and its ament marker into the environment.

    An editable install leaves them out. Each file is a link, so that edits take effect.
    """
    share = venv / 'share'
    shutil.rmtree(share / 'gr2t_ros', ignore_errors=True)
    files = {ROOT / 'resource' / 'gr2t_ros': share / 'ament_index/resource_index/packages'}
    for file in (ROOT / 'package.xml', *ROOT.glob('config/*'), *ROOT.glob('launch/*.launch.py')):
        files[file] = share / 'gr2t_ros' / file.parent.relative_to(ROOT)
    for file, folder in files.items():
        folder.mkdir(parents=True, exist_ok=True)
        link = folder / file.name
        if link.is_symlink() or link.exists():
            link.unlink()
        link.symlink_to(file)


def make(venv: Path, python: dict, distro: str, sourced: str, extras: 'list[str]') -> None:
    """Create the environment where it is missing, and install all that belongs in it."""
    venv.mkdir(parents=True, exist_ok=True)
    log = Log(venv / 'setup.log', 3 if sourced else 4)
    log.step('virtual environment')
    if not (venv / 'pyvenv.cfg').exists():
        options = ['--system-site-packages'] if sourced else []
        run([python['executable'], '-m', 'venv', *options, venv],
            'making the virtual environment failed', log)

    pip = [venv / 'bin' / 'python', '-m', 'pip', 'install', '--no-input', '--progress-bar', 'off',
           '--disable-pip-version-check']
    failure = 'installing the packages failed (is the package index reachable?)'
    if sourced:
        # Its message packages are compiled against this numpy.
        log.step(f'packages that go with numpy {python["numpy"]}')
        numpy = venv / 'numpy.txt'
        numpy.write_text(f'numpy=={python["numpy"]}\n')
        known = ['-c', 'constraints/numpy1.txt'] if python['numpy'].startswith('1.') else []
        run([*pip, '-c', numpy, *known, '-e', f'.[{",".join(extras)}]'], failure, log)
    else:
        log.step('packages, a minute or two')
        run([*pip, '-c', 'constraints/python.txt', '-c', f'constraints/{distro}.txt',
             '-r', f'scripts/tf2_msgs/{distro}.txt', '-e', f'.[{",".join([distro, *extras])}]'],
            failure, log)
        log.step('tf2_msgs, built here since it has no wheel')
        build_tf2_msgs(venv, log)

    log.step('check')
    run([venv / 'bin' / 'python', '-c', CHECK],
        'the environment is made but does not work: remove it and try again', log)
    print(f'{venv.name} is ready ({time.monotonic() - log.start:.0f} s)', flush=True)


def set_up(venv: Path, distro: str, extras: 'list[str]', chosen: str) -> None:
    """Make the environment, unless it is there and nothing that it is made from has changed."""
    sourced = os.environ.get('ROS_DISTRO', '')
    stamp = venv / 'gr2t_setup.json'
    own_python = venv / 'bin' / 'python'
    made = json.loads(stamp.read_text()) if own_python.exists() and stamp.exists() else {}
    # Without a wish, the Python of an environment that is there stays.
    python = probe(chosen or (str(own_python) if made and not sourced else sys.executable))
    kind = {'python': [*python['version'], python['prefix']], 'numpy': python['numpy'],
            'ros': f'ROS 2 {sourced}' if sourced else f'ROS 2 {distro} from wheels'}
    keep = bool(made) and all(made[key] == value for key, value in kind.items())
    if keep:
        extras = sorted({*extras, *made['extras']})
    digest = hashlib.sha256()
    for file in sorted(file for pattern in SOURCES for file in ROOT.glob(pattern)):
        digest.update(file.read_bytes())
    plan = {**kind, 'extras': extras, 'sources': digest.hexdigest()}
    if made != plan:
        check_machine(python, sourced)
        if keep:
            stamp.unlink()
        elif venv.exists():
            if any(venv.iterdir()) and not (venv / 'pyvenv.cfg').exists():
                raise SetupError(f'{venv} is in the way: it is not a virtual environment')
            shutil.rmtree(venv)
        print(f'Setting up {venv.name}: Python {"{}.{}".format(*python["version"])}, '
              f'{kind["ros"]}', flush=True)
        make(venv, python, distro, sourced, extras)
        stamp.write_text(json.dumps(plan))
    link_share(venv)


def main() -> None:
    """Parse the options; a SetupError becomes one line and exit code 2."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--venv', type=Path, default=Path('.venv'), help='its folder (.venv)')
    parser.add_argument('--distro', choices=WHEELS, default=WHEELS[0],
                        help='ROS 2 wheels, where no ROS 2 is sourced (kilted)')
    parser.add_argument('--extras', default='dev,simulation', help='extras of setup.py')
    parser.add_argument('--python', default='', help='interpreter to make it with (python3)')
    args = parser.parse_args()
    try:
        set_up((ROOT / args.venv).resolve(), args.distro, sorted(args.extras.split(',')),
               args.python)
    except SetupError as error:
        print(f'set-up: {error}', file=sys.stderr)
        sys.exit(2)


if __name__ == '__main__':
    main()
