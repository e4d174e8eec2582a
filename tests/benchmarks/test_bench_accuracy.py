"""The benchmark of accuracy: its truths are exact, its scans faulty as they say, its peers run, its sums are right."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.__main__ import main as bench
from benchmarks.accuracy.analytic_solids import SOLIDS
from benchmarks.accuracy.cases import GROUPS, cases_of, chosen_cases, hard_cases
from benchmarks.accuracy.comparison import Protocol
from benchmarks.accuracy.many_scans import main
from benchmarks.accuracy.methods import METHODS, OURS, PEERS, oriented
from benchmarks.accuracy.problem import Problem, load_scan, load_truth, save_mesh, save_scan, save_truth
from benchmarks.accuracy.scans import AnalyticScan, tilted, unit
from benchmarks.accuracy.summary import Standing, accuracy_table, best_peer, failures, standing, summarise
from benchmarks.accuracy.trial import Job, between_samples, run_trial
from benchmarks.harness.measurement import run_isolated
from PIL import Image
from printed_tables import printed

from gnrecon.export import require_sound, verify
from gnrecon.export.metrics import SurfaceQuery
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import UsageError

NOWHERE = Path("nowhere")
CASES = cases_of(GROUPS)
VOLUMES = {
    "sphere": 4 / 3 * np.pi,
    "torus": 2 * np.pi**2 * 0.7 * 0.3**2,
    # Of a cube of side 2, three channels of side 0.8 that share their crossing; brought to radius one.
    "block": (8 - 3 * 2 * 0.8**2 + 2 * 0.8**3) / 3**1.5,
    "plate": 0.7 * 0.02 * 8 / (1 + 0.7**2 + 0.02**2) ** 1.5,
}
SMALL = {"RIMLS": {"resolution": 24}, "APSS": {"resolution": 24}, "Poisson": {"depth": 5, "n_threads": 1}}
SMALL["MeshLab Poisson"] = {"depth": 5, "threads": 1}


def ball(count: int, seed: int = 0) -> Float:
    return unit(np.random.default_rng(seed).standard_normal((count, 3)))


def tetrahedron() -> Mesh:
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))


@pytest.mark.parametrize("name", SOLIDS)
def test_the_truths_are_solids_of_the_stated_genus_and_of_radius_one(name: str) -> None:
    solid = SOLIDS[name]
    facts = require_sound(solid.mesh())
    assert (facts.components, facts.genus) == (1, solid.genus)
    assert np.linalg.norm(solid.mesh().vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    if name in VOLUMES:
        assert facts.volume == pytest.approx(VOLUMES[name], rel=2e-4)


@pytest.mark.parametrize("name", SOLIDS)
def test_points_lie_on_the_shapes_and_normals_lead_out(name: str, rng: np.random.Generator) -> None:
    solid = SOLIDS[name]
    points, normals = solid.draw(2000, rng)
    surface = SurfaceQuery(solid.mesh())
    gaps = np.linalg.norm(points - surface.nearest(points)[0], axis=1)
    # The mesh of a curved shape has chords; of a flat one the nearest point differs by rounding alone.
    assert gaps.mean() < (5e-5 if solid.function else 1e-7)
    if solid.function:
        assert np.abs(solid.function(points)).max() < 1e-9
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    # Beside a concave edge, a step along the normal may lead through the other side of it.
    assert (~surface.inside(points + 4e-3 * normals)).mean() > 0.98
    assert surface.inside(points - 4e-3 * normals).mean() > 0.98


def test_normals_of_sphere_and_torus_are_known(rng: np.random.Generator) -> None:
    points, normals = SOLIDS["sphere"].draw(500, rng)
    assert np.abs(normals - points).max() < 1e-6
    points, normals = SOLIDS["torus"].draw(500, rng)
    middle = 0.7 * points * [1, 1, 0] / np.hypot(points[:, 0], points[:, 1])[:, None]
    assert np.abs(normals - (points - middle) / 0.3).max() < 1e-6


def test_scans_repeat_with_their_seed_and_have_their_number_of_points() -> None:
    case = AnalyticScan("torus", 400, noise=0.01, tilt=10, uneven=5, hole=0.3, outliers=0.1)
    one, same, other = (case.problem(NOWHERE, seed).scan for seed in (3, 3, 4))
    assert np.array_equal(one.points, same.points)
    assert np.array_equal(one.normals, same.normals)
    assert len(one) == len(other) == 400
    assert not np.array_equal(one.points, other.points)
    assert AnalyticScan("torus", 50, normals=False).problem(NOWHERE, 0).scan.normals is None


def test_noise_and_tilt_are_as_large_as_they_say(rng: np.random.Generator) -> None:
    scan = AnalyticScan("sphere", 4000, noise=0.01).problem(NOWHERE, 0).scan
    assert np.std(np.linalg.norm(scan.points, axis=1) - 1) == pytest.approx(0.01, rel=0.05)
    normals = ball(500)
    turned = tilted(normals, 20.0, rng)
    assert np.allclose(np.degrees(np.arccos(np.einsum("ij,ij->i", normals, turned))), 20)
    # In all directions alike, so that the mean direction stays.
    aside = (turned - np.cos(np.radians(20)) * normals).mean(axis=0)
    assert np.linalg.norm(aside) < 0.05


def test_holes_are_empty_and_uneven_scans_uneven() -> None:
    whole = AnalyticScan("sphere", 3000).problem(NOWHERE, 0).scan.points
    holed = AnalyticScan("sphere", 3000, hole=0.5).problem(NOWHERE, 0).scan.points
    away = np.linalg.norm(whole[:, None] - holed[::3], axis=2).min(axis=1)
    assert away.max() > 0.4
    # A cap of that chord is a sixteenth of the sphere: 0.5^2 / 4.
    assert (away > 0.15).mean() < 1 / 16
    uneven = AnalyticScan("sphere", 6000, uneven=30.0).problem(NOWHERE, 0).scan.points[:, 0]
    # On a sphere each coordinate is uniform, so that density is what the counts show: 30 ** (x / 2).
    counts = [np.count_nonzero(np.abs(uneven - x) < 0.1) for x in (-0.8, 0.8)]
    assert counts[1] / counts[0] == pytest.approx(30**0.8, rel=0.3)


def test_outliers_are_a_share_of_the_points_and_the_peers_know() -> None:
    problem = AnalyticScan("torus", 1000, outliers=0.05).problem(NOWHERE, 0)
    off = np.abs(SOLIDS["torus"].function(problem.scan.points)) > 1e-6
    assert off.sum() == 50
    assert problem.outliers
    cloud = oriented(problem.scan.points, problem.scan.normals, outliers=True)
    left = np.abs(SOLIDS["torus"].function(np.asarray(cloud.points))) > 1e-6
    # The statistical rule takes half of them, and leaves what lies nearer the surface.
    assert left.sum() <= 25


@pytest.mark.parametrize("name", GROUPS["analytic"])
def test_every_analytic_case_can_be_drawn(name: str) -> None:
    case = CASES[name]
    problem = case.problem(NOWHERE, 0)
    assert len(problem.scan) == case.points
    assert np.isfinite(problem.scan.points).all()
    assert problem.genus == SOLIDS[case.shape].genus


@pytest.mark.parametrize(("name", "genus"), [("flange", 7), ("shaft", 1)])
def test_parts_with_bores_are_scanned_from_outside(name: str, genus: int) -> None:
    problem = CASES[f"{name}, 5000 points"].problem(NOWHERE, 0)
    assert isinstance(problem.truth, Mesh)
    assert (len(problem.scan), problem.genus, verify(problem.truth).genus) == (5000, genus, genus)
    assert problem.radius is not None
    feet, _ = SurfaceQuery(problem.truth).nearest(problem.scan.points)
    assert np.linalg.norm(problem.scan.points - feet, axis=1).max() < 5e-3 * problem.radius


def test_groups_and_names_choose_cases_once() -> None:
    assert list(chosen_cases(["noisy", "plate", "noisy"], GROUPS)) == ["plate", *GROUPS["noisy"]]
    assert list(chosen_cases(["clean", "noisy", "sparse"], GROUPS)) == list(GROUPS["analytic"])
    sizes = {"srb": 6, "vipss": 2, "organic": 18, "gaps": 6, "open": 6, "bores": 10, "damaged": 6}
    assert {name: len(GROUPS[name]) for name in sizes} == sizes
    assert set(chosen_cases(GROUPS, GROUPS)) == set(CASES)
    assert set(hard_cases()).isdisjoint(GROUPS["clean"])
    with pytest.raises(UsageError, match="no case 'teapot'"):
        chosen_cases(["teapot"], GROUPS)


def test_the_files_truths_have_their_genus_and_unoriented_scans_no_normals(shared_data: Path) -> None:
    for name, case in GROUPS["vipss"].items():
        problem = case.problem(shared_data, 0)
        assert (len(problem.scan), problem.scan.normals) == (500, None)
        assert verify(problem.truth).genus == problem.genus, name
        # The frame is one for both, so that the points lie on the truth.
        feet, _ = SurfaceQuery(problem.truth).nearest(problem.scan.points)
        assert np.linalg.norm(problem.scan.points - feet, axis=1).mean() < 2e-3
    given, unoriented = (CASES[name].problem(shared_data, 0) for name in ("gargoyle", "gargoyle, no normals"))
    assert unoriented.scan.normals is None
    assert given.scan.normals is not None
    assert isinstance(given.truth, PointCloud)
    assert (given.radius, given.factor, given.surface_samples) == (None, 1.0, 0)
    assert CASES["anchor"].problem(shared_data, 0).surface_samples == 1_000_000


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize("given", [True, False], ids=["normals", "no normals"])
def test_peers_make_a_sphere(name: str, given: bool) -> None:
    for library in ("open3d", *(["pymeshlab"] if name in ("MeshLab Poisson", "RIMLS", "APSS") else [])):
        pytest.importorskip(library)
    points = ball(400)
    mesh, _ = METHODS[name]()(points, points if given else None, **SMALL.get(name, {}))
    assert len(mesh.faces) > 100
    # MeshLab's marching cubes have ghosts far off, so the median is what counts.
    assert np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)) < 0.03


def test_estimated_normals_are_outward() -> None:
    pytest.importorskip("open3d")
    points = ball(400)
    normals = np.asarray(oriented(points, None, outliers=False).normals)
    assert np.einsum("ij,ij->i", points, normals).min() > 0.9


def test_all_methods_have_their_settings() -> None:
    protocol = Protocol(threads=1, depths=(7, 8), options={"resolution": 64})
    tried = protocol.contestants(list(METHODS))
    assert [name for name, _ in tried if name in OURS] == list(OURS)
    assert dict(tried)["Adam"] == {"resolution": 64, "optimiser": "adam", "widths": (32, 32, 32)}
    assert dict(tried)["gnrecon"] == {"resolution": 64}
    assert [settings for name, settings in tried if name == "MeshLab Poisson"] == [
        {"depth": 7, "threads": 1},
        {"depth": 8, "threads": 1},
    ]
    assert {name for name, _ in tried} == set(METHODS)


def test_scans_and_truths_come_back_from_their_files(tmp_path: Path) -> None:
    file, points = tmp_path / "file.npz", ball(5)
    save_scan(points, None, file)
    assert load_scan(file)[1] is None
    for truth in (PointCloud(points, points), tetrahedron()):
        save_truth(truth, file)
        again = load_truth(file)
        assert type(again) is type(truth)
    assert np.array_equal(again.faces, tetrahedron().faces)


def test_distances_of_samples_level_off_at_their_spacing() -> None:
    mesh = tetrahedron()
    figures = between_samples(mesh, mesh, 4000)
    # Uniform samples of density rho have a nearest one at 1 / (2 sqrt(rho)) on average.
    assert figures["samples_chamfer"] == pytest.approx(0.5 / np.sqrt(4000 / mesh.area), rel=0.1)
    moved = between_samples(mesh, mesh.with_vertices(mesh.vertices + np.array([0, 0, 9.0])), 4000)
    assert moved["samples_hausdorff"] > 7


def test_an_empty_mesh_and_a_run_without_end_are_sentences(tmp_path: Path) -> None:
    # Ball pivoting finds no three points for its balls in a few far between.
    save_scan(np.array([[0.0, 0, 0], [0, 0, 1e-3], [9, 0, 0], [0, 9, 9]]), ball(4), tmp_path / "s.npz")
    save_mesh(tetrahedron(), tmp_path / "t.npz")
    job = Job("ball pivoting", str(tmp_path / "s.npz"), str(tmp_path / "t.npz"), threads=1, samples=10)
    assert run_trial(job, tmp_path / "trial") == {"error": "The mesh is empty."}
    late = run_isolated("benchmarks.accuracy.trial:measure_trial", {}, tmp_path / "late", limit_seconds=0.01)
    assert late == {"error": "It had not ended after 0.01 seconds."}


def record(case: str, method: str, mean: float, **more: Any) -> dict[str, Any]:
    """A trial's record of which only the mean matters."""
    lengths = ("reference_to_mesh_mean", "mesh_to_reference_mean", "hausdorff", "normal_consistency", "f_score")
    head = {"case": case, "method": method, "settings": {}, "seed": 0, "points": 9, "folder": "x", "chamfer_mean": mean}
    found = {"reference_to_mesh_rms": 3e-3, "mesh_to_reference_rms": 4e-3, "components": 1, "genus": None}
    others = {"closed": False, "boundary_edges": 3, "seconds": 2.0, "cpu_seconds": 1.5}
    others |= {"peak_memory_mb": 1.0}
    return head | dict.fromkeys(lengths, 0.5) | found | others | more


def broken(case: str, method: str, sentence: str) -> dict[str, Any]:
    return {"case": case, "method": method, "settings": {}, "seed": 0, "points": 9, "folder": "x", "error": sentence}


def summary(case: str, ours: float | None, *theirs: float | None) -> dict[str, Any]:
    """A case's summary; None for what failed."""
    means = zip(("gnrecon", *PEERS), (ours, *theirs), strict=False)
    records = [broken(case, name, "No.") if mean is None else record(case, name, mean) for name, mean in means]
    return summarise(records, Problem(PointCloud(ball(9)), tetrahedron(), genus=5))


def test_the_standing_counts_hard_cases_against_the_best_peer() -> None:
    first, second, third, fourth, fifth = hard_cases()[:5]
    found = [
        summary(first, 0.7, 2.0, 1.0),
        summary(second, 0.9, 1.0, 2.0),
        summary(third, 1.1, 3.0, 1.0),
        summary(fourth, None, 1.0),
        summary(fifth, 0.5, None, None),
        summary("sphere", 0.1, 1.0),
        summary(first, 0.1),
    ]
    assert standing(found) == Standing(cases=5, below=3, quarter=2)
    assert best_peer(found[0]) == PEERS[1]
    assert standing([summary("sphere", 0.1, 1.0), summary(first, 0.1)]) is None


def test_the_table_shows_best_settings_distances_in_the_unit_and_failures() -> None:
    case = hard_cases()[0]
    poisson = [record(case, "Poisson", mean, settings={"depth": depth}) for depth, mean in ((7, 0.002), (8, 0.001))]
    records = [record(case, "gnrecon", 0.0005, genus=5, closed=True), *poisson, broken(case, "APSS", "No surface.")]
    found = summarise(records, Problem(PointCloud(ball(9)), tetrahedron(), genus=5))
    text = printed(accuracy_table([found], 1))
    lines = text.replace("│", " ").splitlines()
    ours, theirs, last = (
        next(line for line in lines if name in line).split() for name in ("gnrecon", "Poisson", "APSS")
    )
    assert "genus 5; 1e-3 of the radius" in text
    assert ours[1:5] == ["500.000", "500.000", "0.500", "3.536"]
    assert ours[-4:] == ["yes", "2.0", "1.5", "1"]
    assert theirs[:4] == ["Poisson,", "depth", "8", "*"]
    assert theirs[6] == "1.000"
    assert theirs[-4:] == ["no", "2.0", "1.5", "1"]
    assert last == ["APSS", "failed"]
    assert failures([found]) == [f"{case}, APSS: No surface."]


def test_what_is_wrong_is_told_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(["accuracy", "--cases", "anchor", "--data", str(tmp_path)]) == 3
    assert bench(["accuracy", "--cases", "teapot"]) == 2
    assert bench(["accuracy", "--cases", "sphere", "--quality", "dreadful"]) == 2
    assert bench(["accuracy", "--cases", "sphere", "--json", str(tmp_path / "no/where.json")]) == 6
    shown = capsys.readouterr()
    assert shown.out == ""
    assert str(tmp_path / "srb/anchor.ply") in shown.err
    assert len(shown.err.splitlines()) == 4


@pytest.mark.usefixtures("measured_here")
def test_a_small_run_from_cases_to_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures, picture = tmp_path / "figures.json", tmp_path / "sheet.png"
    options = {"resolution": 32, "quality": "draft"}
    protocol = Protocol(threads=1, samples=2_000, depths=(5,), options=options, limit=300.0)
    wanted = ["--cases", "sphere, 100 points", "--methods", "gnrecon", "Poisson", "ball pivoting"]
    assert main([*wanted, "--json", str(figures), "--picture", str(picture)], protocol) == 0
    report = json.loads(figures.read_text(encoding="utf-8"))
    (found,) = report["summary"]
    assert list(found["methods"]) == ["gnrecon", "Poisson", "ball pivoting"]
    ours = found["methods"]["gnrecon"]
    assert (ours["genus"], ours["closed"], ours["components"]) == (0, True, 1)
    assert ours["chamfer_mean"] < 0.05
    assert found["methods"]["Poisson"]["settings"]["depth"] == 5
    assert report["standing"]["cases"] == 1
    assert not any("folder" in trial for trial in report["trials"])
    assert "1 noisy or sparse analytic cases" in capsys.readouterr().out
    # The scan, three meshes and the truth, each with something drawn.
    with Image.open(picture) as image:
        panels = np.split(np.asarray(image.convert("L")), 5, axis=1)
    assert all((panel[40:] < 180).mean() > 0.005 for panel in panels)
