"""Whole reconstructions of exactly known shapes: topology, volume, equivariance, reproducibility, reports, failures."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_shapes import box, sphere
from scan_files import FAST, TORUS_VOLUME, TUBE, gnrecon, torus, write_scan
from scipy.spatial.transform import Rotation

from gnrecon.export import measure
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.optim import Record
from gnrecon.pipeline import Progress, Reconstruction, reconstruct
from gnrecon.report.html import page_text
from gnrecon.report.schema import SCHEMA_VERSION
from gnrecon.runtime.errors import InputError, MemoryLimitError, MeshError, UsageError
from gnrecon.runtime.parallel import worker_count

RADIUS = 1 + TUBE
# Enough to reach every stage, where the mesh itself does not matter.
TINY = {"widths": (200,), "steps": 0, "resolution": 24}

STAGES = ["read", "ingest", "fit", "extract", "project", "repair", "verify", "attributes"]

Cloud = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def scan() -> Cloud:
    return torus(1200, np.random.default_rng(3))


@pytest.fixture(scope="module")
def result(scan: Cloud) -> Reconstruction:
    return reconstruct(*scan, **FAST)


class Recorder(Progress):
    """Remembers all that it is told, and interrupts after a step when asked to."""

    def __init__(self, interrupt_after: int | None = None) -> None:
        self.stages: list[str] = []
        self.steps: list[tuple[int, int]] = []
        self.remarks: list[str] = []
        self.threads: set[int] = set()
        self._interrupt_after = interrupt_after

    def stage(self, name: str) -> None:
        self.stages.append(name)

    def step(self, record: Record, total: int) -> None:
        self.steps.append((record.step, total))
        self.threads.add(worker_count())
        if record.step == self._interrupt_after:
            raise KeyboardInterrupt

    def remark(self, sentence: str) -> None:
        self.remarks.append(sentence)


@pytest.mark.parametrize(
    ("shape", "euler_characteristic", "volume", "width"),
    [
        # A narrow network leaves sheets in the sphere's free space, where there is most of it.
        (lambda rng: sphere(1000, rng), 2, 4 * np.pi / 3, 600),
        (lambda rng: torus(1200, rng), 0, TORUS_VOLUME, 300),
        (lambda rng: box(3000, rng, (2.0, 1.0, 0.15)), 2, 0.3, 300),
    ],
    ids=["sphere", "torus", "thin box"],
)
def test_topology_and_volume(
    shape: Callable[[np.random.Generator], Cloud],
    euler_characteristic: int,
    volume: float,
    width: int,
    rng: np.random.Generator,
) -> None:
    mesh = reconstruct(*shape(rng), widths=(width,), steps=1, resolution=48).mesh
    assert mesh.euler_characteristic == euler_characteristic
    assert mesh.volume == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize(
    ("scale", "offset"),
    [(1000.0, (0.0, 0.0, 0.0)), (1.0, (0.3, -2.0, 5.0)), (100.0, (500_000.0, 4_500_000.0, 100.0))],
    ids=["scaled by 1000", "moved", "UTM, 130 m"],
)
def test_the_mesh_scales_and_moves_with_the_scan(
    scan: Cloud, result: Reconstruction, scale: float, offset: tuple[float, ...]
) -> None:
    moved = reconstruct(scan[0] * scale + offset, scan[1], **FAST)
    assert np.array_equal(moved.mesh.faces, result.mesh.faces)
    apart = np.abs((moved.mesh.vertices - offset) / scale - result.mesh.vertices).max(axis=1)
    # The fields agree to rounding, below. Where a vertex lies along the surface is found in float32, so that a few that
    # are nearly undetermined differ more, and by how much depends on the processor.
    assert np.quantile(apart, 0.999) < 1e-6 * RADIUS
    assert apart.max() < 1e-5 * RADIUS
    near = scan[0] + 0.1 * scan[1]
    assert np.abs(moved.sdf.sdf(near * scale + offset) / scale - result.sdf.sdf(near)).max() < 1e-6 * RADIUS


def test_the_mesh_turns_with_the_scan(scan: Cloud, result: Reconstruction) -> None:
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    turned = reconstruct(scan[0] @ turn.T, scan[1] @ turn.T, **FAST).mesh
    # The features' directions are drawn at random and do not turn, so that the surfaces agree and not the vertices.
    back = turned.with_vertices(turned.vertices @ turn)
    assert back.euler_characteristic == result.mesh.euler_characteristic
    assert measure(back, result.mesh, samples=20_000).chamfer_mean < 0.005 * RADIUS


def test_one_seed_makes_the_same_bytes_in_every_process_and_another_seed_others(
    tmp_path: Path, scan: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_scan(tmp_path / "scan.ply", *scan)
    # The interpreter writes the name of each module that it imports.
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    done = gnrecon(path, "-o", tmp_path / "one.obj", "--widths", 200, "--steps", 1, "--resolution", 32, "--quiet")
    assert done.returncode == 0, done.stderr
    assert not {"open3d", "pymeshlab", "trimesh"} & {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    for name, seed in (("again.obj", 0), ("other.obj", 1)):
        reconstruct(path, widths=(200,), steps=1, resolution=32, seed=seed).save(tmp_path / name)
    one, again, other = ((tmp_path / f"{name}.obj").read_bytes() for name in ("one", "again", "other"))
    assert one == again
    assert one != other


def test_all_carriers_of_points_give_the_same_mesh(tmp_path: Path, scan: Cloud) -> None:
    import open3d
    import trimesh

    points, normals = (rows[:300] for rows in scan)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    path = write_scan(tmp_path / "scan.ply", points, normals)
    expected = reconstruct(points, normals, **TINY).mesh
    others: list[tuple[Any, ...]] = [
        (path,),
        (str(path),),
        (np.hstack([points, normals]),),
        (PointCloud(points, normals),),
        (cloud,),
        (trimesh.PointCloud(points), normals),
    ]
    for source in others:
        mesh = reconstruct(*source, **TINY).mesh
        assert np.array_equal(mesh.vertices, expected.vertices), type(source[0])
        assert np.array_equal(mesh.faces, expected.faces), type(source[0])


def test_trimesh_finds_the_mesh_watertight(result: Reconstruction) -> None:
    ours = replace(result, mesh=replace(result.mesh)).to_trimesh()
    assert ours.is_watertight
    assert ours.is_winding_consistent
    assert ours.volume == pytest.approx(result.mesh.volume)


def test_open3d_finds_the_mesh_watertight(scan: Cloud) -> None:
    assert reconstruct(*scan, **FAST).to_open3d().is_watertight()


def test_a_mesh_given_away_once_can_be_given_away_again(result: Reconstruction) -> None:
    assert result.mesh.normals is not None
    own = replace(result, mesh=replace(result.mesh, normals=result.mesh.normals.copy()))
    assert own.to_trimesh().is_watertight
    assert own.to_open3d().is_watertight()


def test_the_field_is_a_signed_distance_near_the_surface(scan: Cloud, result: Reconstruction) -> None:
    for distance in (-0.03, 0.03):
        assert np.median(result.sdf.sdf(scan[0] + distance * scan[1])) == pytest.approx(distance, rel=0.2)


def test_the_report_holds_everything_as_plain_values(scan: Cloud, result: Reconstruction) -> None:
    report = json.loads(json.dumps(result.report, allow_nan=False))
    assert report["schema_version"] == SCHEMA_VERSION
    assert report["command"] is None
    assert report["input"] == "ndarray"
    assert report["options"]["widths"] == [300]
    assert {"gnrecon", "python", "platform", "torch", "numpy"} <= set(report["versions"])
    assert report["ingest"]["read"] == report["ingest"]["kept"] + report["ingest"]["outliers"] == len(scan[0])
    kept = np.asarray(report["frame"]["center"])
    assert np.abs(kept).max() < 0.1
    assert report["frame"]["scale"] == pytest.approx(RADIUS, rel=0.05)
    assert report["fit"]["interrupted"] is False
    assert report["fit"]["parameters"] == 300 * 3 + 300 + 300 + 1
    assert [record["step"] for record in report["fit"]["history"]] == [1]
    assert report["fit"]["status"] == "Stopped at the limit of 1 steps."
    assert report["fit"]["residuals"]["points"] == report["ingest"]["kept"]
    assert 0 < report["fit"]["residuals"]["distance"]["rms"] < 0.02 * RADIUS
    assert 0 < report["fit"]["residuals"]["angle"]["rms"] < 10
    facts = report["mesh"]
    assert facts["genus"] == 1
    assert facts["closed"]
    assert facts["manifold"]
    assert facts["oriented"]
    assert facts["volume"] == result.mesh.volume
    assert facts["faces"] == len(result.mesh.faces)
    assert all(isinstance(sentence, str) for sentence in report["actions"])
    assert report["metrics"] is None
    assert [stage["name"] for stage in report["stages"]] == STAGES


def test_progress_is_told_of_stages_steps_and_remarks(scan: Cloud) -> None:
    told = Recorder()
    twice = tuple(np.concatenate([rows, rows[:7]]) for rows in scan)
    result = reconstruct(*twice, progress=told, widths=(200,), steps=2, resolution=32)
    assert told.stages == STAGES
    assert told.steps == [(1, 2), (2, 2)]
    assert f"Dropped 7 of {len(twice[0])} points that duplicate another." in told.remarks
    assert result.report["fit"]["status"] in told.remarks
    assert set(result.report["actions"]) <= set(told.remarks)


def test_a_reference_gives_metrics(tmp_path: Path, scan: Cloud, result: Reconstruction) -> None:
    result.save(tmp_path / "truth.ply")
    told = Recorder()
    again = reconstruct(*scan, reference=tmp_path / "truth.ply", progress=told, **FAST)
    assert told.stages[-1] == "measure"
    assert again.metrics is not None
    # The same scan again makes the same mesh; distances to it are cast in single precision.
    assert again.metrics.hausdorff < 1e-4 * RADIUS
    assert again.metrics.f_score == 1.0
    assert json.loads(json.dumps(again.report["metrics"]))["f_score"] == 1.0
    assert np.abs(again.mesh.attributes["error"]).max() < 1e-4 * RADIUS
    assert again.report["attributes"][-1]["name"] == "error"
    of_mesh = reconstruct(*scan, reference=result.mesh, **TINY)
    assert of_mesh.metrics == measure(of_mesh.mesh, result.mesh)


@pytest.mark.parametrize(("options", "kept"), [({"fraction": 0.5}, 600), ({"max_points": 500}, 500)])
def test_fewer_points_are_kept_on_demand(scan: Cloud, options: dict[str, Any], kept: int) -> None:
    report = reconstruct(*scan, outliers="off", **TINY, **options).report
    assert report["ingest"]["kept"] == kept
    assert report["ingest"]["thinned"] == 1200 - kept


@pytest.mark.parametrize("options", [{"fraction": 0.0}, {"fraction": 1.5}, {"max_points": 0}, {"max_points": 5}])
def test_impossible_shares_are_refused(scan: Cloud, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        reconstruct(*scan, **options)


def test_unknown_options_and_devices_are_refused_before_reading() -> None:
    with pytest.raises(UsageError, match="no option 'smoothness'"):
        reconstruct("missing.ply", smoothness=1)
    with pytest.raises(UsageError, match="device is 'abacus'"):
        reconstruct("missing.ply", device="abacus")


def test_threads_are_those_asked_for_and_restored(scan: Cloud) -> None:
    before = torch.get_num_threads()
    told = Recorder()
    reconstruct(*scan, progress=told, threads=before + 1, **FAST)
    assert told.threads == {before + 1}
    assert torch.get_num_threads() == before
    with pytest.raises(InputError):
        reconstruct(np.zeros((5, 3)), threads=before + 1)
    assert torch.get_num_threads() == before


def test_an_interrupt_keeps_the_best_field(scan: Cloud) -> None:
    result = reconstruct(*scan, progress=Recorder(interrupt_after=2), widths=(300,), steps=50, resolution=32)
    assert result.interrupted
    assert result.report["fit"]["interrupted"]
    assert result.report["fit"]["status"] == "Interrupted after 2 steps."
    assert len(result.report["fit"]["history"]) == 2
    assert result.mesh.volume == pytest.approx(TORUS_VOLUME, rel=0.02)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((10**9, 10**6), np.dtype(np.float64)),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes.\nframe #0"),
        torch.OutOfMemoryError("CUDA out of memory."),
    ],
    ids=["python", "numpy", "torch", "cuda"],
)
def test_failed_allocations_end_in_one_sentence(scan: Cloud, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def exhausted(*_: object) -> None:
        raise error

    monkeypatch.setattr("gnrecon.pipeline.fit", exhausted)
    before = torch.get_num_threads()
    with pytest.raises(MemoryLimitError, match=r"not enough memory .*--max-points") as caught:
        reconstruct(*scan, threads=before + 1)
    assert "\n" not in str(caught.value)
    assert torch.get_num_threads() == before


def test_a_limit_that_a_stage_names_itself_is_left_in_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(*_: object, **__: object) -> None:
        raise MemoryLimitError("The file holds too much.")

    monkeypatch.setattr("gnrecon.pipeline.read_scans", exhausted)
    with pytest.raises(MemoryLimitError, match=r"^The file holds too much\.$"):
        reconstruct("scan.ply")


def test_other_runtime_errors_are_not_taken_for_a_lack_of_memory(scan: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr("gnrecon.pipeline.fit", broken)
    with pytest.raises(RuntimeError, match=r"^a fault$"):
        reconstruct(*scan)


def test_an_unsound_mesh_is_neither_returned_nor_saved(
    tmp_path: Path, scan: Cloud, result: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    def torn(mesh: Mesh, *_: object, **__: object) -> tuple[Mesh, list[str]]:
        return Mesh(mesh.vertices, mesh.faces[1:]), []

    with pytest.raises(MeshError, match="open: 3 edges"):
        replace(result, mesh=torn(result.mesh)[0]).save(tmp_path / "mesh.ply")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("gnrecon.export.mesh_field.remove_handles", torn)
    with pytest.raises(MeshError, match="open: 3 edges"):
        reconstruct(*scan, **TINY)


def test_garbage_in_a_scan_changes_no_distance_and_no_page() -> None:
    points, _ = sphere(300, np.random.default_rng(0))
    smallest = {"widths": (40,), "steps": 0, "resolution": 16, "keep_handles": True}
    options: dict[str, Any] = {**smallest, "attributes": "distance", "open": False}
    clean = reconstruct(points, **options)
    dirty = reconstruct(np.vstack([points, [[0.0, 1e150, 0.0]]]), **options)
    assert dirty.cloud is not None
    assert len(dirty.cloud) == len(points)
    np.testing.assert_array_equal(dirty.mesh.attributes["distance"], clean.mesh.attributes["distance"])
    assert dirty.report["mesh"] == clean.report["mesh"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        page_text(dirty.report, dirty.mesh, dirty.cloud)


def test_parts_that_no_cells_resolve_are_named_before_the_fit() -> None:
    class UntilFit(Recorder):
        def stage(self, name: str) -> None:
            if name == "fit":
                raise KeyError("fit")

    points, normals = sphere(100, np.random.default_rng(0))
    progress = UntilFit()
    with pytest.raises(KeyError):
        reconstruct(
            np.vstack([points, points + np.array([500, 0, 0])]), np.vstack([normals] * 2), progress=progress, **TINY
        )
    assert [remark for remark in progress.remarks if remark.startswith("2 parts of the scan are far smaller")]
