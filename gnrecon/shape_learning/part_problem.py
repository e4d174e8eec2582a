"""The design of a part: within a region, attached to interfaces, in one piece, and as smooth as that allows.

The paper's last experiment is the bracket of a jet engine. Its terms, all of them ordinary residuals:

    design region    f >= d / 2        at the distance d outside of the region
    interface        f = 0             on the interfaces
    normal           grad f = n        there, in which the slope of one is included
    surface strain   k1^2 + k2^2       on the surface, except where it is an interface
    connectedness    f = target        at passes between separate components (`levelset.connect`)
    eikonal          |grad f| = 1      in the box

The paper asks for f >= 0 outside of the region, which leaves sheets far from the part that hardly go below zero, and
whose points are few. The signed distance of a part within the region is at least that of the region, so half of that is
no more than what the eikonal term asks for.

It begins as a part that the region holds and the interfaces bound: the region itself, worn off to a depth that falls
to nothing at the interfaces. A network that is fitted to that, and to the interfaces and their normals, is far nearer
to a feasible part than one that is fitted to the region's distance alone. The problem is posed in unit coordinates, in
which half the longest side of the region's box is one.

What is outside of the region is asked of points drawn near its border as well as in the whole box, and of a layer just
within the border too (`MARGIN`), so that what is left of the term's residual lies within the region. An interface may
lie on the border itself; the layer is thinner there.
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
from gnrecon.shape_learning.shape_problem import (
    LAST,
    Drawn,
    Moment,
    Pretraining,
    Sampler,
    ShapeProblem,
    Term,
    at_points,
    falling,
    in_box,
    on_surface,
    rising,
)

NETWORK = Network((24, 24), WAVELET, (14.0, 4.0))
"""The paper's has 2 x 32 wavelets; a step's cost grows with the fourth power of the width."""

STRAIN, EIKONAL, NORMAL, CONNECTED = 1e-4, 0.1, 0.3, 1e3
INTERFACE, REGION = rising(3e3, 60, 1.02, 1.5e4), rising(3e4, 60, 1.02, 1e6)
"""Weights. The paper's are 1e-4, 1, 10, 1e3, 10 and 1e3; a slope of one everywhere costs the part its fit. The last two
rise, as what a term leaves over where it acts falls with its weight, and at once they would tear the start apart."""

ON_SURFACE, ON_INTERFACES, IN_BOX, AROUND = 600, 1000, 600, 12_000
"""Points of each term at each step."""

POOL = 100_000
"""Points around the region and on the interfaces that each step draws from, so that distances are computed once."""

MARGIN, THINNER = 0.018, 0.33
"""Depth of the layer within the region's border that is kept free as well."""

CLEARANCE = 0.5
"""Least value of f outside of the region, as a share of the distance from it; a distance would have all of it."""

ACTIVE = 0.015
"""Points outside of the region with a larger value than this have no residual, nor will have after the step."""

CLIP_START, CLIP_FALL = 100.0, 0.99
"""How many times its end the clipping's maximum is at first, and its factor from step to step. What is clipped is not
pulled at: creases of a part that has not found its shape yet would stay."""

BESIDE = 0.02
"""Distance from an interface within which the strain is none of the part's."""

CELLS = 64
"""Cells along the longest side of the grid on which components are found, as in the paper."""

FAR = 0.08
"""Distance from which on points are simply far from interfaces."""

EROSION = 0.04
"""Depth within the region's border at which the part begins, but for what is near to an interface, where it is less."""

FIRST_STEPS, FIRST_POINTS, FIRST_INTERFACE, FIRST_NORMAL = 120, 4000, 10.0, 3e-3
"""Of the pretraining: most steps, points of the distance, and the weights of the interfaces beside it."""

KEEP, LENGTH = 0.8, 0.2
"""Share of the former mean of J^T J in the next one, and of each step that is gone."""

NECK = 0.02
"""How far beyond zero f should be where components are joined, or removed."""


def bracket(design: Design, seed: int = 0, clip: float | None = None, network: Network | None = None) -> ShapeProblem:
    """Return the problem of a part.

    Parameters
    ----------
    design : its region and interfaces
    seed : of the pools that each step's points are drawn from
    clip : greatest strain k1^2 + k2^2 that counts, per squared unit length, or None for all of it
    network : by default `NETWORK`
    """
    rng = np.random.default_rng(seed)
    walls = design.interfaces.sample(POOL, rng)
    off_walls = _off(walls.points)
    around = design.region.around(POOL, rng)
    distance = design.region.distance(around)
    strain = surface_strain if clip is None else clipped_strain(clip)
    return ShapeProblem(
        "bracket",
        (
            Term("design region", design_region, _outside(around, distance, off_walls), REGION),
            Term("interface", interface, at_points(walls.points, count=ON_INTERFACES), INTERFACE),
            Term("normal", normal_vector, at_points(walls.points, walls.normals, count=ON_INTERFACES), NORMAL),
            Term("surface strain", strain, _free_surface(off_walls, clip), STRAIN),
            Term("connectedness", signed_distance, _joints(design, walls.points), CONNECTED),
            Term("eikonal", eikonal, in_box(IN_BOX), EIKONAL),
        ),
        design.region.box,
        lambda x: torch.as_tensor(design.region.distance(x.numpy()) + _depth(off_walls(x.numpy()))),
        network or NETWORK,
        search=GainRatioDamping(initial_damping=0.1, metric=identity, length=LENGTH),
        solver=lambda: Averaged(KEEP),
        pretraining=_pretraining(around, distance + _depth(off_walls(around)), walls),
    )


def _depth(off_walls: Float) -> Float:
    """Return how deep the region is worn off, of shape (N,), at distances of shape (N,) from the interfaces."""
    share = np.minimum(off_walls / FAR, 1.0)
    depth: Float = EROSION * share**2 * (3 - 2 * share)
    return depth


def _pretraining(points: Float, start: Float, walls: InterfaceSample) -> Pretraining:
    """Return the fit of the start's values, of shape (N,), at points of shape (N, 3), and of the interfaces."""
    terms = (
        Term("start", signed_distance, at_points(points, start, FIRST_POINTS)),
        Term("interface", interface, at_points(walls.points, count=ON_INTERFACES), FIRST_INTERFACE),
        Term("normal", normal_vector, at_points(walls.points, walls.normals, count=ON_INTERFACES), FIRST_NORMAL),
    )
    # Fresh points make the loss rise and fall, which is no sign of its end.
    return Pretraining(terms, FIRST_STEPS, tolerance=0.0, patience=FIRST_STEPS)


def _off(walls: Float) -> Callable[[Float], Float]:
    """Return a function that gives the distances, of shape (N,), of points, (N, 3), from the interfaces' points.

    Beyond `FAR` they are infinite: points on a hole's axis are as far from all of its wall, which costs the search.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(walls)
    return lambda points: tree.query(points, distance_upper_bound=FAR)[0]


def _outside(around: Float, distance: Float, off_walls: Callable[[Float], Float]) -> Sampler:
    """Return a sampler of points that are to be outside of the part; those far outside of it are counted, not drawn."""
    layer = np.minimum(MARGIN, THINNER * off_walls(around))
    kept = distance > -layer
    pool, least = torch.as_tensor(around[kept]), torch.as_tensor(CLEARANCE * np.maximum(distance[kept], 0.0))

    def draw(moment: Moment) -> Drawn:
        rows = torch.as_tensor(moment.rng.integers(len(pool), size=AROUND))
        points, targets = pool[rows], least[rows]
        active = moment.level_set.values(points) - targets < ACTIVE
        return Drawn(points[active], targets[active], share=int(active.sum()) / AROUND)

    return draw


def _free_surface(off_walls: Callable[[Float], Float], clip: float | None) -> Sampler:
    """Return a sampler of the surface away from the interfaces, which are given, with the most strain that counts."""
    everywhere = on_surface(ON_SURFACE)
    most = None if clip is None else falling(CLIP_START * clip, CLIP_FALL, clip)

    def draw(moment: Moment) -> Drawn:
        points = everywhere(moment).points
        points = points[torch.as_tensor(off_walls(points.numpy()) > BESIDE)]
        target = None if most is None else torch.full_like(points[:, 0], most(moment.step))
        return Drawn(points, target, on_surface=True)

    return draw


def _joints(design: Design, walls: Float) -> Sampler:
    """Return a sampler of the points that join components, found beside the step from the field of one step ago."""
    region = GridRegion.within(design.region.box, design.region.inside, CELLS)
    anchors = walls[:: len(walls) // 2000]

    def work(level_set: LevelSet) -> ConnectionTargets:
        return joints(level_set, region, NECK, anchors)

    worker = LaggedWorker(work)

    def draw(moment: Moment) -> Drawn:
        # What is measured once is measured as it is.
        found = work(moment.level_set) if moment.step == LAST else worker(moment.level_set)
        return Drawn(found.points, found.targets)

    return draw
