# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The report's numbers are those of the run, under the names that are documented."""
from collections import Counter
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gr2t_ros.core.next_views import NextView
from gr2t_ros.errors import Gr2tError
from gr2t_ros.io.parts import Parts
from gr2t_ros.settings import Settings
from gr2t_ros.tools import report

SPREAD = {'mean', 'p50', 'p95'}


@pytest.fixture
def run() -> report.Run:
    """Return a run whose numbers are easy."""
    run = report.Run(
        Settings(), Parts(Path), read=12, integrated=10, keyframes=2, dropped=Counter(no_pose=2),
        explanations={'no_pose': 'no pose at all', 'bad_transform': 'a NaN transform'},
        marched=100, remarched=50, converged=140, loop_seconds=4.0, startup_seconds=1.5,
        finish_seconds=0.5, first_stamp_ns=10 ** 18, last_stamp_ns=10 ** 18 + 2 * 10 ** 9)
    run.seconds['integrate'] = [0.001 * i for i in range(101)]
    return run


def test_the_keys_are_those_of_the_documentation(run: report.Run) -> None:
    content = report.report(run, {'vertices': 3, 'faces': 1}, np.arange(101.0))
    assert set(content) == {
        'frames', 'rays', 'timing_ms', 'frames_per_second', 'realtime_factor', 'peak_memory_mb',
        'mesh', 'parts', 'likelihood', 'next_views', 'startup_s', 'finish_s', 'input_damage',
        'settings'}
    assert content['frames'] == {
        'read': 12, 'integrated': 10, 'keyframes': 2, 'dropped': {'no_pose': 2}}
    assert content['rays'] == {'marched': 100, 'remarched': 50, 'converged': 140}
    assert set(content['timing_ms']) == {'read', 'integrate', 'march', 'mesh', 'total'}
    assert all(set(entry) == SPREAD for entry in content['timing_ms'].values())
    assert content['likelihood'] == {'max': 100.0, 'p50': 50.0, 'p98': 98.0}
    assert content['parts'] == {'keyframes': 0, 'vertices': 0, 'edges': 0, 'faces': 0}
    assert content['settings']['depth_max'] == Settings().depth_max


def test_rates_and_percentiles(run: report.Run) -> None:
    content = report.report(run, {}, [])
    assert content['frames_per_second'] == 2.5
    assert content['realtime_factor'] == 0.5
    assert content['timing_ms']['integrate'] == pytest.approx(
        {'mean': 50.0, 'p50': 50.0, 'p95': 95.0})
    assert content['timing_ms']['march'] == {'mean': 0.0, 'p50': 0.0, 'p95': 0.0}
    assert 10 < content['peak_memory_mb'] < 1e6


def test_views_to_scan_next_are_named(run: report.Run) -> None:
    """In the report all of them with their orientation, in the table the best three."""
    T_world_camera = np.array([[0, 0, 1, -1.0], [-1, 0, 0, 0.5], [0, -1, 0, 0.25], [0, 0, 0, 1]])
    run.next_views = 4 * (NextView(np.array([0.1, 0.2, 0.3]), 0.0121, T_world_camera),)
    content = report.report(run, {'vertices': 3}, [])
    found = json.loads(json.dumps(content))['next_views']
    assert len(found) == 4
    assert (found[0]['position'], found[0]['area_m2']) == ([0.1, 0.2, 0.3], 0.0121)
    assert found[0]['viewpoint']['position'] == [-1.0, 0.5, 0.25]
    turn = Rotation.from_quat(found[0]['viewpoint']['orientation'])
    np.testing.assert_allclose(turn.as_matrix(), T_world_camera[:3, :3], atol=1e-9)
    lines = report.table(content, run, {}).splitlines()
    assert [line for line in lines if line.startswith('next ')] == 3 * [
        'next     about 0.012 m² missing or doubtful at (0.10, 0.20, 0.30): look from '
        '(-1.00, 0.50, 0.25)']


def test_it_is_written_as_json_or_not_at_all(run: report.Run, tmp_path: Path) -> None:
    content = report.report(run, {'vertices': 0, 'faces': 0}, [])
    report.write(tmp_path / 'report.json', content)
    assert json.loads((tmp_path / 'report.json').read_text()) == json.loads(json.dumps(content))
    with pytest.raises(Gr2tError, match=r'cannot write .*report\.json/no'):
        report.write(tmp_path / 'report.json' / 'no', content)


def test_the_table_names_files_and_reasons(run: report.Run) -> None:
    run.input_damage = 'used up to 3 s'
    text = report.table(
        report.report(run, {}, []), run, {'out/mesh.ply': '3 vertices', 'out/preview.png': ''})
    lines = text.splitlines()
    assert lines[:3] == [
        'out/mesh.ply     3 vertices', 'out/preview.png',
        'frames   12 read, 10 integrated, 2 keyframes, 2 dropped']
    assert 'dropped  2 no_pose: no pose at all' in lines
    assert 'note     a NaN transform' in lines
    assert 'damage   used up to 3 s' in lines
    assert 'rays     100 marched, 50 times again; 93.3 % converged' in lines


def test_an_empty_mesh_is_said(run: report.Run) -> None:
    for vertices in (0, 3):
        text = report.table(report.report(run, {'vertices': vertices}, []), run, {})
        assert ('the mesh is empty' in text) == (vertices == 0)
