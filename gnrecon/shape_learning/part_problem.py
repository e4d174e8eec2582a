"""The design of a part: within a region, attached to interfaces, in one piece, and as smooth as that allows.

The paper's last experiment is the bracket of a jet engine. Its terms, all of them ordinary residuals:

    design region    f >= d / 2        at the distance d outside of the region
    interface        f = 0             on the interfaces
    normal           grad f = n        there, in which the slope of one is included
    surface strain   k1^2 + k2^2       on the surface, except where it is an interface
    connectedness    f = target        at saddles between separate components (`level_set.topology`)
    eikonal          |grad f| = 1      in the box

The paper requires f >= 0 outside of the region, which leaves sheets far from the part where f is hardly below zero,
with few points. The signed distance of a part within the region is at least that of the region, so half of that is less
than the eikonal term requires.

The start is a part within the region and bounded by the interfaces: the region itself, eroded to a depth that falls to
zero at the interfaces. A network fitted to this, the interfaces and their normals is much nearer to a feasible part
than one fitted only to the signed distance of the region. The problem is in unit coordinates, in which half the longest
side of the region's box is one.

The design region is enforced at points near its border and in the whole box. A thin layer just inside the border is
kept free too, so that the remaining violation of the term is inside the region. An interface may lie on the border; the
layer is thinner there. All numbers are in `PartParameters`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gnrecon.field import Network
from gnrecon.field.layers import WAVELET
from gnrecon.geometry.arrays import Float
from gnrecon.least_squares import Averaged, identity
from gnrecon.level_set import ConnectionTargets, GridRegion, LaggedWorker, LevelSet, joints
from gnrecon.optim import GainRatioDamping
from gnrecon.residuals import (
    clipped_strain,
    design_region,
    eikonal,
    interface,
    normal_vector,
    signed_distance,
    surface_strain,
)
from gnrecon.shape_learning.design import Design, InterfaceSample
from gnrecon.shape_learning.learning_parameters import PartParameters, ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import (
    Pretraining,
    SampledPoints,
    Sampler,
    ShapeProblem,
    StepState,
    Term,
    Weight,
    at_points,
    falling,
    in_box,
    on_surface,
    rising,
)

DistanceFunction = Callable[[Float], Float]
"""From points, of shape (N, 3), to their distances from the interfaces, of shape (N,)."""


def bracket(
    design: Design,
    seed: int = 0,
    clip: float | None = None,
    network: Network | None = None,
    *,
    parameters: PartParameters = ShapeLearningParameters.part,
) -> ShapeProblem:
    """Return the problem of a part.

    Parameters
    ----------
    design : its region and interfaces
    seed : of the pools from which the points of each step are drawn
    clip : greatest strain k1^2 + k2^2 that counts, per squared unit length, or None for all of it
    network : by default wavelets with the widths and frequencies of the parameters
    parameters : weights, points and lengths
    """
    rng = np.random.default_rng(seed)
    walls = design.interfaces.sample(parameters.pool_points, rng)
    interface_distance = _interface_distance(walls.points, parameters.erosion_interface_distance)
    around = design.region.around(parameters.pool_points, rng)
    distance = design.region.distance(around)

    def start(x: Float) -> Float:
        return design.region.distance(x) + _erosion_depth(interface_distance(x), parameters)

    return ShapeProblem(
        "bracket",
        _terms(design, clip, walls, (around, distance), interface_distance, parameters),
        design.region.box,
        lambda x: torch.as_tensor(start(x.numpy())),
        network or Network(parameters.widths, WAVELET, parameters.frequencies),
        search=GainRatioDamping(
            initial_damping=parameters.first_damping, metric=identity, length=parameters.step_length
        ),
        solver=lambda: Averaged(parameters.matrix_mean_memory),
        pretraining=_pretraining(
            around, distance + _erosion_depth(interface_distance(around), parameters), walls, parameters
        ),
    )


def _terms(
    design: Design,
    clip: float | None,
    walls: InterfaceSample,
    pool: tuple[Float, Float],
    interface_distance: DistanceFunction,
    parameters: PartParameters,
) -> tuple[Term, ...]:
    """Return the terms; `pool` has points around the region and their distances from it."""

    def rise(weight: float, most: float) -> Weight:
        return rising(weight, parameters.weight_hold_steps, parameters.weight_growth, most)

    region_weight = rise(parameters.region_weight, parameters.most_region_weight)
    interface_weight = rise(parameters.interface_weight, parameters.most_interface_weight)
    strain = surface_strain if clip is None else clipped_strain(clip)
    outside = _outside(*pool, interface_distance, parameters)
    on_walls = at_points(walls.points, count=parameters.interface_points)
    with_normals = at_points(walls.points, walls.normals, count=parameters.interface_points)
    free_surface = _free_surface(interface_distance, clip, parameters)
    connections = _connections(design, walls.points, parameters)
    return (
        Term("design region", design_region, outside, region_weight),
        Term("interface", interface, on_walls, interface_weight),
        Term("normal", normal_vector, with_normals, parameters.normal_weight),
        Term("surface strain", strain, free_surface, parameters.strain_weight),
        Term("connectedness", signed_distance, connections, parameters.connectedness_weight),
        Term("eikonal", eikonal, in_box(parameters.box_points), parameters.eikonal_weight),
    )


def _erosion_depth(interface_distances: Float, parameters: PartParameters) -> Float:
    """Return the depth by which the region is eroded, of shape (N,), at distances of shape (N,) from the interfaces."""
    share = np.minimum(interface_distances / parameters.erosion_interface_distance, 1.0)
    depth: Float = parameters.erosion_depth * share**2 * (3 - 2 * share)
    return depth


def _pretraining(points: Float, start: Float, walls: InterfaceSample, parameters: PartParameters) -> Pretraining:
    """Return the fit of the start's values, of shape (N,), at points of shape (N, 3), and of the interfaces."""
    on_walls = at_points(walls.points, count=parameters.interface_points)
    with_normals = at_points(walls.points, walls.normals, count=parameters.interface_points)
    terms = (
        Term("start", signed_distance, at_points(points, start, parameters.pretraining_points)),
        Term("interface", interface, on_walls, parameters.pretraining_interface_weight),
        Term("normal", normal_vector, with_normals, parameters.pretraining_normal_weight),
    )
    # With new points at each step the loss is not monotone, so a rising loss does not end the fit.
    steps = parameters.pretraining_steps
    return Pretraining(terms, steps, tolerance=0.0, patience=steps)


def _interface_distance(walls: Float, farthest: float) -> DistanceFunction:
    """Return a function that gives the distances, of shape (N,), of points, (N, 3), from the interfaces' points.

    Beyond `farthest` they are infinite. This saves time for points on the axis of a hole, which are equally far from
    all points of its wall.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(walls)
    return lambda points: tree.query(points, distance_upper_bound=farthest)[0]


def _outside(
    around: Float, distance: Float, interface_distance: DistanceFunction, parameters: PartParameters
) -> Sampler:
    """Return a sampler of points that should be outside of the part; those far outside of it are only counted."""
    layer = np.minimum(
        parameters.layer_depth, parameters.layer_depth_per_interface_distance * interface_distance(around)
    )
    kept = distance > -layer
    pool = torch.as_tensor(around[kept])
    least = torch.as_tensor(parameters.clearance_per_distance * np.maximum(distance[kept], 0.0))

    def draw(state: StepState) -> SampledPoints:
        rows = torch.as_tensor(state.rng.integers(len(pool), size=parameters.region_points))
        points, targets = pool[rows], least[rows]
        active = state.level_set.values(points) - targets < parameters.active_value
        return SampledPoints(points[active], targets[active], share=int(active.sum()) / parameters.region_points)

    return draw


def _free_surface(interface_distance: DistanceFunction, clip: float | None, parameters: PartParameters) -> Sampler:
    """Return a sampler of the surface away from the interfaces, with the largest strain that counts as targets."""
    everywhere = on_surface(parameters.surface_points)
    most = None if clip is None else falling(parameters.clip_start_factor * clip, parameters.clip_fall, clip)

    def draw(state: StepState) -> SampledPoints:
        points = everywhere(state).points
        free = interface_distance(points.numpy()) > parameters.interface_strain_distance
        points = points[torch.as_tensor(free)]
        target = None if most is None else torch.full_like(points[:, 0], most(state.step))
        return SampledPoints(points, target, on_surface=True)

    return draw


def _connections(design: Design, walls: Float, parameters: PartParameters) -> Sampler:
    """Return a sampler of points that connect components, found in parallel from the field of the previous step."""
    region = GridRegion.within(design.region.box, design.region.inside, parameters.component_cells)
    anchors = walls[:: len(walls) // parameters.anchor_points]

    def find(level_set: LevelSet) -> ConnectionTargets:
        return joints(level_set, region, parameters.neck_value, anchors)

    worker = LaggedWorker(find)

    def draw(state: StepState) -> SampledPoints:
        # A measurement uses the current field.
        found = find(state.level_set) if state.measuring else worker(state.level_set)
        return SampledPoints(found.points, found.targets)

    return draw
