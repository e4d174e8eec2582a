"""Pictures: what is where, in which colour, and that everything stays within the frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from analytic_fields import UTM, Field, Function, ball_mesh, sphere, union

from gnrecon.export import extract, project
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.rendering import picture, render, render_sheet
from gnrecon.rendering.rays import VIEWS, Camera
from gnrecon.rendering.rendering_parameters import SheetParameters
from gnrecon.runtime.errors import OutputError, UsageError

SIZE = (120, 90)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return ball_mesh()


def box(half: tuple[float, float, float], center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Function:
    return lambda x: (np.abs(x - np.array(center)) - np.array(half)).max(axis=1)


def drawn(image: np.ndarray) -> np.ndarray:
    """Which pixels are not paper: paper is grey."""
    return np.ptp(image.astype(int), axis=2) > 6


def test_a_ball_is_a_disc_in_the_middle(ball: Mesh, tmp_path: Path) -> None:
    from PIL import Image

    image = render(ball, tmp_path / "ball.png", size=SIZE, color=(200, 60, 60))
    assert image.shape == (90, 120, 3)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "ball.png")), image)
    rows, columns = np.nonzero(drawn(image))
    assert rows.mean() == pytest.approx(44.5, abs=1)
    assert columns.mean() == pytest.approx(59.5, abs=1)
    # The disc fills the margin's share of the shorter side.
    assert np.ptp(rows) + 1 == pytest.approx(0.92 * 90, abs=3)
    assert drawn(image).sum() == pytest.approx(np.pi / 4 * (0.92 * 90) ** 2, rel=0.05)
    red, green, _ = image[45, 60].astype(int)
    assert red > green + 50
    assert image[20:40, 40:60].mean() > image[60:80, 70:90].mean() + 10, "the key light comes from above and the left"


def test_scan_and_mesh_stand_side_by_side(ball: Mesh) -> None:
    scan = PointCloud(ball.vertices, ball.normals)
    image = render(ball, size=(200, 100), points=scan, color=(200, 60, 60), point_color=(60, 60, 200)).astype(int)
    left, right = image[:, :100], image[:, 100:]
    assert (left[..., 2] - left[..., 0]).max() > 30 > (left[..., 0] - left[..., 2]).max()
    assert (right[..., 0] - right[..., 2]).max() > 30 > (right[..., 2] - right[..., 0]).max()
    assert np.abs(np.argwhere(drawn(left)).mean(axis=0) - np.argwhere(drawn(right)).mean(axis=0)).max() < 2


@pytest.mark.parametrize("up", ["y", "z"])
def test_named_views_see_the_side_that_they_name(up: str) -> None:
    """A small ball to the right, one above and one in front tell the axes apart."""
    right = np.array([1.0, 0, 0])
    above, front = (np.array([0, 0, 1.0]), np.array([0, -1.0, 0])) if up == "z" else (np.eye(3)[1], np.eye(3)[2])
    points = np.array([right, above, front, -right, -above, -front])
    for view, rightward, upward, nearest in (
        ("front", right, above, front),
        ("right", -front, above, right),
        ("back", -right, above, -front),
        ("left", front, above, -right),
        ("top", right, -front, above),
        ("bottom", right, front, -above),
    ):
        camera = Camera.framing(points, view, up, 100, 100)
        assert np.allclose(camera.axes, [rightward, upward, nearest], atol=2e-3), view
        assert np.allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
        column, row, depth = camera.project(points)
        assert depth.argmin() == np.argmax(points @ nearest)
        assert column.argmax() == np.argmax(points @ rightward)
        assert row.argmin() == np.argmax(points @ upward)


@pytest.mark.parametrize("view", [*VIEWS, (130.0, -40.0)])
def test_every_view_frames_the_whole_shape(view: object) -> None:
    points = np.random.default_rng(0).normal(size=(300, 3)) * [3, 1, 0.4] + [10, -5, 2]
    camera = Camera.framing(points, view, "z", 160, 90)  # type: ignore[arg-type]
    column, row, depth = camera.project(points)
    assert depth.min() > 0
    assert column.min() >= 0
    assert column.max() <= 160
    assert row.min() >= 0
    assert row.max() <= 90
    assert np.ptp(column) > 0.85 * 160 or np.ptp(row) > 0.85 * 90


def test_rays_and_projection_are_inverse() -> None:
    camera = Camera.framing(np.random.default_rng(0).normal(size=(50, 3)), "three-quarter", "z", 30, 20)
    down, across = np.indices((20, 30)).reshape(2, -1) + 0.5
    rays = camera.rays(across, down)
    column, row, _ = camera.project(rays[:, :3] + 3.7 * rays[:, 3:])
    assert np.allclose(column, across)
    assert np.allclose(row, down)


def test_hollows_are_darker_than_the_open() -> None:
    """Between two close balls the sky is covered."""
    field = Field(union(sphere(0.4, (-0.42, 0, 0)), sphere(0.4, (0.42, 0, 0))), reach=1.0)
    mesh = project(extract(field, resolution=48), field)
    image = render(mesh, size=(180, 90), views=[(0, 0)]).astype(int).sum(axis=2)
    assert image[45, 78] < image[45, 20] - 60


def test_pixels_of_one_sample_look_as_those_of_nine(monkeypatch: pytest.MonkeyPatch) -> None:
    field = Field(union(sphere(0.4, (-0.42, 0, 0)), box((0.5, 0.1, 0.6), (0.3, 0, 0))), reach=1.0)
    mesh = project(extract(field, resolution=48), field)
    casts: list[int] = []
    rays = Camera.rays
    monkeypatch.setattr(Camera, "rays", lambda self, *places: casts.append(len(places[0])) or rays(self, *places))
    image = render(mesh, size=(240, 180)).astype(int)
    fast = sum(casts)
    casts.clear()
    monkeypatch.setattr(picture, "_draw_mesh", partial(picture._draw_mesh, least_change=0.0))
    exact = render(mesh, size=(240, 180)).astype(int)
    assert sum(casts) == 10 * 240 * 180 > 2 * fast
    off = np.abs(image - exact).max(axis=2)
    assert off.max() < 12
    assert off.mean() < 0.5


def test_points_without_normals_fade_with_depth() -> None:
    cloud = PointCloud(np.array([[-1.0, -1, 0], [1.0, 1, 0]]))
    image = render(None, size=(100, 60), points=cloud, views=["front"]).astype(int)
    near, far = (np.ptp(half, axis=2).max() for half in (image[:, :50], image[:, 50:]))
    assert near > far > 0


def test_what_cannot_be_drawn_is_said(ball: Mesh, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to draw"):
        render(None)
    with pytest.raises(UsageError, match="'sideways' is unknown"):
        render(ball, views=["sideways"])
    with pytest.raises(UsageError, match="axis is 'x'"):
        render(ball, up="x")
    with pytest.raises(UsageError, match="no room for 2 panels"):
        render(ball, size=(1, 10), views=["front", "top"])
    with pytest.raises(OutputError):
        render(ball, tmp_path / "missing" / "ball.png", size=(8, 8))


def test_a_sheet_shows_scan_and_mesh_and_the_sides_with_their_names(tmp_path: Path) -> None:
    """A bar along x with an arm towards +z at its right end: every side has its own outline."""
    from PIL import Image

    layout = SheetParameters(width=600, upper_height=240, lower_height=180)
    field = Field(union(box((0.8, 0.2, 0.15)), box((0.12, 0.2, 0.5), (0.68, 0, 0.4))), frame=UTM)
    mesh = extract(field, resolution=32)
    image = render_sheet(mesh, tmp_path / "sheet.png", points=PointCloud(mesh.vertices), layout=layout)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "sheet.png")), image)
    assert image.shape == (240 + 36 + 180 + 36, 600, 3)
    row = drawn(image)[276:456]
    sides = [row[:, left : left + 200] for left in (0, 200, 400)]
    spans = [[np.ptp(np.nonzero(side.any(axis=axis))[0]) for axis in (0, 1)] for side in sides]
    # Along y one sees 1.6 by 1.05, along x 0.4 by 1.05, along z 1.6 by 0.4.
    for (wide, tall), expected in zip(spans, (1.6 / 1.05, 0.4 / 1.05, 1.6 / 0.4), strict=True):
        assert wide / tall == pytest.approx(expected, rel=0.25)
    assert sides[0][:60, 100:].sum() > 5 * sides[0][:60, :100].sum(), "the arm is on the right"
    blue = image[:240].astype(int)
    assert (blue[:, :300, 2] - blue[:, :300, 0]).max() > 30 > (blue[:, 300:, 2] - blue[:, 300:, 0]).max()
    for foot, panels in ((image[240:276], 2), (image[456:], 3)):
        words = foot.min(axis=2) < 170
        assert all(part.any() for part in np.array_split(words, panels, axis=1))
    alone = render_sheet(mesh, layout=layout)
    assert alone.shape == image.shape
    assert not (alone[..., 2].astype(int) - alone[..., 0] > 30).any()


def test_colours_of_vertices_are_drawn(ball: Mesh) -> None:
    left = ball.vertices[:, 0] < ball.vertices[:, 0].mean()
    colors = np.where(left[:, None], [220, 30, 30, 255], [30, 30, 220, 255]).astype(np.uint8)
    image = render(ball.with_attributes({"colors": colors}), size=SIZE, views=["front"]).astype(int)
    red, _, blue = np.moveaxis(image, 2, 0)
    assert (red - blue)[40:50, 35:50].min() > 50
    assert (blue - red)[40:50, 70:85].min() > 50


def test_points_whose_normals_are_zero_are_seen(ball: Mesh) -> None:
    points = ball.vertices
    without = render(None, size=SIZE, points=PointCloud(points))
    np.testing.assert_array_equal(render(None, size=SIZE, points=PointCloud(points, 0 * points)), without)
