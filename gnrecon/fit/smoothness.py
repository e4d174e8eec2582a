"""How smooth a scan's shape is as a whole, and what its normals are worth, chosen by left-out points.

A blob, a pipe or a plate has few degrees of freedom, and a field of long features averages the noise of many points and
closes wide holes well; a gear or a foam needs short ones. Exact normals tell more of a smooth shape than noisy points
do; of coarse or scattered ones it is the other way round. Small fields of each length and weight of the normals are
fitted to some of the points, as a cube's correction is (`patch`), and the longest one counts that predicts the points
that are left out as well as the best, with the weight at which it does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gnrecon.field.random_features import DEGREES_OF_FREEDOM, Features
from gnrecon.fit.choose import SPARSE
from gnrecon.fit.patch import Patch, PatchSystem
from gnrecon.fit.scene import REACH, Scene
from gnrecon.fit.start import Spectrum
from gnrecon.geometry.arrays import Mask
from gnrecon.geometry.point_cloud import Samples

LENGTHS = (0.25, 0.5, 1.0)
"""Lengths to choose from, in radii."""

REACHES = (REACH, 1.2, 3.0, 8.0, 20.0)
"""Weights of the normals to choose from: the lengths, in spacings, over which an angle counts as a height."""

SPACINGS = 4.0
"""Least length of a global field's features, in spacings of the points that it sees: shorter ones oscillate."""

ALIKE = 0.01
"""Share by which a longer one may predict worse than the best."""

FEATURES, POINTS, VOLUME = 600, 2000, 2000
POSITION = 0.1
"""Noise of positions that is assumed, in spacings; that of normals, in radians, is this over the reach."""

LEAST_HELD = 5
"""Left-out points that have a say."""

SIZE = 1.0
"""Standard deviation of the field, in radii."""


@dataclass(frozen=True)
class Smoothness:
    """Length of the global field's features, in radii, and reach of its normals, in spacings."""

    length: float
    reach: float


def smooth_spectrum(length: float, scene: Scene) -> Spectrum:
    """Return the spectrum of a global field's features of a length in radii, or longer where points are few.

    It is that of the detail's features, with which the length is chosen, too.
    """
    return Spectrum(max(length, SPACINGS * scene.coarse.spacing), DEGREES_OF_FREEDOM)


def global_smoothness(samples: Samples, held: Mask, scene: Scene, rng: np.random.Generator) -> Smoothness:
    """Return the length of features that a global field of the scan needs, and how far its normals reach.

    Parameters
    ----------
    samples : Samples
    held : mask of shape (N,), of the samples that are left out of `scene`
    scene : Scene
    rng : draws features and samples
    """
    if held.sum() < LEAST_HELD:
        return Smoothness(LENGTHS[0], REACH)
    seen = rng.permutation(len(scene.samples))[:POINTS]
    x, distance = scene.volume(VOLUME, rng)
    points, normals = scene.points[seen], scene.normals[seen]
    signed = scene.tensor(distance)
    center = torch.zeros(3).to(points)
    volume = scene.tensor(x), signed, signed, signed, signed.abs()
    patch = Patch(points, torch.zeros(len(points)).to(points), normals, *volume, center)
    features = Features.draw(FEATURES, rng, points)
    out = np.flatnonzero(held)[:POINTS]
    left, turned = scene.tensor(samples.points[out]), scene.tensor(samples.normals[out])
    # Estimated ones are means of their neighbours', which smooth fields predict too well.
    reaches = REACHES[:1] if samples.estimated and len(samples) <= SPARSE else REACHES
    best = []
    for length in LENGTHS:
        system, scores = PatchSystem(patch, features, length, SIZE), []
        for reach in reaches:
            amplitudes = system.solve(POSITION * scene.coarse.spacing, POSITION / reach)
            value, gradient = features.sums(amplitudes, left, center, length, 1)
            angle = (gradient - turned).norm(dim=1).mean()
            scores.append((float(value.abs().mean() + scene.coarse.spacing * angle), reach))
        best.append((length, *min(scores)))
    least = min(score for _, score, _ in best)
    length, _, reach = max(tried for tried in best if tried[1] <= (1 + ALIKE) * least)
    return Smoothness(length, reach)
