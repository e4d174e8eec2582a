"""A fitted sphere, offset, hollowed and cropped."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from made_shapes import sphere

from gnrecon.export import require_sound
from gnrecon.fit import NeuralSDF
from gnrecon.options import Options
from gnrecon.pipeline import reconstruct
from gnrecon.runtime.errors import MemoryLimitError, MeshError, UsageError
from gnrecon.solid import Shape, shaped

OPTIONS = Options(resolution=32)
BIG = 1000.0
CENTRE = np.array([500_000.0, 4_500_000.0, 100.0])
"""The unit sphere as a scan of a kilometre, in projected coordinates."""


@pytest.fixture(scope="module")
def sdf() -> NeuralSDF:
    points, normals = sphere(1000, np.random.default_rng(2))
    return reconstruct(CENTRE + BIG * points, normals, widths=(600,), steps=1, resolution=32).sdf


def radii(vertices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices - CENTRE, axis=1) / BIG


def box(low: float, high: float) -> np.ndarray:
    return np.stack([CENTRE + BIG * low, CENTRE + BIG * high])


def test_the_fields_own_surface(sdf: NeuralSDF) -> None:
    mesh, remarks = shaped(sdf, OPTIONS, Shape())
    assert np.abs(radii(mesh.vertices) - 1).max() < 0.02
    assert not [remark for remark in remarks if "lies" in remark]


@pytest.mark.parametrize("offset", [0.2, -0.3])
def test_an_offset_is_a_distance_and_is_measured(sdf: NeuralSDF, offset: float) -> None:
    mesh, remarks = shaped(sdf, OPTIONS, Shape(offset=offset * BIG))
    require_sound(mesh)
    assert np.abs(radii(mesh.vertices) - (1 + offset)).max() < 0.02
    said = next(remark for remark in remarks if "offset by" in remark)
    numbers = [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]\d+)?", said)]
    level, mean, least, most = numbers
    assert level == offset * BIG
    assert mean == pytest.approx(abs(offset) * BIG, rel=0.01)
    assert least <= mean <= most


def test_a_shell_has_two_walls_at_its_thickness(sdf: NeuralSDF) -> None:
    hollow, _ = shaped(sdf, OPTIONS, Shape(shell=0.2 * BIG))
    facts = require_sound(hollow)
    assert (facts.components, facts.genus) == (2, 0)
    assert facts.volume == pytest.approx(4 / 3 * np.pi * (1 - 0.8**3) * BIG**3, rel=0.02)
    outer, _ = shaped(sdf, OPTIONS, Shape(offset=0.1 * BIG, shell=0.2 * BIG))
    assert np.abs(np.abs(radii(outer.vertices) - 1) - 0.1).max() < 0.02
    assert (radii(outer.vertices) > 1).any()
    assert (radii(outer.vertices) < 1).any()


def test_a_crop_is_exact_and_as_fine_as_asked(sdf: NeuralSDF) -> None:
    corner = np.stack([CENTRE + BIG * np.array([0.5, -0.2, -0.3]), CENTRE + BIG * np.array([2.0, 0.2, 0.3])])
    mesh, _ = shaped(sdf, OPTIONS, Shape(crop=corner))
    require_sound(mesh)
    assert mesh.vertices[:, 0].min() == corner[0, 0]
    assert (mesh.vertices[:, 1].min(), mesh.vertices[:, 1].max()) == (corner[0, 1], corner[1, 1])
    assert (mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()) == (corner[0, 2], corner[1, 2])
    inner = ((mesh.vertices > corner[0]) & (mesh.vertices < corner[1])).all(axis=1)
    assert np.abs(radii(mesh.vertices[inner]) - 1).max() < 0.02
    refined_resolution, _ = shaped(sdf, replace(OPTIONS, resolution=64), Shape(crop=corner))
    assert len(refined_resolution.faces) > 2.5 * len(mesh.faces)
    assert refined_resolution.volume == pytest.approx(mesh.volume, rel=0.01)


def test_a_cropped_shell_is_open_to_see_and_still_one_solid(sdf: NeuralSDF) -> None:
    half, _ = shaped(
        sdf, OPTIONS, Shape(shell=0.2 * BIG, crop=np.stack([CENTRE - 2 * BIG, CENTRE + BIG * np.array([2, 2, 0])]))
    )
    facts = require_sound(half)
    assert (facts.components, facts.genus) == (1, 0), "a bowl, whose walls meet at the rim"
    assert facts.volume == pytest.approx(2 / 3 * np.pi * (1 - 0.8**3) * BIG**3, rel=0.03)


def test_a_crop_far_within_is_a_block_and_said_to_be_unscanned(sdf: NeuralSDF) -> None:
    block, remarks = shaped(sdf, OPTIONS, Shape(crop=box(-0.2, 0.1)))
    assert require_sound(block).volume == pytest.approx((0.3 * BIG) ** 3, rel=1e-6)
    assert "None of the model's points lie in the box" in remarks[0]


def test_a_field_without_points_keeps_everything_and_says_so(sdf: NeuralSDF) -> None:
    mesh, remarks = shaped(replace(sdf, support=None), OPTIONS, Shape())
    assert "holds no points" in remarks[0]
    require_sound(mesh)


def test_shapes_that_leave_nothing(sdf: NeuralSDF) -> None:
    with pytest.raises(UsageError, match=r"nowhere deeper than about (9\d\d|1e\+03|1\.0\de\+03) units"):
        shaped(sdf, OPTIONS, Shape(offset=-1.2 * BIG))
    with pytest.raises(UsageError, match="leaves nothing"):
        shaped(sdf, OPTIONS, Shape(shell=1.2 * BIG))
    with pytest.raises(UsageError, match="The crop lies outside of the model; the box of the model is"):
        shaped(sdf, OPTIONS, Shape(crop=box(3.0, 4.0)))
    with pytest.raises(MeshError, match="no zero level"):
        shaped(sdf, OPTIONS, Shape(crop=box(0.9, 1.05)))
    with pytest.raises(UsageError, match="too small for this shape"):
        shaped(sdf, OPTIONS, Shape(offset=1e-9 * BIG))
    for level in (Shape(offset=1e30), Shape(offset=-1e30), Shape(shell=1e30)):
        with pytest.raises(UsageError, match="out of proportion to the model"):
            shaped(sdf, OPTIONS, level)
    with pytest.raises(UsageError, match="thinner than a millionth of the model"):
        shaped(sdf, OPTIONS, Shape(crop=box(0.0, 1e-300)))
    with pytest.raises(UsageError, match="give --max-error at least"):
        shaped(sdf, replace(OPTIONS, max_error=1e-8 * BIG), Shape())
    for thickness in (0.0, -1.0, float("nan")):
        with pytest.raises(UsageError, match="must be positive"):
            Shape(shell=thickness)


@pytest.mark.parametrize(("cells", "offset"), [(16_384, 0.0), (1024, 9.9)])
def test_more_cells_than_memory_holds_are_refused_before_the_work(sdf: NeuralSDF, cells: int, offset: float) -> None:
    with pytest.raises(MemoryLimitError, match="needs about"):
        shaped(sdf, Options(resolution=cells), Shape(offset=offset * float(np.ptp(sdf.bounds, axis=0).max())))
