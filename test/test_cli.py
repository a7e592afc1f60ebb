# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What cannot be used is answered with one line and an exit code, never with a traceback."""
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

import bags_for_tests as bags
from bags_for_tests import DEPTH, INFO, Message
import numpy as np
import pytest

from gr2t_ros.settings import Settings
from gr2t_ros.tools import cli, info, options

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def gr2t(capsys: pytest.CaptureFixture[str], tmp_path: Path,
         monkeypatch: pytest.MonkeyPatch) -> Call:
    """Return the command line as a function to exit code, stdout and stderr."""
    monkeypatch.setattr('gr2t_ros.tools.results.warm_up', lambda _: 0.0)
    monkeypatch.chdir(tmp_path)

    def call(*arguments: Any) -> tuple[int, str, str]:
        code = cli.main([str(item) for item in arguments])
        printed = capsys.readouterr()
        assert 'Traceback' not in printed.err
        return code, printed.out, printed.err
    return call


def test_help_is_quick_and_lists_the_commands() -> None:
    # nothing that takes a second to import
    code = ('import sys\nfrom gr2t_ros.tools.cli import main\n'
            'try:\n    main(["--help"])\nfinally:\n'
            '    assert not {"numba", "cv2", "rosbags", "trimesh"} & set(sys.modules)')
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert result.returncode == 0
    for command in ('replay', 'info', 'simulate', 'evaluate', 'view', 'convert'):
        assert f'\n    {command} ' in result.stdout


def test_version_is_printed() -> None:
    result = subprocess.run(
        [sys.executable, '-m', 'gr2t_ros.tools.cli', '--version'], capture_output=True, text=True)
    assert (result.returncode, result.stdout.split()[0]) == (0, 'gr2t_ros')


@pytest.mark.parametrize(('arguments', 'line'), [
    ([], 'gr2t: the following arguments are required: COMMAND; see gr2t --help'),
    (['reply'], "gr2t: argument COMMAND: invalid choice: 'reply'"),
    (['info'], 'gr2t: the following arguments are required: BAG; see gr2t info --help'),
    (['replay', 'a.bag', '--star', 'soon'],
     'gr2t: argument --start: must be a time in seconds, not soon'),
    (['replay', 'a.bag', '--start', '-1'], 'gr2t: argument --start: must be a time in seconds'),
    (['replay', 'a.bag', '--max-frames', '0'],
     'gr2t: argument --max-frames: must be a whole number of at least 1, not 0'),
    (['replay', 'a.bag', '--max-frames', 'ten'],
     'gr2t: argument --max-frames: must be a whole number of at least 1, not ten'),
    (['replay', 'a.bag', '--frames', '3'], 'gr2t: unknown argument --frames 3 '
     '(did you mean --max-frames?); see gr2t replay --help'),
    (['evaluate', 'a', 'b', 'c'], 'gr2t: unknown argument c; see gr2t evaluate --help'),
    (['replay', 'a.bag', '-p', 'dept_max:=3'],
     'gr2t: unknown parameter dept_max; did you mean depth_max?'),
    (['replay', 'a.bag', '-p', 'depth_max=3'], 'gr2t: -p depth_max=3: write it as name:=value'),
    (['replay', 'a.bag', '-p', 'depth_max:=-3'],
     'gr2t: parameter depth_max must lie in [0, 1000] m'),
    (['replay', 'a.bag', '-p', 'depth_max:=far'],
     "gr2t: parameter depth_max must be a number, not 'far'"),
    (['replay', 'a.bag', '--params', 'none.yaml'], 'gr2t: none.yaml: No such file'),
    (['replay', 'a.bag', '--preset', 'none'], 'gr2t: there is no preset none; known are azure'),
    (['replay', 'none.bag'], 'gr2t: none.bag: no such file or folder'),
])
def test_a_call_that_cannot_be_used_is_one_line(
    gr2t: Call, arguments: list[str], line: str
) -> None:
    code, out, err = gr2t(*arguments)
    assert (code, out) == (2, '')
    assert err.startswith(line)
    assert err.count('\n') == 1


def without(topic: str) -> list[Message]:
    """Return a good recording without a topic."""
    return [message for message in bags.scan() if message.topic != topic]


def with_images(data: Any, encoding: str = '16UC1') -> list[Message]:
    """Return a recording with other images."""
    return [*without(DEPTH), *(bags.image(i, data=data, encoding=encoding) for i in range(3))]


def with_tf(**options: Any) -> list[Message]:
    """Return a recording with other transforms."""
    return [*without('/tf'), *(bags.transform(i - 0.5, **options) for i in range(5))]


def ones(value: float, dtype: Any) -> Any:
    """Return an image of one value."""
    return np.full((bags.HEIGHT, bags.WIDTH), value, dtype)


NAN = np.full((4, 4), np.nan)
NAN[:3, :3] = np.eye(3)

BAD_RECORDINGS = {
    'no depth': (without(DEPTH), 'holds no depth images .* record the depth topic'),
    'no camera_info': (without(INFO), f'holds no camera_info for {DEPTH}; record {INFO} too'),
    'no poses': ([message for message in without('/tf') if message.topic != '/tf_static'],
                 f'no poses of the camera .frame {bags.OPTICAL}.: record /tf and /tf_static, or'),
    'unconnected tf': (without('/tf_static'),
                       f"tf does not know '{bags.OPTICAL}'.* but camera_link, map; record"),
    'tf in parts': (with_tf(child='base_link'),
                    'static transforms only.* record what localises it'),
    'unknown encoding': (with_images(ones(1, np.uint8), '8UC1'),
                         f"{DEPTH} has the encoding '8UC1'; 16UC1, mono16, 32FC1 can be used"),
    'wrong size': ([*without(INFO), bags.camera_info(0, width=64)],
                   '3 of 3: depth image is 32x24 pixels, but its camera_info is for 64x24'),
    'all invalid': (with_images(ones(0, np.uint16)), '3 of 3: depth image has no valid pixel'),
    '1000 times too large': (with_images(ones(1000, np.float32), '32FC1'),
                             '3 of 3: the depths have a median of 1e.03 m, as if their unit'),
    '1000 times too small': (with_images(ones(1, np.uint16)),
                             '3 of 3: the depths have a median of 0.001 m, as if their unit'),
    'too far': (with_images(ones(9000, np.uint16)),
                'no depth of the image lies within depth_min 0.1 m and depth_max 5 m'),
    'NaN poses': (with_tf(T=NAN), 'transform from camera_link to map .*not finite'),
    'unnormalised quaternions': (with_tf(scale=2.0),
                                 'from camera_link to map .*a quaternion that is not of length 1'),
    'zero K': ([*without(INFO), bags.camera_info(0, focal=0.0)],
               '3 of 3: camera_info has focal length 0, 0 px: the camera is not calibrated'),
    'other frame': ([*without(INFO), bags.camera_info(0, frame='elsewhere')],
                    f'of frame {bags.OPTICAL}, but camera_info only of elsewhere'),
}


@pytest.mark.parametrize('case', BAD_RECORDINGS)
def test_a_recording_that_cannot_be_used_is_one_line(
    gr2t: Call, tmp_path: Path, case: str
) -> None:
    messages, sentence = BAD_RECORDINGS[case]
    code, out, err = gr2t('replay', bags.write(tmp_path / 'scan', messages), '-o', 'out')
    assert (code, out) == (2, '')
    line = err.splitlines()[-1]
    assert line.startswith('gr2t: ')
    assert re.search(sentence, line), line
    assert not list(tmp_path.glob('out/*'))


@pytest.mark.parametrize('kind', ['rosbag1', 'sqlite3 bare', 'mcap bare', 'mcap'])
@pytest.mark.parametrize('keep', [0, 100])
def test_a_file_of_which_nothing_is_left_is_one_line(
    gr2t: Call, tmp_path: Path, kind: str, keep: int
) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(), kind)
    file = path / 'scan.mcap' if path.is_dir() else path
    file.write_bytes(file.read_bytes()[:keep])
    code, _, err = gr2t('info', path)
    assert code == 2
    assert err.startswith(
        f'gr2t: {path} cannot be read: it is no bag, or nothing of it is left. {file} is damaged')
    assert err.count('\n') == 1


@pytest.mark.parametrize('kind', ['rosbag1', 'sqlite3 bare', 'mcap bare', 'mcap'])
def test_info_says_what_is_left_of_a_file_that_was_cut_off(
    gr2t: Call, tmp_path: Path, kind: str
) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(20), kind)
    file = path / 'scan.mcap' if path.is_dir() else path
    file.write_bytes(file.read_bytes()[:file.stat().st_size * 3 // 4])
    code, out, _ = gr2t('info', path)
    assert code == 0
    assert f'{bags.DEPTH} (' in out
    assert f'\ndamage\n  {file} is damaged (' in out
    assert 'messages can be read' in out or 'messages of' in out


def test_other_files_and_folders_are_no_bags(gr2t: Call, tmp_path: Path) -> None:
    (tmp_path / 'notes.txt').write_text('no bag')
    (tmp_path / 'noise.bag').write_bytes(bytes(range(256)) * 10)
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'scan.mcap').touch()
    (tmp_path / 'folder' / 'walk.mcap').touch()
    (tmp_path / 'empty').mkdir()
    for name, sentence in (
            ('notes.txt', 'is not a bag'), ('noise.bag', 'noise.bag cannot be read: it is no bag'),
            ('folder', 'and files of several recordings; name those of one: folder/scan.mcap'),
            ('empty', 'has no metadata.yaml and no .bag, .mcap or .db3 file')):
        code, _, err = gr2t('info', name)
        assert code == 2
        assert sentence in err
        assert err.count('\n') == 1


def test_an_output_that_cannot_be_written_is_said_first(gr2t: Call, tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    path = bags.write(tmp_path / 'scan', bags.scan())
    code, _, err = gr2t('replay', path, '-o', 'file/out')
    assert code == 2
    assert err.startswith('gr2t: cannot write to the folder file/out: ')


def test_info_lists_topics_and_what_replay_would_use(gr2t: Call, tmp_path: Path) -> None:
    code, out, _ = gr2t('info', bags.write(tmp_path / 'scan', bags.scan()))
    assert code == 0
    lines = [' '.join(line.split()) for line in out.splitlines()]
    assert lines[0].endswith('scan: 0.4 s, 12 messages, 4 topics')
    assert f'3 {DEPTH} sensor_msgs/msg/Image' in lines
    assert lines[-3].startswith(f'depth {DEPTH} (3 images; rectified')
    assert lines[-2:] == [f'camera_info {INFO}', 'poses /tf /tf_static (tf)']


def test_a_reader_of_the_output_may_stop_early(tmp_path: Path) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan())
    command = f'{sys.executable} -m gr2t_ros.tools.cli info {path} | true'
    result = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert result.stderr == ''


def test_info_says_what_is_ambiguous_or_missing(gr2t: Call, tmp_path: Path) -> None:
    other = '/other/depth/image'
    code, out, _ = gr2t('info', bags.write(
        tmp_path / 'two', [*bags.scan(), bags.image(0, other)]))
    assert code == 0
    assert ('several depth topics; add one of\n'
            f'  --depth-topic {DEPTH}\n  --depth-topic {other}\n') in out
    code, out, _ = gr2t('info', bags.write(tmp_path / 'none', without('/tf')))
    assert code == 0
    assert 'holds no poses of the camera' in out


def parsed(*arguments: str) -> Settings:
    """Return the parameters that options give."""
    parser = cli._Parser()
    options.add_arguments(parser)
    return options.settings(parser.parse_args(arguments))


def test_parameters_win_over_the_file_and_that_over_the_preset(tmp_path: Path) -> None:
    file = tmp_path / 'my.yaml'
    file.write_text(
        '/**:\n  ros__parameters: {depth_max: 2.0, use_sim_time: true, ray_stride: 2}\n'
        'gr2t:\n  ros__parameters: {ray_stride: 3, world_frame: earth}\n'
        'other:\n  ros__parameters: {speed: 3}\n')
    assert parsed() == Settings()
    preset = parsed('--preset', 'tabletop_scan')
    assert (preset.depth_min, preset.depth_max) == (0.15, 1.0)
    both = parsed('--preset', 'tabletop_scan', '--params', str(file), '-p', 'depth_max:=3',
                  '-p', 'world_frame:="my map"')
    assert both == replace(preset, depth_max=3.0, ray_stride=3, world_frame='my map')


@pytest.mark.parametrize(('content', 'sentence'), [
    ('gr2t: {ros__parameters: {dept_max: 2}}', 'unknown parameter dept_max; did you mean'),
    ('gr2t: {ros__parameters: {depth_max: -2}}', 'parameter depth_max must lie in'),
    ('camera: {ros__parameters: {depth_max: 2}}', 'not a ROS parameter file for this node'),
    ('depth_max: 2', 'not a ROS parameter file for this node'),
    ('[1, 2', 'not a YAML file'), ('', 'not a ROS parameter file')])
def test_a_wrong_parameter_file_is_named(
    gr2t: Call, tmp_path: Path, content: str, sentence: str
) -> None:
    (tmp_path / 'my.yaml').write_text(content)
    code, _, err = gr2t('replay', 'a.bag', '--params', 'my.yaml')
    assert code == 2
    assert err.startswith(f'gr2t: my.yaml: {sentence}')
    assert err.count('\n') == 1


def test_what_nobody_expected_is_a_line_too(
    gr2t: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(_: Any) -> int:
        raise ZeroDivisionError('by zero')

    def stops(_: Any) -> int:
        raise KeyboardInterrupt
    monkeypatch.setattr(info, 'run', fails)
    assert gr2t('info', 'a.bag') == (
        1, '', 'gr2t: unexpected ZeroDivisionError: by zero (--debug shows where)\n')
    assert cli.main(['info', 'a.bag', '--debug']) == 1
    assert 'Traceback' in capsys.readouterr().err
    monkeypatch.setattr(info, 'run', stops)
    assert gr2t('info', 'a.bag')[0] == 130
