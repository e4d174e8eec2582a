"""Design problems: regions and interfaces with known distances, and parts that keep to them or do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.io import read_mesh, write_mesh
from gnrecon.runtime.errors import InputError
from gnrecon.shape_learning.design import Design, DesignRegion, measure_design, read_design, solid_pieces


def box(*sides: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    made = trimesh.creation.box(sides)
    return Mesh(made.vertices + np.array(center), made.faces)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def square(x: float, side: float) -> Mesh:
    """A square that looks along x."""
    corners = np.array([[x, -1.0, -1.0], [x, 1, -1], [x, 1, 1], [x, -1, 1]]) * [1, side / 2, side / 2]
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A block of 40 x 20 x 20 about (100, 0, 0), and its two ends as interfaces, a small and a large one."""
    paths = tmp_path / "region.stl", tmp_path / "walls.ply"
    write_mesh(box(40, 20, 20, center=(100, 0, 0)), paths[0])
    left = square(80.0, 4.0)
    write_mesh(joined(Mesh(left.vertices, left.faces[:, ::-1]), square(120.0, 16.0)), paths[1])
    return paths


@pytest.fixture
def design(files: tuple[Path, Path]) -> Design:
    return read_design(*files)


def test_the_frame_is_that_of_the_region(design: Design) -> None:
    assert design.frame.center.tolist() == [100, 0, 0]
    assert design.frame.scale == 20
    np.testing.assert_allclose(design.region.mesh.vertices.max(axis=0), [1, 0.5, 0.5])
    np.testing.assert_allclose(design.region.box.upper, [1.1, 0.6, 0.6])


def test_the_distance_is_that_of_a_block(design: Design, rng: np.random.Generator) -> None:
    points = rng.uniform(-1.5, 1.5, (500, 3))
    beyond = np.abs(points) - [1, 0.5, 0.5]
    expected = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    np.testing.assert_allclose(design.region.distance(points), expected, atol=1e-6)
    assert (design.region.inside(points) == (expected < 0)).all()


def test_points_around_the_region_are_on_both_sides_of_its_border(design: Design, rng: np.random.Generator) -> None:
    points = design.region.around(2000, rng)
    assert points.shape == (2000, 3)
    assert (points >= design.region.box.lower).all()
    assert (points <= design.region.box.upper).all()
    near = np.abs(design.region.distance(points)) < 0.05
    assert 0.5 < near.mean() < 0.75
    assert 0.35 < design.region.inside(points[near]).mean() < 0.65


def test_every_interface_has_as_many_points(design: Design, rng: np.random.Generator) -> None:
    sample = design.interfaces.sample(600, rng)
    assert np.bincount(sample.pieces).tolist() == [300, 300]
    left, right = sample.points[sample.pieces == 0], sample.points[sample.pieces == 1]
    np.testing.assert_allclose(left[:, 0], -1)
    np.testing.assert_allclose(np.abs(right[:, 1:]).max(), 0.4, atol=0.01)
    np.testing.assert_allclose(sample.normals, np.where(sample.pieces == 0, -1, 1)[:, None] * [1, 0, 0], atol=1e-12)


def test_a_part_that_fills_the_region_keeps_to_it(design: Design, rng: np.random.Generator) -> None:
    facts = measure_design(box(40, 20, 20, center=(100, 0, 0)), design, rng)
    assert (facts.violations, facts.components) == (0, 1)
    assert facts.mean_attachment < 1e-6
    assert facts.as_dict()["components"] == 1


def test_a_part_that_violates_its_design_is_measured(design: Design, rng: np.random.Generator) -> None:
    # Shifted by 2 along x and cut in two: an end of 1 beyond 20, all of one interface at 0.1.
    halves = joined(box(18, 20, 20, center=(91, 0, 0)), box(18, 20, 20, center=(113, 0, 0)))
    facts = measure_design(halves, design, rng)
    assert facts.components == 2
    assert facts.attachment == pytest.approx((0.1, 0.1), abs=1e-6)
    outside = (400 + 4 * 20 * (2 - 0.02)) / (2 * (2 * 400 + 4 * 18 * 20))
    assert facts.violations == pytest.approx(outside, rel=0.05)
    assert facts.depth == pytest.approx(0.1, abs=1e-6)


def test_a_cavity_is_no_piece() -> None:
    inner = box(1, 1, 1)
    hollow = joined(box(4, 4, 4), Mesh(inner.vertices, inner.faces[:, ::-1]), box(1, 1, 1, center=(5, 0, 0)))
    assert solid_pieces(hollow) == 2


def test_interfaces_in_coordinates_of_their_own(files: tuple[Path, Path], tmp_path: Path) -> None:
    own = Frame(np.array([1.0, 2.0, 3.0]), 25.4)
    walls = read_mesh(files[1])
    write_mesh(walls.with_vertices(own.to_world(walls.vertices)), tmp_path / "inches.ply")
    moved = read_design(files[0], tmp_path / "inches.ply", own)
    expected = read_design(*files)
    np.testing.assert_allclose(moved.interfaces.mesh.vertices, expected.interfaces.mesh.vertices, atol=1e-6)


def test_interfaces_elsewhere_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    write_mesh(square(200.0, 4.0), tmp_path / "far.ply")
    with pytest.raises(InputError, match=r"far.ply: the interfaces reach 4 half-lengths .* beyond its box"):
        read_design(files[0], tmp_path / "far.ply")


def test_an_open_region_is_refused(files: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match="must be a closed surface, but the mesh is open"):
        read_design(files[1], files[1])


def test_a_region_inside_out_is_turned(files: tuple[Path, Path], tmp_path: Path) -> None:
    block = read_mesh(files[0])
    write_mesh(Mesh(block.vertices, block.faces[:, ::-1]), tmp_path / "turned.stl")
    assert read_design(tmp_path / "turned.stl", files[1]).region.distance(np.zeros((1, 3)))[0] == pytest.approx(-0.5)


def test_needles_do_not_spoil_the_distance(tmp_path: Path, rng: np.random.Generator) -> None:
    # A disk of 200 corners, its caps cut into fans of needles.
    made = trimesh.creation.cylinder(radius=20, height=10, sections=200, transform=np.eye(4))
    write_mesh(Mesh(made.vertices + np.array([100.0, 0, 0]), made.faces), tmp_path / "disk.stl")
    write_mesh(square(100.0, 4.0), tmp_path / "wall.stl")
    region = read_design(tmp_path / "disk.stl", tmp_path / "wall.stl").region
    points = rng.uniform(-0.6, 0.6, (2000, 3)) * [1, 1, 0.25]
    expected = np.maximum(np.abs(points[:, 2]) - 0.25, np.hypot(points[:, 0], points[:, 1]) - 1)
    np.testing.assert_allclose(region.distance(points), expected, atol=2e-4)


def test_the_sample_problem_is_sound(repository: Path, rng: np.random.Generator) -> None:
    data = repository / "sample_data"
    design = read_design(data / "design_region.stl", data / "design_interfaces.stl")
    walls = design.interfaces.sample(3000, rng)
    assert len(design.interfaces) == 3
    # All of them are on the border of the region, and look out of it: into their holes.
    assert np.abs(design.region.distance(walls.points)).max() < 2e-3
    assert (design.region.distance(walls.points + 0.02 * walls.normals) > 0.015).all()
    facts = measure_design(read_mesh(data / "design_region.stl"), design, rng)
    assert (facts.violations, facts.components) == (0, 1)


def test_the_bracket_of_the_paper(shared_data: Path, rng: np.random.Generator) -> None:
    raw = Frame(np.array([14.05059242, -73.27111721, 31.25202942]), 90.08587742)
    paper = shared_data / "paper"
    design = read_design(paper / "bracket_envelope.stl", paper / "bracket_interfaces.stl", raw)
    walls = design.interfaces.sample(1200, rng)
    assert len(design.interfaces) == 6
    assert isinstance(design.region, DesignRegion)
    assert np.abs(design.region.distance(walls.points)).max() < 1.5e-3
    # Four bolt holes with their washers, and the two bores of the clevis.
    assert np.bincount(walls.pieces).tolist() == [200] * 6
