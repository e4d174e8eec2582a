"""Extraction against the whole grid's marching cubes and against shapes of known genus, area and volume."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UNIT, UTM, Field, plate, shells, sines, sphere, torus, union
from skimage.measure import marching_cubes

from gnrecon.export import extract, project, require_sound, verify
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.lattice import Lattice
from gnrecon.export.leaf_storage import GrowingArray, LeafStore
from gnrecon.export.sparse_grid import narrow_band
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import MeshError, UsageError

SHAPES = {
    "sphere": sphere(),
    "torus": torus(),
    "two spheres": union(sphere(0.3, (-0.5, 0, 0)), sphere(0.25, (0.4, 0.3, 0.1))),
    "nested shells": shells(),
    "thin plate": plate(0.03),
    "sphere beyond the box": sphere(1.3),
    "random sines": sines(7),
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_narrow_band_gives_the_whole_grids_surface(name: str) -> None:
    field = Field(SHAPES[name])
    mesh = extract(field, resolution=64)
    lattice = Lattice.over(field, 64, None, 65536)
    nodes = np.stack(np.meshgrid(*[np.arange(n + 1) for n in lattice.cells], indexing="ij"), axis=-1)
    values = lattice.values(nodes.reshape(-1, 3), narrow_band(lattice).slope).reshape(nodes.shape[:3])
    least = ExportParameters.extraction.least_node_cells
    values = np.where(np.abs(values) < least, np.where(values < 0, -least, least), values)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    expected = lattice.world(vertices.astype(np.float64))
    assert len(mesh.faces) == len(faces)
    assert len(mesh.vertices) == len(expected)
    # scikit-image works in float32.
    distance, nearest = _nearest(expected, mesh.vertices)
    assert distance.max() < 2e-5 * lattice.cell
    assert len(np.unique(nearest)) == len(expected)
    ours = {tuple(np.roll(face, -int(np.argmin(face)))) for face in mesh.faces}
    theirs = nearest[faces]
    assert {tuple(np.roll(face, -int(np.argmin(face)))) for face in theirs} == ours


def _nearest(queries: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    return cKDTree(targets).query(queries)


@pytest.mark.parametrize("name", ["torus", "sphere beyond the box", "random sines"])
def test_a_field_that_knows_blocks_is_asked_for_them_within_its_box(name: str) -> None:
    class Knowing(Field):
        def sdf_around(self, centers: np.ndarray, offsets: np.ndarray) -> np.ndarray:
            points = (centers[:, None] + offsets).reshape(-1, 3)
            low, high = self.bounds
            assert ((points >= low - 1e-9) & (points <= high + 1e-9)).all()
            return Field(SHAPES[name]).sdf(points).reshape(len(centers), -1)

    knowing, plain = Knowing(SHAPES[name]), Field(SHAPES[name])
    mesh, expected = extract(knowing, resolution=64), extract(plain, resolution=64)
    assert np.array_equal(mesh.faces, expected.faces)
    assert np.allclose(mesh.vertices, expected.vertices, rtol=0, atol=1e-9)
    assert knowing.asked < 0.5 * plain.asked


def test_few_points_are_asked() -> None:
    field = Field(sphere())
    mesh = extract(field, resolution=256)
    assert field.asked < 8 * len(mesh.vertices) < 0.1 * 256**3


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
@pytest.mark.parametrize(
    ("function", "components", "genus", "volume"),
    [
        (sphere(), 1, 0, 4 / 3 * np.pi * 0.8**3),
        (torus(), 1, 1, 2 * np.pi**2 * 0.6 * 0.2**2),
        (SHAPES["two spheres"], 2, 0, 4 / 3 * np.pi * (0.3**3 + 0.25**3)),
        (shells(), 3, 0, 4 / 3 * np.pi * (0.9**3 - 0.7**3 + 0.3**3)),
        (plate(), 1, 0, 8 * 0.8 * 0.7 * 0.011),
    ],
    ids=["sphere", "torus", "two spheres", "nested shells", "thin plate"],
)
def test_known_shapes(function: object, components: int, genus: int, volume: float, frame: Frame) -> None:
    field = Field(function, frame=frame)  # type: ignore[arg-type]
    mesh = project(extract(field, resolution=128), field)
    facts = require_sound(mesh)
    assert (facts.components, facts.genus) == (components, genus)
    assert facts.volume == pytest.approx(volume * frame.scale**3, rel=0.015)
    assert np.abs(field.sdf(mesh.vertices)).max() < 1e-9 * frame.scale
    assert mesh.normals is not None
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test_projection_beats_interpolation_and_gives_the_exact_normals() -> None:
    field = Field(sphere(0.8), frame=UTM)
    rough = extract(field, resolution=32)
    fine = project(rough, field)
    assert np.abs(field.sdf(rough.vertices)).max() > 1e-3
    assert np.abs(field.sdf(fine.vertices)).max() < 1e-8
    radial = UTM.to_unit(fine.vertices)
    assert np.allclose(fine.normals, radial / np.linalg.norm(radial, axis=1, keepdims=True), atol=1e-6)


def test_a_rough_field_gives_all_but_the_last_step_and_its_values() -> None:
    class Valued(Field):
        def gradient(self, points: np.ndarray) -> np.ndarray:
            raise AssertionError(f"values alone are asked of the exact field, not gradients at {len(points)} points")

    waves = sines(3, frequency=9.0)
    exact, rough = Valued(sphere(0.8), frame=UTM), Field(lambda x: sphere(0.8)(x) + 1e-4 * waves(x), frame=UTM)
    start = extract(rough, resolution=32)
    fine = project(start, exact, steps=2, rough=rough)
    assert np.abs(exact.sdf(project(start, rough).vertices)).max() > 1e-5 * UTM.scale
    assert np.abs(exact.sdf(fine.vertices)).max() < 1e-7 * UTM.scale
    radial = UTM.to_unit(fine.vertices)
    assert np.allclose(fine.normals, radial / np.linalg.norm(radial, axis=1, keepdims=True), atol=5e-3)


@pytest.mark.parametrize("seed", range(5))
def test_projection_turns_no_face_over(seed: int) -> None:
    field = Field(sines(seed, frequency=9.0))
    rough = extract(field, resolution=40)
    fine = project(rough, field)
    assert np.array_equal(fine.faces, rough.faces)
    old, new = rough.face_vectors, fine.face_vectors
    assert (np.einsum("ij,ij->i", old, new) > 0).all()
    free = np.abs(rough.vertices).max(axis=1) < 1.0
    assert np.mean(np.abs(field.sdf(fine.vertices[free])) < 1e-9) > 0.9
    assert np.mean(np.abs(field.sdf(rough.vertices[free])) < 1e-9) < 0.1
    assert require_sound(fine).volume > 0


def test_a_wrong_gradient_scale_does_not_lose_the_surface() -> None:
    for factor in (0.05, 40.0):
        mesh = extract(Field(lambda x, factor=factor: factor * sphere()(x)), resolution=64)
        exact = extract(Field(sphere()), resolution=64)
        assert np.allclose(mesh.vertices, exact.vertices, atol=1e-4)


def test_a_slope_that_gradients_do_not_show_leaves_no_hole() -> None:
    """A step 1e-3 wide between two constants: its gradient vanishes at every sample, propagation alone follows it."""
    steep = Field(lambda x: np.clip(500 * sphere(0.63)(x), -1, 1))
    facts = require_sound(extract(steep, resolution=96))
    assert (facts.components, facts.genus) == (1, 0)
    assert facts.volume == pytest.approx(4 / 3 * np.pi * 0.63**3, rel=0.05)


def test_values_of_zero_on_nodes_make_no_degenerate_faces() -> None:
    cube = Field(lambda x: np.abs(x).max(axis=1) - 0.5, reach=1.0)
    mesh = extract(cube, resolution=32)
    assert np.linalg.norm(mesh.face_vectors, axis=1).min() > 0
    assert require_sound(mesh).volume == pytest.approx(1.0, rel=0.03)


def test_a_shape_beyond_the_box_ends_in_flat_caps() -> None:
    field = Field(sphere(1.3), reach=1.0, frame=UTM)
    mesh = project(extract(field, resolution=40), field)
    facts = require_sound(mesh)
    unit = UTM.to_unit(mesh.vertices)
    assert np.abs(unit).max() <= 1.0
    capped = np.abs(unit).max(axis=1) > 0.97
    assert capped.sum() > 100
    assert facts.volume == pytest.approx(UTM.scale**3 * 7.1, rel=0.1)


def test_bounds_narrow_the_box() -> None:
    mesh = extract(Field(sphere(0.5)), resolution=40, bounds=np.array([[0, -1, -1], [1, 1, 1.0]]))
    assert mesh.vertices[:, 0].min() >= 0
    # The cap lies half a cell inside of the box, at x = 0.025.
    expected = np.pi * (0.25 * 0.475 - (0.5**3 - 0.025**3) / 3)
    assert require_sound(mesh).volume == pytest.approx(expected, rel=0.05)


def test_same_bytes_again_whatever_the_batch() -> None:
    one = extract(Field(torus()), resolution=48)
    two = extract(Field(torus()), resolution=48, batch=997)
    assert np.array_equal(one.vertices, two.vertices)
    assert np.array_equal(one.faces, two.faces)


def test_nothing_to_mesh_is_said() -> None:
    with pytest.raises(MeshError, match="no zero level"):
        extract(Field(lambda x: np.ones(len(x))), resolution=16)
    with pytest.raises(MeshError, match="not finite"):
        extract(Field(lambda x: np.full(len(x), np.nan)), resolution=16)


def test_senseless_options_are_refused() -> None:
    with pytest.raises(UsageError, match="resolution is 3"):
        extract(Field(sphere()), resolution=3)
    with pytest.raises(UsageError, match="batch is 0"):
        extract(Field(sphere()), batch=0)
    with pytest.raises(UsageError, match="not a lower and an upper corner"):
        extract(Field(sphere()), bounds=np.zeros((2, 3)))
    mesh = extract(Field(sphere()), resolution=8)
    with pytest.raises(UsageError, match="steps is -1"):
        project(mesh, Field(sphere()), steps=-1)
    with pytest.raises(UsageError, match="limit is 0"):
        project(mesh, Field(sphere()), limit=0)


@pytest.mark.parametrize("seed", range(3))
def test_small_parts_far_from_each_other_are_all_found(seed: int) -> None:
    """A steep, wrinkled field in free space, as fits leave it there, hides components of a few cells."""
    wrinkled = Field(sines(seed, frequency=14.0))
    smooth = Field(lambda x: np.maximum(sphere(0.9)(x), 8 * wrinkled.function(x) + 2.0))
    lattice = Lattice.over(smooth, 80, None, 65536)
    nodes = np.stack(np.meshgrid(*[np.arange(n + 1) for n in lattice.cells], indexing="ij"), axis=-1)
    inside = lattice.values(nodes.reshape(-1, 3), 1.0).reshape(nodes.shape[:3]) < 0
    crossed = [np.diff(inside, axis=axis) for axis in range(3)]
    mesh = extract(smooth, resolution=80)
    assert verify(mesh).components > 20
    # Marching cubes puts a vertex on every lattice edge whose ends differ, and few besides.
    assert 0 <= len(mesh.vertices) - sum(map(np.count_nonzero, crossed)) < 0.01 * len(mesh.vertices)


def test_cost_grows_with_the_surface() -> None:
    asked, kept = [], []
    for resolution in (64, 128, 256):
        field = Field(torus())
        band = narrow_band(Lattice.over(field, resolution, None, 65536))
        asked.append(field.asked)
        kept.append(len(band.leaves))
    # The search's coarse blocks, a fixed number, cost most at first.
    assert asked[1] / asked[0] < 5
    assert asked[2] / asked[1] < 5
    assert kept[2] / kept[1] == pytest.approx(4, rel=0.2)


def test_leaves_hold_the_values_that_were_stored() -> None:
    leaves = LeafStore(np.array([2, 1, 3]), 8.0)
    assert not len(leaves.mixed_chunks())
    leaves.mark_inside(np.array([[0, 0, 1]]), 32)
    leaves.mark_inside(np.array([[2, 0, 0]]), 16)
    values = np.arange(2 * 64, dtype=np.float32).reshape(2, 4, 4, 4)
    leaves.store(np.array([[8, 1, 0], [3, 3, 3]]), values)
    assert len(leaves) == 2
    first, second = (leaves.nodes(leaves.rows(np.array(chunk))) for chunk in ((0, 0, 0), (1, 0, 0)))
    assert np.array_equal(first[12:16, 12:16, 12:16], values[1])
    assert np.array_equal(first[32, 4:8, 0:4], values[0, 0])
    assert np.array_equal(second[:4, 4:8, :4], values[0])
    assert (second[:16, 8:16, :16] == -8).all()
    assert (second[16:, :, :32] == 8).all()
    assert (first[:32, :32, 32] == -8).all()
    assert {tuple(chunk) for chunk in leaves.mixed_chunks()} == {(0, 0, 0), (1, 0, 0), (0, 0, 1)}


def test_rows_are_appended_to_what_grows() -> None:
    rows = GrowingArray(np.zeros((1, 2), dtype=np.int32))
    for count in (1, 5, 1, 300):
        start = len(rows.rows)
        new = np.full((count, 2), count, dtype=np.int32)
        assert np.array_equal(rows.append(new), np.arange(start, start + count))
        assert np.array_equal(rows.rows[start:], new)
    assert rows.rows[0].tolist() == [0, 0]
    assert len(rows.rows) == 308


def test_a_flat_field_moves_no_vertex() -> None:
    flat = Field(lambda x: np.sign(sphere(0.6)(x)))
    mesh = extract(flat, resolution=24)
    assert np.array_equal(project(mesh, flat).vertices, mesh.vertices)
