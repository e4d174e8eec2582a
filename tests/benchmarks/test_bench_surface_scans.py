"""The benchmark's scans of mesh files: drawn as trimesh draws, faulty as they say, and open where a plane cuts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic_fields import UNIT, Field, ball_mesh, torus
from benchmarks.accuracy.cases import GROUPS
from benchmarks.accuracy.comparison import Protocol
from benchmarks.accuracy.many_scans import main
from benchmarks.accuracy.scans import ShapeFile
from benchmarks.accuracy.surface_scans import Cut, OpenScan, Sampling, SurfaceScan, cut_open, draw_surface
from PIL import Image

from gnrecon.export import extract, measure, verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import InputError

FILE = ShapeFile("shape.ply", up="z", view=(35.0, 25.0))


def ball(radius: float = 1.0, resolution: int = 48) -> Mesh:
    mesh = ball_mesh(1.0, UNIT, resolution, reach=1.2)
    return mesh.with_vertices(radius * mesh.vertices)


def inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1])


def side_by_side(one: Mesh, other: Mesh, shift: float) -> Mesh:
    """Two meshes as one, the second moved along x."""
    vertices = np.concatenate([one.vertices, other.vertices + np.array([shift, 0, 0])])
    return Mesh(vertices, np.concatenate([one.faces, other.faces + len(one.vertices)]))


def test_points_are_drawn_as_trimesh_draws_them() -> None:
    mesh = extract(Field(torus()), resolution=16)
    points, normals = draw_surface(mesh, 500, 7)
    same = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    expected, faces = trimesh.sample.sample_surface(same, 500, seed=7)
    assert np.allclose(points, expected, rtol=0, atol=1e-12)
    assert np.allclose(normals, same.face_normals[faces], rtol=0, atol=1e-9)


def test_scans_with_gaps_have_no_points_in_their_balls() -> None:
    surface = ball()
    whole, cut = Sampling(3000), Sampling(3000, gaps=4)
    centers, radii = cut.balls(surface, 3)
    inside = np.linalg.norm(whole.scan(surface, 3).points[:, None] - centers, axis=2) < radii
    assert inside.any(axis=0).all()
    assert len(cut.scan(surface, 3)) == 3000 - inside.any(axis=1).sum()


def test_noise_and_tilt_of_a_sampling_are_as_large_as_they_say() -> None:
    surface = ball()
    exact = Sampling(4000).scan(surface, 1)
    noisy, tilted, other = (s.scan(surface, 1) for s in (Sampling(4000, 0.01), Sampling(4000, tilt=4.0), Sampling(9)))
    assert np.std(noisy.points - exact.points) == pytest.approx(0.01, rel=0.03)
    assert np.array_equal(tilted.points, exact.points)
    assert exact.normals is not None
    assert tilted.normals is not None
    cosine = np.einsum("ij,ij->i", exact.normals, tilted.normals)
    tangent = np.sqrt(1 - cosine**2) / cosine
    # The part of the added vector along the normal matters to second order only.
    assert np.sqrt(np.mean(tangent**2)) == pytest.approx(np.tan(np.radians(4)), rel=0.05)
    assert (len(other), Sampling(9, normals=False).scan(surface, 1).normals) == (9, None)


def test_a_scan_of_a_file_is_in_its_unit_frame_and_repeats_with_its_seed(tmp_path: Path) -> None:
    write_mesh(inside_out(ball(3.0, 12)), tmp_path / FILE.file)
    case = SurfaceScan(FILE, Sampling(50), genus=0)
    one, same, other = (case.problem(tmp_path, seed) for seed in (3, 3, 4))
    assert np.array_equal(one.scan.points, same.scan.points)
    assert not np.array_equal(one.scan.points, other.scan.points)
    assert isinstance(one.truth, Mesh)
    assert Frame.of(one.truth.vertices).scale == pytest.approx(1)
    assert one.scan.normals is not None
    # The file's faces look inward, and so do the normals.
    assert np.einsum("ij,ij->i", one.scan.points, one.scan.normals).max() < 0
    with pytest.raises(InputError, match="There is no file"):
        case.problem(tmp_path / "elsewhere", 0)


@pytest.mark.parametrize("inward", [False, True], ids=["outward", "inward"])
def test_a_plane_opens_a_mesh_and_leaves_its_lid(inward: bool) -> None:
    mesh = inside_out(ball()) if inward else ball()
    part, lid = cut_open(mesh, Cut((0.0, 0.0, 2.0), 0.5))
    assert part.vertices[:, 2].min() == pytest.approx(0.5, abs=1e-9)
    assert np.allclose(lid.vertices[:, 2], 0.5, rtol=0, atol=1e-9)
    assert part.area == pytest.approx(2 * np.pi * 0.5, rel=0.01)
    assert lid.area == pytest.approx(np.pi * (1 - 0.25), rel=0.01)
    facts = verify(part)
    assert (facts.closed, facts.components, facts.euler_characteristic) == (False, 1, 1)
    # Together they bound the cap of the ball, with faces that look outward.
    both = np.concatenate([part.corners, lid.corners])
    closed = Mesh(both.reshape(-1, 3), np.arange(3 * len(both)).reshape(-1, 3))
    assert closed.volume == pytest.approx(np.pi * 0.5**2 * (3 - 0.5) / 3, rel=0.01)


def test_of_several_pieces_the_largest_is_kept() -> None:
    both = side_by_side(ball(0.3, 24), ball(0.5, 24), 1.5)
    part, _ = cut_open(both, Cut((0.0, 1.0, 0.0), 0.0))
    assert part.vertices[:, 0].min() > 0.9
    assert verify(part).components == 1


def test_a_plane_that_does_not_cut_and_a_shape_that_is_no_solid_are_refused() -> None:
    mesh = ball(1.0, 12)
    with pytest.raises(InputError, match="2 from the origin leaves nothing"):
        cut_open(mesh, Cut((1.0, 0.0, 0.0), 2.0))
    with pytest.raises(InputError, match="-2 from the origin does not cut"):
        cut_open(mesh, Cut((1.0, 0.0, 0.0), -2.0))
    with pytest.raises(InputError, match="bounds no solid"):
        cut_open(Mesh(mesh.vertices, mesh.faces[1:]), Cut((1.0, 0.0, 0.0), 0.0))


def test_an_open_scan_has_its_own_frame_and_a_mesh_may_end_at_its_lid_or_lie_on_it(tmp_path: Path) -> None:
    write_mesh(ball(3.0), tmp_path / FILE.file)
    problem = OpenScan(FILE, Cut((0.0, 0.0, 1.0), 0.2), Sampling(300)).problem(tmp_path, 0)
    truth, lid = problem.truth, problem.lid
    assert isinstance(truth, Mesh)
    assert lid is not None
    assert Frame.of(truth.vertices).scale == pytest.approx(1)
    low = truth.vertices[:, 2].min()
    assert np.allclose(lid.vertices[:, 2], low, rtol=0, atol=1e-6)
    assert problem.scan.points[:, 2].min() > low - 1e-6
    both = side_by_side(truth, lid, 0.0)
    # In the long thin triangles of a lid, feet in single precision may be off by more than elsewhere.
    for mesh in (truth, both):
        assert measure(mesh, truth, samples=2000, lid=lid).hausdorff == pytest.approx(0, abs=1e-3)
    assert measure(both, truth, samples=2000).hausdorff > 0.5


@pytest.mark.usefixtures("measured_here")
def test_cases_of_files_run_and_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("open3d")
    (tmp_path / "organic").mkdir()
    write_mesh(inside_out(ball(2.0, 32)), tmp_path / "organic" / "cow.obj")
    stored = {"case": "organic/cow_1000_0.0", "points": 1000, "peer": "other", "setting": "d8"}
    stored |= {"cd": 0.0125, "acc": 0.01, "comp": 0.015, "hd": 0.25, "cpu": 1.5}
    (tmp_path / "peers.jsonl").write_text(json.dumps(stored) + "\n", encoding="utf-8")
    figures, picture = tmp_path / "figures.json", tmp_path / "sheet.png"
    cases = ["cow, 1000 points", "cow head, 1000 points"]
    wanted = ["--data", str(tmp_path), "--peers", str(tmp_path / "peers.jsonl"), "--methods", "ball pivoting"]
    protocol = Protocol(threads=1, samples=2_000, limit=300.0)
    assert main([*wanted, "--cases", *cases, "--json", str(figures), "--picture", str(picture)], protocol) == 0
    report = json.loads(figures.read_text(encoding="utf-8"))
    whole, part = report["summary"]
    assert [summary["lid"] for summary in (whole, part)] == [False, True]
    assert whole["stored"][0]["chamfer_mean"] == pytest.approx(1.25e-5)
    assert part["stored"] == []
    # Both are read from the surfaces, and nothing is counted where the head ends.
    assert part["methods"]["ball pivoting"]["chamfer_mean"] < 0.01
    assert part["methods"]["ball pivoting"]["cpu_seconds"] > 0
    assert (report["standing"], report["stored_standing"]) == (None, None)
    shown = capsys.readouterr().out
    assert "open, with a flat lid" in shown
    assert "stored other, d8" in shown
    # Two rows of the scan, the mesh and the truth, each with something drawn.
    with Image.open(picture) as image:
        rows = np.split(np.asarray(image.convert("L")), 2, axis=0)
    panels = [panel for row in rows for panel in np.split(row, 3, axis=1)]
    assert all((panel[40:] < 180).mean() > 0.005 for panel in panels)
    # The file's faces look inward, but are drawn from outside: black is the writing alone.
    assert (panels[2][40:] < 30).mean() < 0.01


@pytest.mark.parametrize("name", [name for group in ("organic", "open") for name in GROUPS[group] if ", 1000 " in name])
def test_organic_cases_can_be_drawn(name: str, shared_data: Path) -> None:
    if not (shared_data / "organic").is_dir():
        pytest.skip(f"there is no folder organic in {shared_data}")
    problem = {**GROUPS["organic"], **GROUPS["open"]}[name].problem(shared_data, 0)
    assert len(problem.scan) == 1000
    assert isinstance(problem.truth, Mesh)
    facts = verify(problem.truth)
    assert facts.genus == problem.genus
    assert facts.components == 1
    if problem.lid is not None:
        # One opening: the part is a disc.
        assert (facts.closed, facts.euler_characteristic) == (False, 1)
        assert problem.truth.volume > 0
