"""Meshing as the options ask: edge lengths and greatest errors decide how fine, and the report tells."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
import pytest
from analytic_fields import UTM, Field, torus

from gnrecon.export import SignedDistance
from gnrecon.export import mesh_field as meshing
from gnrecon.export.export_parameters import ExportParameters, ResolutionParameters
from gnrecon.export.mesh_field import MeshOptions, cells_for_faces, mesh_field
from gnrecon.export.resolution import cells_for_sheet, chord_error
from gnrecon.ingest.point_spacing import neighbour_spacing
from gnrecon.options import Options
from gnrecon.pipeline import Progress, reconstruct
from gnrecon.runtime.errors import UsageError


class Precise(Field):
    """An analytic field, as precise in single precision."""

    def single(self) -> SignedDistance:
        return self


@pytest.fixture
def field() -> Precise:
    return Precise(torus(), frame=UTM)


def test_an_edge_length_decides_the_cells(field: Precise) -> None:
    meshed = mesh_field(field, MeshOptions(edge_length=1.2), data=None)
    assert meshed.fineness.edge_length == pytest.approx(1.2, rel=0.1)
    assert meshed.actions == [meshed.fineness.describe()]
    assert mesh_field(field, MeshOptions(resolution=20), data=None).actions == []


def test_a_mesh_becomes_finer_until_the_error_is_small_enough(field: Precise) -> None:
    coarse = mesh_field(field, MeshOptions(resolution=20), data=None)
    wanted = 0.2 * coarse.fineness.chord_error
    shares: dict[str, list[float]] = {}

    def stage(name: str) -> AbstractContextManager[None]:
        shares[name] = []
        return nullcontext()

    def advance(share: float) -> None:
        list(shares.values())[-1].append(share)

    options = MeshOptions(resolution=20, max_error=wanted)
    meshed = mesh_field(field, options, data=None, bounds=field.bounds, stages=stage, advance=advance)
    assert 20 < meshed.fineness.resolution < 80
    found = chord_error(meshed.mesh, field, field.bounds, np.ptp(field.bounds, axis=0).max() / 50)
    assert 0.2 * wanted < found <= wanted
    assert meshed.fineness.chord_error == pytest.approx(found, rel=0.1)
    assert len(meshed.actions) == 1
    assert list(shares) == ["extract", "project", "repair"]
    assert shares["extract"] == sorted(shares["extract"])
    assert 0.5 < shares["extract"][-1] <= 1.0
    again = mesh_field(field, replace(options, max_error=2 * coarse.fineness.chord_error), data=None)
    assert again.fineness.resolution == 20


def test_what_the_limit_of_cells_reaches_is_said(field: Precise) -> None:
    limited = ExportParameters(resolution=ResolutionParameters(most_refined_cells=30))
    meshed = mesh_field(field, MeshOptions(resolution=20, max_error=1e-6), data=None, parameters=limited)
    assert meshed.fineness.resolution == 30
    assert meshed.actions[-1] == "That is not within 1e-06: the limit of 30 cells was reached."


@pytest.mark.parametrize("values", [{"edge_length": 0.0}, {"edge_length": np.inf}, {"max_error": -1.0}])
def test_senseless_lengths_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="must be a positive length"):
        MeshOptions(**values)


def test_a_resolution_and_an_edge_length_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="only one of the two"):
        MeshOptions(resolution=128, edge_length=0.5)
    box = np.array([[0.0, 0, 0], [1, 1, 1]])
    assert MeshOptions().cells(box) == 256
    assert Options(edge_length=0.5).for_scan(np.zeros((9, 3)), box).resolution is None
    with pytest.raises(UsageError, match="possible"):
        MeshOptions(edge_length=1e-9).cells(np.array([[0.0, 0, 0], [1, 1, 1]]))


@pytest.mark.parametrize(("shift", "tilt", "kept"), [(0.0, 0.0, True), (0.3, 0.0, False), (0.0, 0.01, False)])
def test_single_precision_serves_where_values_and_gradients_agree(shift: float, tilt: float, kept: bool) -> None:
    class Double(Precise):
        def single(self) -> SignedDistance:
            return Field(lambda x: torus()(x) + shift * cell + tilt / 40 * np.sin(40 * x[:, 0]))

    cell = 2.2 / 50
    field, data = Double(torus()), np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3))
    assert (meshing._single_precision_field(field, data, 50) is not field) == kept


def test_cells_follow_the_points_where_nothing_was_asked_for() -> None:
    box, plane = np.array([[0.0, 0, 0], [1, 1, 0.2]]), np.stack(np.meshgrid(range(60), range(60), [0.0]), -1)
    points = plane.reshape(-1, 3) / 60
    spacing = neighbour_spacing(points)
    assert Options().for_scan(points, box).resolution == math.ceil(3.0 / spacing)
    assert 128 < math.ceil(3.0 / spacing) < 256
    assert Options().for_scan(points[::7], box).resolution == 128
    assert Options().for_scan(points[:5], box).resolution == 128
    assert Options().for_scan(points, 3 * box).resolution == 256
    assert Options().for_scan(np.zeros((9, 3)), box).resolution == 256
    assert Options(resolution=50).for_scan(points, box, sheet=0.01).resolution == 50
    # A box of length 1: two cells through a sheet, up to 512 along the box.
    assert Options().for_scan(points, box, sheet=1 / 200).resolution == cells_for_sheet(1, 1 / 200) == 400
    assert Options().for_scan(points, box, sheet=1 / 2000) == Options().for_scan(points, box)


def test_smooth_clean_shapes_get_the_cells_that_their_faces_need() -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 2 * np.pi, (2, 800))
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    points = 3 * np.stack([np.cos(u), np.sin(u), 0 * u], axis=1) + normals
    box = np.array([points.min(axis=0), points.max(axis=0)])
    found = {}
    for noise in (0.0, 0.02):
        scan = points + noise * rng.standard_normal((len(points), 1)) * normals
        result = reconstruct(scan, normals, quality="draft")
        cells = result.report["fineness"]["resolution"]
        assert result.report["options"]["resolution"] == cells
        found[noise] = cells
        by_points = Options().for_scan(scan, box).resolution
        assert by_points == 128
        if noise == 0.0:
            # The faces are then as near to the torus as the field is, or as near as the most cells allow.
            x = result.mesh.vertices[result.mesh.faces].mean(axis=1)
            off = np.hypot(np.hypot(x[:, 0], x[:, 1]) - 3, x[:, 2]) - 1
            assert np.abs(off).mean() < 3e-4
            assert cells_for_faces(result.sdf, 200) == max(200, cells)
            assert cells_for_faces(replace(result.sdf, detail=None), 128) == 128
        else:
            # A field that averages so many points for each length is worth more cells than the points have.
            assert result.sdf.detail is not None
            anything = {"least_cells": 16, "least_spacing_cells": 0.1}
            needed = cells_for_faces(result.sdf, 1024, **anything)
            assert 128 < needed < 1024
            # Half of the cells have four times the distance of the faces, which needs four times the noise.
            for factor, cells in ((4, needed / 2), (64, needed / 8)):
                detail = replace(result.sdf.detail, position=factor * result.sdf.detail.position)
                noisy = replace(result.sdf, detail=detail)
                assert cells_for_faces(noisy, 1024, **anything) == pytest.approx(cells, abs=1)
            # Sixteen times the points, of which the field keeps a part, leave a quarter of the error.
            many = cells_for_faces(noisy, 1024, points=16 * len(scan), **anything)
            assert many == pytest.approx(needed / 4, abs=1)
            # The noise hides what more cells gain, but not a sheet that the points show.
            assert cells_for_faces(noisy, 1024) == 64
            assert cells_for_faces(noisy, 1024, least_spacing_cells=5.0) == pytest.approx(
                5 * np.ptp(result.sdf.bounds, axis=0).max() / neighbour_spacing(scan), abs=1
            )
            box_edge = float(np.ptp(result.sdf.bounds, axis=0).max())
            assert cells_for_faces(noisy, 1024, sheet=box_edge / 150) == 300
    assert found[0.0] > found[0.02] == 128
    few = reconstruct(points[::8], normals[::8], quality="draft", resolution=24)
    assert few.report["fineness"]["resolution"] == 24


def test_an_impossible_edge_length_is_refused_before_the_fit() -> None:
    stages: list[str] = []

    class Recorded(Progress):
        def stage(self, name: str) -> None:
            stages.append(name)

    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    with pytest.raises(UsageError, match="possible"):
        reconstruct(points, points, edge_length=1e-9, progress=Recorded())
    assert stages == ["read", "ingest"]
