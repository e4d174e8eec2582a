"""Refinement does what was asked for in order, keeps the topology, and says what it did and what it gave up."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from analytic_fields import Field, sphere, torus, union
from sharp_fields import box, cylinder, extracted

from gnrecon.export import RefineOptions, quality, refine, require_sound
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError


def test_nothing_asked_for_is_nothing_done() -> None:
    field = Field(box())
    mesh = extracted(field)
    result, actions = refine(mesh, field, RefineOptions())
    assert result is mesh
    assert actions == []


def test_steps_run_in_their_order_and_are_reported() -> None:
    field = Field(cylinder())
    mesh = extracted(field)
    shares: list[float] = []
    options = RefineOptions(remesh=0.08, simplify=0.001, faces=400)
    result, actions = refine(mesh, field, options, advance=shares.append)
    verbs = [action.split(":")[0] for action in actions]
    assert verbs == [
        "Sharpened edges",
        "Remeshed to edges of 0.08",
        "Simplified to within 0.001",
        "Decimated to 400 faces",
    ]
    counts = [[int(number) for number in re.findall(r"(\d+) faces became (\d+)", action)[0]] for action in actions]
    assert counts[0][0] == len(mesh.faces)
    assert [after for _, after in counts[:-1]] == [before for before, _ in counts[1:]]
    assert counts[-1][1] == len(result.faces) <= 400
    assert shares == [0.25, 0.5, 0.75, 1.0]
    assert require_sound(result).genus == 0


def test_without_edges_nothing_is_sharpened() -> None:
    field = Field(sphere())
    _, actions = refine(extracted(field, 48), field, RefineOptions(faces=500))
    assert [action.split(":")[0] for action in actions] == ["Decimated to 500 faces"]


def test_a_smaller_angle_keeps_blunter_edges() -> None:
    """Two balls of one size that overlap almost wholly meet at a blunt angle, about 25 degrees."""
    field = Field(union(sphere(0.7, (0.15, 0, 0)), sphere(0.7, (-0.15, 0, 0))))
    mesh = extracted(field, 48)
    on = []
    for angle in (15.0, 60.0):
        found, _ = refine(mesh, field, RefineOptions(remesh=0.12, feature_angle=angle))
        ring = np.hypot(
            found.vertices[:, 0], np.hypot(found.vertices[:, 1], found.vertices[:, 2]) - np.sqrt(0.7**2 - 0.15**2)
        )
        on.append(np.count_nonzero(ring < 1e-6))
    assert on[0] > 25
    assert on[1] < 0.2 * on[0]


def test_two_components_stay_two() -> None:
    field = Field(union(sphere(0.3, (0.5, 0, 0)), sphere(0.3, (-0.5, 0, 0))))
    result, _ = refine(extracted(field, 48), field, RefineOptions(remesh=0.1, faces=300))
    assert require_sound(result).components == 2


def test_a_handle_is_not_lost_for_the_sake_of_few_faces() -> None:
    field = Field(torus())
    result, actions = refine(extracted(field), field, RefineOptions(faces=4))
    assert require_sound(result).genus == 1
    assert len(result.faces) > 4
    assert actions


def test_a_tolerance_that_would_leave_nothing_is_lowered_or_given_up() -> None:
    field = Field(sphere())
    mesh = extracted(field, 16)
    result, actions = refine(mesh, field, RefineOptions(simplify=100.0))
    assert require_sound(result).genus == 0
    assert actions == [
        "Not simplified to within 100: manifold3d left nothing of the mesh (within the tolerance it is flat)."
    ]
    assert result is mesh


def test_a_step_that_fails_is_tried_more_gently(monkeypatch: pytest.MonkeyPatch) -> None:
    field = Field(sphere())
    tried: list[float] = []

    def fails_when_strong(mesh: Mesh, _: Field, tolerance: float) -> Mesh:
        tried.append(tolerance)
        if tolerance > 0.01:
            raise MeshError("Too strong.")
        return Mesh(mesh.vertices[:, [1, 2, 0]], mesh.faces)

    monkeypatch.setattr(sys.modules["gnrecon.export.remeshing.refine"], "simplify", fails_when_strong)
    _, actions = refine(extracted(field, 16), field, RefineOptions(simplify=0.02))
    assert tried == [0.02, 0.01]
    assert "Simplified to within 0.02, at 0.5 of the strength because more failed (Too strong.)" in actions[0]


def test_a_step_that_changes_the_topology_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    field = Field(sphere())
    mesh, ring = extracted(field, 16), extracted(Field(torus()), 24)
    monkeypatch.setattr(sys.modules["gnrecon.export.remeshing.refine"], "decimate", lambda *_, **__: ring)
    result, actions = refine(mesh, field, RefineOptions(faces=10))
    assert result is mesh
    assert "genus would have changed from 1 and 0 to 1 and 1" in actions[-1]


def test_the_shape_of_faces_improves() -> None:
    field = Field(cylinder())
    mesh = extracted(field)
    result, _ = refine(mesh, field, RefineOptions(remesh=0.07))
    assert quality(result).angle_degrees["p1"] > 30 > quality(mesh).angle_degrees["p1"]


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"remesh": 0.0}, "edge length to remesh to must be positive, not 0"),
        ({"remesh": float("nan")}, "edge length to remesh to must be positive"),
        ({"simplify": -1.0}, "tolerance to simplify to must be positive, not -1"),
        ({"simplify": float("inf")}, "tolerance to simplify to must be positive"),
        ({"faces": 3}, "number of faces must be at least 4, not 3"),
        ({"feature_angle": 1.0}, "feature angle must be from 5 to 90 degrees, not 1"),
        ({"feature_angle": float("nan")}, "feature angle must be from 5 to 90 degrees"),
        ({"adaptive": True}, "need a longest one; add --remesh"),
    ],
)
def test_senseless_options_are_refused(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        RefineOptions(**values)
