"""Handles and tunnels that no points support are removed; those that points lie on stay."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from analytic_fields import UTM, Field, Function, sphere, torus, union

from gnrecon.export import extract, project, remove_handles, require_sound
from gnrecon.export.cycles import short_loops
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError

Float = np.ndarray
APART = 0.07
"""Of the points, in radii; the disk of each has a radius of 0.04, and a rim of 0.25."""


def box(half: tuple[float, float, float], center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Function:
    return lambda x: (np.abs(x - np.array(center)) - np.array(half)).max(axis=1)


def rod(radius: float, x: float = 0.0, y: float = 0.0, half: float = 0.3) -> Function:
    """A round rod along z."""
    return lambda p: np.maximum(np.hypot(p[:, 0] - x, p[:, 1] - y) - radius, np.abs(p[:, 2]) - half)


def without(solid: Function, *tools: Function) -> Function:
    return lambda x: np.max([solid(x), *(-tool(x) for tool in tools)], axis=0)


def clip() -> Function:
    """Two plates, 0.2 apart, on one back."""
    return union(
        box((0.7, 0.6, 0.06), (0.0, 0.0, 0.16)),
        box((0.7, 0.6, 0.06), (0.0, 0.0, -0.16)),
        box((0.06, 0.6, 0.22), (-0.7, 0.0, 0.0)),
    )


def meshed(function: Function, resolution: int = 90) -> Mesh:
    field = Field(function, reach=0.93, frame=UTM)
    return project(extract(field, resolution=resolution), field)


def scanned(mesh: Mesh) -> Float:
    """Points about `APART` radii apart, evenly over a surface."""
    cells = np.floor((mesh.vertices - UTM.center) / (APART * UTM.scale)).astype(int)
    return mesh.vertices[np.unique(cells, axis=0, return_index=True)[1]]


def genus(mesh: Mesh) -> int:
    return 1 - mesh.euler_characteristic // 2


def off(mesh: Mesh, truth: Mesh) -> float:
    """The farthest of a mesh's vertices from a surface, in radii."""
    return float(nearest_on_surface(truth, mesh.vertices)[0].max()) / UTM.scale


@pytest.fixture(scope="module")
def true_clip() -> Mesh:
    return meshed(clip())


def test_necks_between_plates_are_cut(true_clip: Mesh) -> None:
    spots = list(itertools.product((-0.3, 0.0, 0.3), (-0.3, 0.1)))
    mesh = meshed(union(clip(), *(rod(0.03, x, y, 0.15) for x, y in spots)))
    assert genus(mesh) == len(spots)
    mesh = mesh.with_attributes({"height": mesh.vertices[:, 2]})
    result, actions = remove_handles(mesh, scanned(true_clip))
    assert require_sound(result).components == 1
    assert np.abs(result.attributes["height"] - result.vertices[:, 2]).max() < 0.2 * UTM.scale
    assert genus(result) == 0
    assert off(mesh, true_clip) > 0.09
    assert off(result, true_clip) < 0.04
    assert result.volume == pytest.approx(true_clip.volume, rel=0.002)
    assert actions[0].startswith("Removed 6 handles or tunnels that no points support, up to ")
    # What is far from the necks is as it was, normals included.
    kept = np.isin(mesh.vertices, result.vertices).all(axis=1)
    assert kept.mean() > 0.8
    assert result.normals is not None
    assert np.allclose(np.linalg.norm(result.normals, axis=1), 1.0)


def test_tunnels_through_a_plate_are_closed() -> None:
    plate = box((0.7, 0.7, 0.06))
    spots = [(x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)]
    truth, mesh = meshed(plate), meshed(without(plate, *(rod(0.035, x, y) for x, y in spots)))
    assert genus(mesh) == len(spots)
    result, _ = remove_handles(mesh, scanned(truth))
    assert require_sound(result).genus == 0
    assert off(result, truth) < 0.03
    assert result.volume == pytest.approx(truth.volume, rel=0.003)


def test_what_points_lie_on_stays() -> None:
    """Tunnels and rods of the same size, seen by the scanner: no wider than the points are apart, or a little."""
    plate = box((0.5, 0.5, 0.12))
    for radius in (0.035, 0.06):
        bored = meshed(without(plate, rod(radius), rod(radius, 0.3, 0.2)))
        around = bored.vertices[np.abs(bored.vertices - UTM.center)[:, 2] < 0.1 * UTM.scale]
        points = np.concatenate([scanned(bored), around[::7]])
        assert genus(bored) == 2
        assert remove_handles(bored, points) == (bored, [])
    bridged = meshed(union(clip(), rod(0.06, 0.2, 0.1, 0.15)))
    assert genus(bridged) == 1
    assert remove_handles(bridged, scanned(bridged)) == (bridged, [])


def test_what_is_wide_stays_unseen() -> None:
    """A tunnel much wider than the points are apart is none of a fit's making, though no point lies on its wall."""
    plate = box((0.7, 0.7, 0.06))
    bored = meshed(without(plate, rod(0.2)))
    points = scanned(bored)
    seen = np.hypot(*(points - UTM.center)[:, :2].T) > 0.21 * UTM.scale
    assert remove_handles(bored, points[seen]) == (bored, [])


def test_a_wide_neck_that_no_point_is_near_is_cut(true_clip: Mesh) -> None:
    """A tunnel as wide as it stays: a scanner that sees both its mouths may see nothing of its wall."""
    necked = meshed(union(clip(), rod(0.1, 0.2, 0.0, 0.15)))
    assert genus(necked) == 1
    result, actions = remove_handles(necked, scanned(true_clip))
    assert require_sound(result).genus == 0
    assert "a handle or tunnel" in actions[0]
    assert off(result, true_clip) < 0.04
    bored = meshed(without(box((0.5, 0.5, 0.15)), rod(0.12)))
    points = scanned(bored)
    seen = np.hypot(*(points - UTM.center)[:, :2].T) > 0.13 * UTM.scale
    assert genus(bored) == 1
    assert remove_handles(bored, points[seen]) == (bored, [])


def test_a_neck_that_holds_a_part_is_not_cut() -> None:
    balls = meshed(union(sphere(0.3, (0.0, 0.0, 0.5)), sphere(0.3, (0.0, 0.0, -0.5)), rod(0.03, half=0.3)))
    apart = meshed(union(sphere(0.3, (0.0, 0.0, 0.5)), sphere(0.3, (0.0, 0.0, -0.5))))
    assert genus(balls) == 0
    ring = meshed(torus(0.6, 0.2))
    for mesh, truth in ((balls, apart), (ring, ring)):
        assert remove_handles(mesh, scanned(truth)) == (mesh, [])


def test_two_parts_of_a_mesh_stay_separate() -> None:
    """A handle of one of two components is cut; the other, which has none, stays as it is."""
    bored = without(box((0.3, 0.7, 0.06), (0.5, 0.0, 0.0)), rod(0.03, 0.5, 0.2))
    ball = sphere(0.3, (-0.4, 0.0, 0.0))
    truth = meshed(union(box((0.3, 0.7, 0.06), (0.5, 0.0, 0.0)), ball))
    result, actions = remove_handles(meshed(union(bored, ball)), scanned(truth))
    facts = require_sound(result)
    assert (facts.components, facts.euler_characteristic) == (2, 4)
    assert len(actions) == 1
    assert "a handle or tunnel" in actions[0]


def test_an_open_mesh_is_refused(true_clip: Mesh) -> None:
    with pytest.raises(MeshError, match="3 edges have only one face"):
        remove_handles(Mesh(true_clip.vertices, true_clip.faces[1:]), true_clip.vertices)


def test_loops_are_as_short_as_they_can_be() -> None:
    """On a ring the shortest that do not take it apart go around its tube."""
    ring = meshed(torus(0.6, 0.2))
    everywhere = np.ones(len(ring.vertices), dtype=bool)
    shortest = 2 * np.pi * 0.2 * UTM.scale
    longest = np.full(len(ring.vertices), 1.3 * shortest)
    for seed in range(3):
        loops = short_loops(ring, longest, everywhere, np.random.default_rng(seed))
        assert len(loops) > 10
        assert {loop.signature for loop in loops} == {loops[0].signature} != {0}
        # Paths of edges are a little longer than the circle.
        assert shortest * 0.98 < loops[0].length < shortest * 1.1
        assert [loop.length for loop in loops] == sorted(loop.length for loop in loops)
        for loop in loops:
            steps = ring.vertices[loop.vertices] - ring.vertices[np.roll(loop.vertices, -1)]
            assert len(np.unique(loop.vertices)) == len(loop.vertices)
            assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(loop.length)
    assert not short_loops(ring, longest / 1.5, everywhere, np.random.default_rng(0))
    assert not short_loops(ring, longest, ~everywhere, np.random.default_rng(0))
    # The tunnel's own loops are longer, and of another class.
    around = short_loops(ring, np.full(len(ring.vertices), 3.5 * shortest), everywhere, np.random.default_rng(0))
    assert {loop.signature for loop in around} == {around[0].signature}
    assert not short_loops(meshed(sphere()), longest, everywhere, np.random.default_rng(0))
