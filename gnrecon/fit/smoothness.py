"""How smooth a scan's shape is as a whole: the length of the global field's features, chosen by left-out points.

A blob, a pipe or a plate has few degrees of freedom, and a field of long features averages the noise of many points and
closes wide holes well; a gear or a foam needs short ones. Small fields of each length are fitted to some of the points,
as a cube's correction is (`patch`), and the longest one counts that predicts the points that are left out as well as
the best.
"""

from __future__ import annotations

import numpy as np
import torch

from gnrecon.cloud import Samples
from gnrecon.field.features import DEGREES_OF_FREEDOM, Features
from gnrecon.fit.choose import Mask
from gnrecon.fit.patch import Patch, PatchSystem
from gnrecon.fit.scene import Scene
from gnrecon.fit.start import Spectrum

LENGTHS = (0.25, 0.5, 1.0)
"""Lengths to choose from, in radii."""

SPACINGS = 4.0
"""Least length of a global field's features, in spacings of the points that it sees: shorter ones oscillate."""

ALIKE = 0.01
"""Share by which a longer one may predict worse than the best."""

FEATURES, POINTS, VOLUME = 600, 2000, 2000
POSITION, ANGLE = 0.1, 0.1
"""Noise that is assumed: of positions, in spacings, and of normals, in radians."""

SIZE = 1.0
"""Standard deviation of the field, in radii."""


def smooth_spectrum(length: float, scene: Scene) -> Spectrum:
    """Return the spectrum of a global field's features of a length in radii, or longer where points are few.

    It is that of the detail's features, with which the length is chosen, too.
    """
    return Spectrum(max(length, SPACINGS * scene.coarse.spacing), DEGREES_OF_FREEDOM)


def global_length(samples: Samples, held: Mask, scene: Scene, rng: np.random.Generator) -> float:
    """Return the length of features that a global field of the scan needs, in radii.

    Parameters
    ----------
    samples : Samples
    held : mask of shape (N,), of the samples that are left out of `scene`
    scene : Scene
    rng : draws features and samples
    """
    seen = rng.permutation(len(scene.samples))[:POINTS]
    x, distance = scene.volume(VOLUME, rng)
    points, normals = scene.points[seen], scene.normals[seen]
    volume = scene.tensor(x), scene.tensor(distance), scene.tensor(distance).abs()
    center = torch.zeros(3).to(points)
    patch = Patch(points, torch.zeros(len(points)).to(points), normals, *volume, center)
    features = Features.draw(FEATURES, rng, points)
    out = np.flatnonzero(held)[:POINTS]
    left, turned = scene.tensor(samples.points[out]), scene.tensor(samples.normals[out])
    scores = []
    for length in LENGTHS:
        amplitudes = PatchSystem(patch, features, length, SIZE).solve(POSITION * scene.coarse.spacing, ANGLE)
        value, gradient = features.sums(amplitudes, left, center, length, 1)
        angle = (gradient - turned).norm(dim=1).mean()
        scores.append(float(value.abs().mean() + scene.coarse.spacing * angle))
    return max(length for length, score in zip(LENGTHS, scores, strict=True) if score <= (1 + ALIKE) * min(scores))
