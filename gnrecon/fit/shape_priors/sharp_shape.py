"""Sharp shapes: whether faces meet at edges, and then their samples with the faces continued to the edges (`creases`).

Planes and cylinders are covered by samples first, as far as their points tell of them (`spread`).

What is left out of a scan hardly tells how sharp an edge is: few points lie near one, and patches that predict them
have too few features for it. That a shape is sharp is plain from its normals, though, and what is then believed of its
continued faces is always the same: they are nearly exact, and features are as short as their samples can tell apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gnrecon.fit.local_solve import Hyperparameters
from gnrecon.fit.shape_priors.bilateral_filter import Averaging
from gnrecon.fit.shape_priors.edge_completion import Faces
from gnrecon.fit.shape_priors.hole_completion import Continued, continued
from gnrecon.fit.shape_priors.resampling import spread
from gnrecon.fit.shape_priors.snapping import Laid, laid, laid_bare
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density

SHARP, FLAT, OPPOSED = 0.8, 0.4, 1.8
"""Lengths of the difference of two neighbours' normals: above the first there is an edge between them, up to the last,
from which on they are the two sides of a sheet. Round shapes have more that differ by the second to the first."""

EDGES, CLEARLY = 0.01, 3.0
"""Least share of the neighbours with an edge between them where a shape has edges, and how often it is the others'."""

BESIDE = 6
"""Nearest neighbours of a point that are asked."""

MOST_POINTS = 30_000
"""Points beyond which nothing is added: edges are rounded over the points' spacing, which is short then."""

AVERAGING = Averaging(4.0, 0.4)
"""How points are averaged whose faces are rough; left-out points hardly tell other widths apart."""

ROUGH, SMOOTH = 0.05, 0.03
"""Roughness of the faces beyond which points are averaged, and at most after that, see `Faces.roughness`."""

PLANE = 1.0
"""Median bend of the faces, in degrees, up to which single points, as on a plate's sides, tell of edges, too."""

AGREED = 0.97
"""Least share of the samples near edges that no scanned point contradicts: 0.99 on sharp shapes, and 0.94 on a scan
that is rounded by its scanner, where samples beyond the rounding leave crumbs along the edges."""

NOISE = 0.02
"""Noise of the samples' positions that is believed, in radii of a disk."""

EXACT, AVERAGED = (2.6, 0.2), (3.2, 0.5)
"""Length, in radii of a disk, and noise of normals, in radians, that are believed of exact samples and of averaged
ones: noisy points close to an edge may lie beyond it and have the other face's normal, which says less there."""


@dataclass(frozen=True)
class Sharp:
    """The samples of a sharp shape.

    Parameters
    ----------
    samples : of the scan first, which may be averaged, and then those that were added
    averaging : how they were averaged, or None
    laid : those of the scan on planes, cylinders and spheres, where noisy ones were laid there
    across : those that were added across holes
    """

    samples: Samples
    averaging: Averaging | None
    laid: Laid | None
    across: Continued

    @property
    def hyperparameters(self) -> Hyperparameters:
        """What is believed of them."""
        radius = Density(self.samples.points).radius
        length, angle = EXACT if self.averaging is None else AVERAGED
        return Hyperparameters(length * radius, NOISE * radius, angle)

    @classmethod
    def of(cls, samples: Samples) -> Sharp | None:
        """Return the samples of a scan with its faces continued, or None where no sharp edges are beyond doubt.

        Estimated normals are means over edges, which tell too little of them, but for points that lie on surfaces.
        """
        if len(samples) > MOST_POINTS or len(samples) <= BESIDE:
            return None
        points, normals, averaging, flat = samples.points, samples.normals, None, None
        if samples.estimated:
            flat = laid_bare(points, normals)
            if flat is None:
                return None
            points, normals = flat.points, flat.normals
        faces = Faces(points, normals)
        if faces.roughness > ROUGH and not samples.estimated:
            averaging = AVERAGING
            averaged = averaging.of(points, normals)
            flat = laid(points, normals, averaged)
            points, normals = averaged if flat is None else (flat.points, flat.normals)
            faces = Faces(points, normals)
        if faces.roughness > SMOOTH or not _sharp(faces):
            return None
        across = continued(points, normals)
        if len(across):
            points, normals = across.joined(points, normals)
            faces = Faces(points, normals)
        joined = _covered(points, normals) or _continued(faces)
        if joined is None:
            return None
        return cls(replace(samples, points=joined[0], normals=joined[1]), averaging, flat, across)


def _covered(points: Float, normals: Float) -> tuple[Float, Float] | None:
    """Return points and normals with samples spread over their surfaces and towards edges, or None without any."""
    samples, theirs = spread(points, normals)
    if not len(samples):
        return None
    # They leave no gaps to halve.
    faces = Faces(np.concatenate([points, samples]), np.concatenate([normals, theirs]))
    return _continued(faces, gaps=False)


def _continued(faces: Faces, gaps: bool = True) -> tuple[Float, Float] | None:
    """Return points and normals of faces that are continued to their edges, or None where points contradict that."""
    more, theirs, agreed = faces.more(gaps)
    if agreed < AGREED:
        return None
    return np.concatenate([faces.points, more]), np.concatenate([faces.normals, theirs])


def _sharp(faces: Faces) -> bool:
    """Return whether faces meet at edges. Outliers look as if they did, if those that lie on no face are asked, too."""
    if not _edged(faces.cosine[:, :BESIDE]):
        return False
    kept = faces.on_faces
    return faces.bend < PLANE or (int(kept.sum()) > BESIDE and has_edges(faces.points[kept], faces.normals[kept]))


def has_edges(points: Float, normals: Float) -> bool:
    """Return whether faces meet at edges, by points and unit normals, both of shape (N, 3), that have been averaged."""
    near = Density(points).tree.query(points, list(range(2, min(len(points), BESIDE + 1) + 1)))[1]
    return _edged(np.einsum("ikd,id->ik", normals[near], normals))


def _edged(cosine: Float) -> bool:
    """Return the same, by the cosines of the angles between the normals of each point and its neighbours'."""
    apart = np.sqrt((2.0 - 2.0 * cosine).clip(0.0))
    sharp, bent = (((low < apart) & (apart < high)).mean() for low, high in ((SHARP, OPPOSED), (FLAT, SHARP)))
    return bool(sharp > EDGES and sharp > CLEARLY * bent)
