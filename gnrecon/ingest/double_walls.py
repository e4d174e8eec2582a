"""Double walls: two layers of points where there is one surface, as of scans that are badly registered.

Around a point, the points that face its way within a cylinder along its normal are described by one quadric, and by the
same quadric twice, an offset apart, with each point on the nearer of the two (found by alternation). There are two
layers where the offset is many times the remaining deviation, where both cover the same place in the tangent plane, so
that a step or an edge is not taken for them, and where nothing between them faces the other way, as the back of a thin
wall does: along a line through a solid, surfaces face this way and that way alternately.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.local_pca import quadric_terms
from gnrecon.geometry.point_cloud import Samples
from gnrecon.ingest.ingest_parameters import DoubleWallParameters
from gnrecon.ingest.point_spacing import neighbour_spacing


@dataclass(frozen=True)
class Layers:
    """Two layers of points on one surface.

    Parameters
    ----------
    share : of the points around which there are two
    offset : median distance between the layers, in the unit of the points
    """

    share: float
    offset: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)

    def describe(self) -> str:
        """Return the finding as a sentence, for an offset in file units."""
        return (
            f"At {self.share:.0%} of the points there are two layers, about {self.offset:.3g} file units apart; "
            f"check the registration of the scans."
        )


def layers_of(
    samples: Samples, normals: str, *, parameters: DoubleWallParameters = DoubleWallParameters()
) -> Layers | None:
    """Return the double layers of samples, with the offset in file units, or None where there are none.

    Parameters
    ----------
    samples : Samples
    normals : origin of their normals, as in `IngestCounts`; estimated ones may have wrong signs at thin walls
    parameters : tuning constants
    """
    sure = normals in ("given", "given, flipped") or normals.endswith("origins")
    least = parameters.least_place_share if sure else parameters.least_place_share_estimated
    found = find_layers(samples.points, samples.normals, least, parameters=parameters)
    return None if found is None else Layers(found.share, found.offset * samples.frame.scale)


def find_layers(
    points: Float,
    normals: Float,
    least: float = DoubleWallParameters.least_place_share,
    *,
    parameters: DoubleWallParameters = DoubleWallParameters(),
) -> Layers | None:
    """Return the double layers of oriented points, or None where there are none.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    normals : array of shape (N, 3), of unit length, oriented
    least : share of the tested points from which there are layers
    parameters : tuning constants
    """
    from scipy.spatial import cKDTree

    if len(points) < 4 * parameters.least_points:
        return None
    tree, spacing = cKDTree(points), neighbour_spacing(points)
    chosen = np.random.default_rng(0).permutation(len(points))[: parameters.places]
    reach = np.hypot(parameters.cylinder_radius_spacings, parameters.cylinder_half_height_spacings)
    offsets = []
    for row in chosen:
        near = np.array(tree.query_ball_point(points[row], reach * spacing))
        local = _in_cylinder(points[near] - points[row], normals[row], spacing, parameters)
        facing = normals[near] @ normals[row]
        offsets.append(_offset(local, facing, parameters))
    found = np.array([offset for offset in offsets if offset is not None])
    if len(found) < least * len(chosen):
        return None
    return Layers(len(found) / len(chosen), float(np.median(found)) * spacing)


def _in_cylinder(offsets: Float, normal: Float, spacing: float, parameters: DoubleWallParameters) -> Float:
    """Return offsets, of shape (n, 3), as two tangential coordinates and one along the normal, in spacings.

    Those outside of the cylinder are NaN.
    """
    axes = np.linalg.svd(normal[None, :])[2]  # the normal, and two directions across it
    local: Float = offsets @ np.roll(axes, -1, axis=0).T / spacing
    local[:, 2] *= np.sign(axes[0] @ normal)
    outside = np.hypot(local[:, 0], local[:, 1]) > parameters.cylinder_radius_spacings
    local[outside | (np.abs(local[:, 2]) > parameters.cylinder_half_height_spacings)] = np.nan
    return local


def _offset(local: Float, facing: Float, parameters: DoubleWallParameters) -> float | None:
    """Return the distance between two layers of points, in spacings; None where there is only one layer."""
    inside = np.isfinite(local[:, 0])
    same = local[inside & (facing > parameters.least_facing_cosine)]
    if len(same) < parameters.least_points:
        return None
    upper, quadric, offset, remaining = _fit_two_layers(same)
    balance = min(upper.mean(), 1 - upper.mean())
    least = max(parameters.least_offset_spacings, parameters.separation_deviations * remaining)
    if offset < least or balance < parameters.least_layer_share:
        return None
    if not _overlap(same[:, :2], upper, parameters.most_centre_distance):
        return None
    back = local[inside & (facing < -parameters.least_facing_cosine)]
    heights = back[:, 2] - quadric_terms(back[:, 0], back[:, 1]) @ quadric
    between = int(((heights > 0) & (heights < offset)).sum())
    return offset if between < parameters.most_between_share * len(same) else None


def _fit_two_layers(local: Float, *, rounds: int = 6) -> tuple[Mask, Float, float, float]:
    """Fit two quadrics that differ by an offset, in alternation with the assignment of points, at most `rounds` times.

    Returns
    -------
    Which points are on the upper quadric, the lower quadric's coefficients, the offset, and the remaining deviation.
    """
    columns, heights = quadric_terms(local[:, 0], local[:, 1]), local[:, 2]
    rest = heights - columns @ np.linalg.lstsq(columns, heights, rcond=None)[0]
    upper = rest > (rest.min() + rest.max()) / 2
    for _ in range(rounds):
        both = np.column_stack([columns, upper])
        solution = np.linalg.lstsq(both, heights, rcond=None)[0]
        rest = heights - columns @ solution[:-1]
        reassigned = rest > solution[-1] / 2
        if (reassigned == upper).all() or reassigned.all() or not reassigned.any():
            break
        upper = reassigned
    remaining = np.sqrt(((rest - upper * solution[-1]) ** 2).sum() / (len(local) - both.shape[1]))
    return upper, solution[:-1], float(solution[-1]), float(remaining)


def _overlap(plane: Float, upper: Mask, most_centre_distance: float) -> bool:
    """Return whether both layers cover the same place: their centres in the plane are close for the points' spread."""
    spread = float(np.sqrt(plane.var(axis=0).sum()))
    distance = float(np.linalg.norm(plane[upper].mean(axis=0) - plane[~upper].mean(axis=0)))
    return distance < most_centre_distance * spread
