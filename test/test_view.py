# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The page shows the mesh: seen through a real browser, with a real mouse."""
from collections.abc import Iterator
from pathlib import Path
import re

from browser_for_tests import Browser, browser
import numpy as np
from numpy.typing import NDArray
import pytest
import trimesh

from gr2t_ros.io import formats, trajectory
from gr2t_ros.tools import cli, view
from gr2t_ros.tools.orbit import orbit

MIDDLE = np.array((1.0, 2.0, 3.0))
RADIUS = 0.1  # m
CENTRE = (450.0, 250.0)  # pixels, near the middle of the page: on the ball


def ball() -> formats.Mesh:
    """Return a ball that is more likely, and in sigma less sure, the higher up."""
    found = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    height = (found.vertices[:, 2] / RADIUS + 1) / 2
    return formats.Mesh(
        found.vertices + MIDDLE, np.array(found.faces, np.int32), None,
        {'likelihood': (3e-6 * height).astype(np.float32),
         'sigma': (2e-3 * height).astype(np.float32),
         'confidence': np.full(len(height), 0.8, np.float32)})


def write_replay(folder: Path) -> None:
    """Write what a replay leaves, as far as a page is made of it."""
    formats.write(folder / 'mesh.ply', ball())
    poses = orbit(MIDDLE, 0.35, 6)
    trajectory.write(folder / 'cameras.txt', [(10 ** 9 * i, pose) for i, pose in enumerate(poses)])


@pytest.fixture(scope='module')
def chromium() -> Iterator[Browser]:
    """Return a browser; without Chromium the test is skipped."""
    with browser() as found:
        yield found


@pytest.fixture
def page(chromium: Browser, tmp_path: Path) -> Iterator[Browser]:
    """Return a browser that shows the ball."""
    write_replay(tmp_path)
    assert cli.main(['view', str(tmp_path)]) == 0
    chromium.errors.clear()
    chromium.open(tmp_path / 'mesh.html')
    for _ in range(2):  # away from the panel
        chromium.wheel(CENTRE, 300)
    yield chromium
    assert chromium.errors == []


def mesh_of(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where a picture, right of the panel, differs from its background of greys."""
    part = picture[:, 300:].astype(int)
    return np.ptp(part, axis=2) > 40


def spread(picture: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Return the column, the row and the share of the pixels that show the mesh."""
    seen = mesh_of(picture)
    rows, columns = np.nonzero(seen)
    return float(columns.mean()) + 300, float(rows.mean()), float(seen.mean())


def text(page: Browser, name: str) -> str:
    """Return the text of an element."""
    return str(page.run(f"document.getElementById('{name}').innerText"))


def test_the_mesh_is_shown_in_its_colours(page: Browser) -> None:
    picture = page.picture()
    _, _, share = spread(picture)
    assert 0.05 < share < 0.4
    rows = np.flatnonzero(mesh_of(picture).any(axis=1))
    above, below = (
        picture[row, 300:][mesh_of(picture)[row]].mean(axis=0)
        for row in (rows[len(rows) // 8], rows[-len(rows) // 8]))
    assert above[0] > 2 * above[2], 'red on top, where it is likely'
    assert below[2] > 1.5 * below[0], 'blue below'
    assert 'likelihood, × 10⁻⁶ / (px² m)' in text(page, 'legend')
    assert re.search(r'0\s+1\.\d+\s+2\.\d+', text(page, 'ticks'))
    assert re.fullmatch(r'[125]0* (cm|mm)', text(page, 'scale'))


def test_the_slider_hides_what_is_doubtful_while_it_is_dragged(page: Browser) -> None:
    shares = [spread(page.picture())[2]]
    for end in (0.4, 0.8):
        page.drag(page.place('#threshold', 0.02 if end == 0.4 else 0.4),
                  page.place('#threshold', end))
        picture = page.picture()
        shares.append(spread(picture)[2])
        assert 'hidden: likelihood below' in text(page, 'said')
    assert shares[1] < 0.95 * shares[0]
    assert shares[2] < 0.6 * shares[1]
    seen = np.flatnonzero(mesh_of(picture).any(axis=1))
    assert seen.mean() < 0.45 * len(picture), 'what is left is the top'
    # the other way round: high up sigma is large
    page.click(page.place('input[value=sigma]'))
    assert text(page, 'said') == 'nothing hidden (sigma)'
    page.drag(page.place('#threshold', 0.02), page.place('#threshold', 0.6))
    assert re.search(r'hidden: sigma above 0\.[6-9]\d* mm', text(page, 'said'))
    assert spread(page.picture())[1] > spread(picture)[1]


def test_modes_change_the_colours(page: Browser) -> None:
    pictures = {}
    for mode in ('likelihood', 'sigma', 'confidence', 'shaded'):
        page.click(page.place(f'input[value={mode}]'))
        pictures[mode] = page.picture()[:, 300:].astype(int)
    for one in pictures:
        for other in pictures:
            assert one == other or np.abs(pictures[one] - pictures[other]).mean() > 2
    assert np.ptp(pictures['shaded'], axis=2).max() < 40, 'grey'
    assert pictures['shaded'].min() < 150, 'but there'


def test_the_mouse_turns_moves_and_zooms(page: Browser) -> None:
    first = spread(page.picture())
    page.drag(CENTRE, (CENTRE[0], CENTRE[1] + 150))
    turned = page.picture()
    upper = turned[:, 300:][mesh_of(turned)]
    assert upper[:, 0].mean() > upper[:, 2].mean(), 'from above it is red'
    page.drag(CENTRE, (CENTRE[0] + 60, CENTRE[1] + 40), 'right')
    moved = spread(page.picture())
    before = spread(turned)
    assert moved[0] - before[0] == pytest.approx(60, abs=8)
    assert moved[1] - before[1] == pytest.approx(40, abs=8)
    length = text(page, 'scale')
    page.wheel(CENTRE, 300)
    page.wheel(CENTRE, 300)
    assert spread(page.picture())[2] < 0.4 * first[2], 'smaller'
    assert text(page, 'scale') != length


def test_a_double_click_says_what_is_known_of_a_point(page: Browser) -> None:
    page.click(CENTRE, times=2)
    page.settle()
    found = re.fullmatch(
        r'\((\S+), (\S+), (\S+)\) m, likelihood (\S+) × 10⁻⁶ / \(px² m\), sigma (\S+) mm, '
        r'confidence (\S+)', text(page, 'foot'))
    assert found, text(page, 'foot')
    x, y, z, likelihood, sigma, confidence = map(float, found.groups())
    point = np.array((x, y, z)) - MIDDLE
    assert np.linalg.norm(point) == pytest.approx(RADIUS, abs=0.001)
    height = (point[2] / RADIUS + 1) / 2
    assert likelihood == pytest.approx(3 * height, abs=0.03)
    assert sigma == pytest.approx(2 * height, abs=0.02)
    assert confidence == pytest.approx(0.8, abs=0.01)


def test_cameras_and_backs_are_shown_on_demand(page: Browser) -> None:
    before = page.picture()[:, 300:].astype(int)
    page.click(page.place('#frusta'))
    with_cameras = page.picture()[:, 300:].astype(int)
    lines = (with_cameras.max(axis=2) < 80) & (before.max(axis=2) > 120)
    assert 100 < lines.sum() < 0.1 * lines.size
    page.click(page.place('input[value=sigma]'))  # which is large on top
    page.click(page.place('#backs'))
    page.drag(page.place('#threshold', 0.02), page.place('#threshold', 0.6))
    hidden = page.picture()[:, 300:].astype(int)
    page.click(page.place('#backs'))
    assert (np.abs(page.picture()[:, 300:].astype(int) - hidden).sum(axis=2) > 60).sum() > 500, (
        'through what is hidden one sees backs')


def test_a_mesh_without_likelihood_is_shaded_and_that_is_said(
    chromium: Browser, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    formats.write(tmp_path / 'ball.stl', ball())
    page = tmp_path / 'other.html'
    assert cli.main(['view', str(tmp_path / 'ball.stl'), '-o', str(page)]) == 0
    said = capsys.readouterr()
    assert said.err.count('\n') == 1
    assert 'ball.stl has no likelihood, sigma or confidence: the page shows its' in said.err
    assert f'{page}  0.' in said.out
    chromium.errors.clear()
    chromium.open(page)
    picture = chromium.picture()[:, 300:]
    assert np.ptp(picture, axis=2).max() < 40
    assert picture.min() < 150
    for name in ('modes', 'legend', 'hiding', 'cameras'):
        assert chromium.run(f"document.getElementById('{name}').hidden"), name
    assert chromium.errors == []


def test_the_page_is_one_small_file(tmp_path: Path) -> None:
    write_replay(tmp_path)
    assert cli.main(['view', str(tmp_path)]) == 0
    content = (tmp_path / 'mesh.html').read_text(encoding='utf-8')
    assert not re.search(r'(src|href)\s*=|https?://|import\s', content)
    assert '@' not in re.sub(r'@[a-z]', '', content)
    assert len(content) < 12 * len(ball().vertices) + 60_000


def test_positions_keep_a_hundredth_of_an_edge_however_far_the_world_reaches() -> None:
    mesh = ball()
    far = formats.Mesh(
        np.vstack([mesh.vertices, mesh.vertices + np.array((1000, 0, 0))]),
        np.vstack([mesh.faces, mesh.faces + np.int32(len(mesh.vertices))]))
    header, _ = view.packed(far, [])
    edge = np.linalg.norm(np.diff(mesh.vertices[mesh.faces[0, :2]], axis=0))
    assert header['step'] < edge / 30
    assert header['size'] == pytest.approx(1000.2, abs=0.01)


def test_what_cannot_be_shown_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('', 'none.ply'):
        assert cli.main(['view', str(tmp_path / name)]) == 2
        assert re.match(r'gr2t: there is no mesh .*\.ply\n$', capsys.readouterr().err)


def test_fingers_turn_move_and_zoom(page: Browser) -> None:
    first = spread(page.picture())
    x, y = CENTRE
    page.touch([[(x, y)], [(x, y + 80)], [(x, y + 150)]])
    turned = page.picture()
    seen = turned[:, 300:][mesh_of(turned)]
    assert seen[:, 0].mean() > 2 * seen[:, 2].mean(), 'from above it is red'
    page.touch([[(x - apart, y), (x + apart, y)] for apart in (40, 60, 80)])
    larger = spread(page.picture())
    assert larger[2] > 2 * first[2]
    page.touch([[(x - 40, y), (x + 40, y)], [(x - 40, y + 50), (x + 40, y + 50)]])
    assert spread(page.picture())[1] - larger[1] == pytest.approx(50, abs=8)


def odd_meshes() -> dict[str, formats.Mesh]:
    """Return meshes that one may meet."""
    vertices, faces = np.eye(3), np.array([(0, 1, 2)], np.int32)
    nothing = np.zeros(3, np.float32)
    return {
        'a triangle': formats.Mesh(vertices, faces),
        'a point': formats.Mesh(np.ones((3, 3)), faces),
        'no likelihood anywhere': formats.Mesh(vertices, faces, None, {
            'likelihood': nothing, 'sigma': np.full(3, np.nan, np.float32),
            'confidence': nothing}),
        'far away': formats.Mesh(vertices * 1e-3 + 1e6, faces, None, {
            'sigma': np.array((np.inf, 1e-3, 2e-3), np.float32)})}


@pytest.mark.parametrize('name', odd_meshes())
def test_odd_meshes_are_pages_too(name: str, chromium: Browser, tmp_path: Path) -> None:
    title = '</script><b>@DATA@ & "quoted"'
    view.write(tmp_path / 'page.html', odd_meshes()[name], [], title)
    chromium.errors.clear()
    chromium.open(tmp_path / 'page.html')
    chromium.click(CENTRE, times=2)
    chromium.picture()
    assert chromium.errors == []
    assert chromium.run("document.querySelector('h1').textContent") == title
    assert 'NaN' not in chromium.run('document.body.innerText')


def test_a_browser_that_cannot_show_it_says_so(chromium: Browser, tmp_path: Path) -> None:
    view.write(tmp_path / 'page.html', ball(), [], 'ball')
    page = (tmp_path / 'page.html').read_text(encoding='utf-8')
    (tmp_path / 'page.html').write_text(page.replace("'webgl2'", "'webgl9'"), encoding='utf-8')
    chromium.go(tmp_path / 'page.html')
    chromium.until("document.getElementById('message').textContent.startsWith('Cannot')")
    assert text(chromium, 'message') == (
        'Cannot show the mesh: this browser has no WebGL 2.')
