# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t convert` says what became of a mesh."""
from pathlib import Path

import pytest
from test_formats import surface

from gr2t_ros.io import formats
from gr2t_ros.tools import cli


def test_a_mesh_changes_its_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip('fast_simplification')
    formats.write(tmp_path / 'mesh.ply', surface())
    files = [str(tmp_path / name) for name in ('mesh.ply', 'mesh.glb', 'mesh.stl')]
    assert cli.main(['convert', *files[:2]]) == 0
    assert ' 642 vertices, 1280 faces, 0.0 MB' in capsys.readouterr().out
    assert cli.main(['convert', *files[1:], '--max-faces', '200']) == 0
    out = capsys.readouterr().out
    assert '200 faces of 1280' in out
    assert 'note: STL files hold the surface alone' in out
    assert len(formats.read(tmp_path / 'mesh.stl').faces) == 200


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['mesh.ply', 'mesh.doc'], 'gr2t: mesh.doc must end in .ply, .glb, .obj or .stl: the ending'),
    (['mesh.ply', 'mesh.glb'], 'gr2t: there is no mesh mesh.ply'),
    (['mesh.ply', 'mesh.glb', '--max-faces', '0'],
     'gr2t: argument --max-faces: must be a whole number of at least 1')])
def test_a_call_that_cannot_be_used_is_one_line(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(['convert', *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith(sentence)
    assert error.count('\n') == 1
