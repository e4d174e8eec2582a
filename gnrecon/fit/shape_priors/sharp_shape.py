"""Detects scans of sharp shapes, and completes their faces up to edges (`edge_completion`) and across holes.

First planes and cylinders are covered with samples, as far as their points determine them (`resampling`). Noisy points
are averaged (`bilateral_filter`) and snapped to primitives (`snapping`).

Validation points hardly show how sharp an edge is: few lie near one, and the trial patches that predict them have too
few features for it. Normals show clearly that a shape is sharp, however, and the belief about its completed faces is
always the same: they are nearly exact, and features are as short as their samples can resolve.
Entry: `SharpShape.of`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.edge_completion import EdgeCompletion
from gnrecon.fit.shape_priors.hole_completion import HoleCompletion, complete_holes
from gnrecon.fit.shape_priors.prior_parameters import ShapePriorParameters, SharpShapeParameters
from gnrecon.fit.shape_priors.resampling import resample_primitives
from gnrecon.fit.shape_priors.snapping import SnappedPoints, snap_to_primitives
from gnrecon.fit.shape_priors.unoriented_snapping import snap_unoriented_points
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density


@dataclass(frozen=True)
class SharpShape:
    """The samples of a sharp shape.

    Parameters
    ----------
    samples : of the scan first, which may be averaged, and then those that were added
    averaging : how they were averaged, or None
    snapped : the scan's points on planes, cylinders and spheres, where they were snapped to these
    holes : the samples that were added across holes
    parameters : of the belief
    """

    samples: Samples
    averaging: BilateralFilter | None
    snapped: SnappedPoints | None
    holes: HoleCompletion
    parameters: SharpShapeParameters = SharpShapeParameters()

    @property
    def hyperparameters(self) -> Hyperparameters:
        """Length of the features and noise of the samples.

        Exact normals outweigh a prior that is narrow; after averaging, it must leave room for their slopes.
        """
        radius, p = Density(self.samples.points).radius, self.parameters
        position = p.position_noise_radii * radius
        if self.averaging is None:
            return Hyperparameters(p.exact_length_radii * radius, position, p.exact_angle_radians)
        return Hyperparameters(p.averaged_length_radii * radius, position, p.averaged_angle_radians, by_slopes=True)

    @classmethod
    def of(cls, samples: Samples, parameters: ShapePriorParameters = ShapePriorParameters()) -> SharpShape | None:
        """Return the samples of a scan with its faces completed, or None where sharp edges are not certain.

        Estimated normals are means over edges and show these too little, except for points that lie on primitives.
        """
        p = parameters.sharp
        if len(samples) > p.max_points or len(samples) <= p.neighbours:
            return None
        points, normals, averaging, snapped = samples.points, samples.normals, None, None
        if samples.estimated:
            snapped = snap_unoriented_points(points, normals, parameters.unoriented)
            if snapped is None:
                return None
            points, normals = snapped.points, snapped.normals
        edges = EdgeCompletion(points, normals, parameters.edges)
        if edges.roughness > p.max_raw_roughness_radii and not samples.estimated:
            averaging = BilateralFilter(p.averaging_width_radii, p.averaging_normal_scale)
            averaged = averaging.apply(points, normals)
            edges = EdgeCompletion(*averaged, parameters.edges)
            # Rough averaged points may still be snapped, but not those of a shape without edges.
            if not _is_sharp(edges, p):
                return None
            snapped = snap_to_primitives(points, normals, averaged, parameters.snapping)
            points, normals = averaged
            if snapped is not None:
                points, normals = snapped.points, snapped.normals
                edges = EdgeCompletion(points, normals, parameters.edges)
        if not _is_even_and_sharp(edges, p):
            return None
        holes = complete_holes(points, normals, True, parameters.holes)
        if len(holes):
            points, normals = holes.appended_to(points, normals)
            edges = EdgeCompletion(points, normals, parameters.edges)
        completed = _resampled(points, normals, parameters) or _completed(edges, p)
        if completed is None:
            return None
        samples = samples.replaced(*completed)
        return cls(samples, averaging, snapped, holes, p)


def _resampled(points: Float, normals: Float, parameters: ShapePriorParameters) -> tuple[Float, Float] | None:
    """Return points and normals with samples of their primitives and towards edges, or None without any."""
    samples, sample_normals = resample_primitives(points, normals, parameters.resampling)
    if not len(samples):
        return None
    joined = np.concatenate([points, samples]), np.concatenate([normals, sample_normals])
    # These samples leave no gaps to halve.
    return _completed(EdgeCompletion(*joined, parameters.edges), parameters.sharp, gaps=False)


def _completed(
    edges: EdgeCompletion, parameters: SharpShapeParameters, gaps: bool = True
) -> tuple[Float, Float] | None:
    """Return points and normals with samples towards edges, or None where scanned points contradict these."""
    samples, normals, agreement = edges.samples(gaps)
    if agreement < parameters.min_agreement:
        return None
    return np.concatenate([edges.points, samples]), np.concatenate([edges.normals, normals])


def _is_even_and_sharp(edges: EdgeCompletion, parameters: SharpShapeParameters) -> bool:
    """Return whether faces are even, and meet at edges."""
    return edges.roughness <= parameters.max_roughness_radii and _is_sharp(edges, parameters)


def _is_sharp(edges: EdgeCompletion, parameters: SharpShapeParameters) -> bool:
    """Return whether faces meet at edges; outliers look like edges, unless only points on faces are compared."""
    p = parameters
    if not _has_edges(edges.cosine[:, : p.neighbours], p):
        return False
    kept = edges.on_faces
    if edges.bend < p.flat_bend_degrees:
        return True
    return int(kept.sum()) > p.neighbours and has_edges(edges.points[kept], edges.normals[kept], p)


def has_edges(points: Float, normals: Float, parameters: SharpShapeParameters = SharpShapeParameters()) -> bool:
    """Return whether faces meet at edges, by points and unit normals, both of shape (N, 3), that have been averaged."""
    near = Density(points).tree.query(points, list(range(2, min(len(points), parameters.neighbours + 1) + 1)))[1]
    return _has_edges(np.einsum("ikd,id->ik", normals[near], normals), parameters)


def _has_edges(cosine: Float, parameters: SharpShapeParameters) -> bool:
    """Return the same, by the cosines, of shape (N, k), between the normals of each point and its neighbours."""
    p = parameters
    # The length of the difference of two unit normals.
    difference = np.sqrt((2.0 - 2.0 * cosine).clip(0.0))
    sharp = ((p.edge_difference < difference) & (difference < p.opposed_difference)).mean()
    bent = ((p.bend_difference < difference) & (difference < p.edge_difference)).mean()
    return bool(sharp > p.min_edge_share and sharp > p.min_edge_ratio * bent)
