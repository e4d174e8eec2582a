"""The parameters of meshing: frozen, each in use, and those that are not passed are the defaults."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from analytic_fields import Field, sphere, torus
from parameter_checks import assert_frozen, field_names, read_attributes

import gnrecon.export
from gnrecon.export import Neighbourhood, extract, remesh, remove_handles, trim
from gnrecon.export.export_parameters import (
    ExportParameters,
    ExtractionParameters,
    HandleParameters,
    RemeshParameters,
    TrimParameters,
)
from gnrecon.export.lattice import Lattice
from gnrecon.export.mesh_field import MeshOptions, mesh_field
from gnrecon.export.sparse_grid import narrow_band


def test_they_are_frozen() -> None:
    for parameters in (ExportParameters(), *(getattr(ExportParameters(), f.name) for f in fields(ExportParameters))):
        assert_frozen(parameters)


@pytest.mark.parametrize("name", field_names(ExportParameters))
def test_each_is_used(name: str) -> None:
    assert name in read_attributes(gnrecon.export, "export_parameters.py")


def test_extraction_uses_its_parameters() -> None:
    field = Field(sphere())
    one, same = (extract(field, resolution=40, parameters=p) for p in (None, ExtractionParameters()))
    assert np.array_equal(one.vertices, same.vertices)
    assert np.array_equal(one.faces, same.faces)
    # Other blocks find the same surface, in another order, and a safer bound costs more evaluations.
    other = extract(field, resolution=40, parameters=ExtractionParameters(leaf_cells=8, chunk_cells=64))
    assert len(other.vertices) == len(one.vertices)
    assert other.volume == pytest.approx(one.volume)
    lattice = Lattice.over(Field(sphere()), 64, None, 65536)
    sizes = [
        len(narrow_band(lattice, parameters=ExtractionParameters(slope_margin=margin)).leaves) for margin in (1.25, 3.0)
    ]
    assert len(narrow_band(lattice).leaves) == sizes[0] < sizes[1]


def test_remeshing_uses_its_parameters() -> None:
    field = Field(sphere())
    mesh = extract(field, resolution=16)
    one, same, other = (
        remesh(mesh, field, 0.2, parameters=p)
        for p in (RemeshParameters(), ExportParameters.remesh, RemeshParameters(rounds=1))
    )
    assert np.array_equal(one.vertices, remesh(mesh, field, 0.2).vertices)
    assert np.array_equal(one.vertices, same.vertices)
    assert len(other.vertices) != len(one.vertices)


def test_trimming_uses_its_parameters(rng: np.random.Generator) -> None:
    mesh = extract(Field(sphere(0.8)), resolution=24)
    points = rng.normal(size=(2000, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    distances = Neighbourhood(points[points[:, 2] > 0]).distances(mesh.vertices)
    one, same, other = (
        trim(mesh, distances, 0.2, parameters=p)[0]
        for p in (None, TrimParameters(), TrimParameters(edge_clearance=0.4))
    )
    assert np.array_equal(one.vertices, same.vertices)
    assert not np.array_equal(one.vertices, other.vertices)


def test_meshing_passes_its_parameters_on() -> None:
    class Single(Field):
        def single(self) -> Field:
            return self

    field = Single(torus())
    options = MeshOptions(resolution=24)
    one = mesh_field(field, options, data=None)
    same = mesh_field(field, options, data=None, parameters=ExportParameters())
    assert np.array_equal(one.mesh.vertices, same.mesh.vertices)
    assert one.fineness == same.fineness
    median = replace(ExportParameters.resolution, error_quantile=0.5)
    lower = mesh_field(field, options, data=None, parameters=ExportParameters(resolution=median))
    assert lower.fineness.chord_error < one.fineness.chord_error


def test_handles_are_removed_by_their_parameters() -> None:
    mesh = extract(Field(torus()), resolution=32)
    # Points at the far side alone support nothing of the ring's tube here.
    points = mesh.vertices[mesh.vertices[:, 0] > 0.3]
    kept, sentences = remove_handles(mesh, points, parameters=HandleParameters(rounds=0))
    assert kept is mesh
    assert sentences == []
    one, same = (remove_handles(mesh, points, parameters=p) for p in (None, HandleParameters()))
    assert np.array_equal(one[0].vertices, same[0].vertices)
    assert one[1] == same[1]
