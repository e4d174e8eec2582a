"""The linear global field: one wide layer of sine features, whose length scale and weight of normals are selected.

Small fields of each candidate length scale and weight are fitted to some of the points; the validation points select
among them (`field_smoothness`). Heavy normals make the field exact on smooth shapes. On a shape with more detail than
the layer can follow they cause sheets in free space: if the winding number contradicts the sign there in too many
places, the field is fitted again with the default weight (`fit_linear`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.networks import Siren
from gnrecon.field.random_features import Features
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import Spectrum
from gnrecon.fit.local_solve import Patch, PatchSystem
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import LinearFieldParameters, ModelSelectionParameters, ObjectiveParameters
from gnrecon.fit.single_network import fit_wide
from gnrecon.geometry.arrays import Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import is_sign_certain
from gnrecon.optim import Solution
from gnrecon.runtime.progress import ProgressCallback, subrange

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LinearField:
    """A field of one layer, how it was solved, and the length of its features, in radii."""

    sdf: NeuralSDF
    solution: Solution
    length: float


def fit_linear(
    samples: Samples,
    held_out: Mask,
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    advance: ProgressCallback,
    *,
    parameters: LinearFieldParameters = LinearFieldParameters(),
) -> LinearField:
    """Solve the linear field of some of the samples.

    Parameters
    ----------
    samples : Samples
    held_out : mask of shape (N,), of the validation points
    scene : the samples that the field is fitted to, none of them a validation point
    options : of which the device, the residual of the normals and the solver are used
    rng : draws features and samples of the volume
    advance : called with the share that is done
    parameters : candidates and sizes

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    smoothness = field_smoothness(samples, held_out, scene, rng.spawn(1)[0], parameters=parameters)
    spectrum = smooth_spectrum(smoothness.length, scene, parameters=parameters)
    # Curvature penalties shape the field where nothing was seen, for which fewer units leave too little freedom.
    count = parameters.most_units if options.regularisers else _unit_count(spectrum.length, parameters)
    field = Siren((count,))
    linear = replace(options, widths=field.widths, steps=0, smooth=None, fill=None, prior=None)

    def fitted(reach: float, advance: ProgressCallback) -> tuple[NeuralSDF, Solution, float]:
        solution = fit_wide(field, replace(scene, reach=reach), linear, rng, None, advance, spectrum)
        sdf = NeuralSDF(field, solution.theta, samples.frame, scene.box, options.as_dict())
        return sdf, solution, wrong_sign(sdf, scene, rng.spawn(1)[0])

    # With curvature penalties in holes, heavy normals could carry the surface out of the box.
    default_reach = ObjectiveParameters.normal_reach_spacings
    reach = default_reach if options.regularisers else smoothness.reach
    sdf, solution, wrong = fitted(reach, subrange(advance, 0.0, 0.5))
    if reach > default_reach and wrong > parameters.wrong_sign_share:
        default_sdf, default_solution, default_wrong = fitted(default_reach, subrange(advance, 0.5, 1.0))
        if wrong > default_wrong + parameters.wrong_sign_share:
            reach, sdf, solution = default_reach, default_sdf, default_solution
    _log.info(
        "The linear field has %d features of length %.3g radii, and sees %d points; normals reach %.3g spacings.",
        field.widths[0],
        spectrum.length,
        len(scene.points),
        reach,
    )
    return LinearField(sdf, solution, spectrum.length)


def _unit_count(length: float, parameters: LinearFieldParameters) -> int:
    """Return how many units a field of a length in radii needs: as many as squares of that length cover a surface."""
    count = parameters.most_units * (parameters.length_scales_radii[0] / length) ** 2
    return min(max(round(count), parameters.least_units), parameters.most_units)


def wrong_sign(sdf: NeuralSDF, scene: Scene, rng: np.random.Generator) -> float:
    """Return the share of the free space where the sign is certain and the field has the other one, in [0, 1]."""
    x, distance = scene.volume(scene.volume_count, rng)
    other = sdf.sdf(sdf.frame.to_world(x)) * distance < 0
    certain = is_sign_certain(scene.coarse.winding_number(x[other]))
    return float(certain.sum() / max(len(x), 1))


# Selection of the global length scale and of the normals' weight by validation points.
#
# A blob, a pipe or a plate has few degrees of freedom: a field of long features averages the noise of many points and
# closes wide holes well. A gear or a foam needs short features. Exact normals carry more information about a smooth
# shape than noisy points do; coarse or scattered ones carry less. The longest length scale is selected that predicts
# the validation points as well as the best one, with its best weight.


@dataclass(frozen=True)
class Smoothness:
    """Length of the global field's features, in radii, and reach of its normals, in spacings."""

    length: float
    reach: float


def smooth_spectrum(
    length: float, scene: Scene, *, parameters: LinearFieldParameters = LinearFieldParameters()
) -> Spectrum:
    """Return the spectrum of a global field's features of a length in radii, or longer where points are few.

    It is that of the detail's features, with which the length is chosen, too.
    """
    return Spectrum(
        max(length, parameters.least_length_spacings * scene.coarse.spacing), FieldParameters.degrees_of_freedom
    )


def field_smoothness(
    samples: Samples,
    held_out: Mask,
    scene: Scene,
    rng: np.random.Generator,
    *,
    parameters: LinearFieldParameters = LinearFieldParameters(),
) -> Smoothness:
    """Return the length of features that a global field of the scan needs, and how far its normals reach.

    Parameters
    ----------
    samples : Samples
    held_out : mask of shape (N,), of the validation points, which `scene` does not contain
    scene : Scene
    rng : draws features and samples
    """
    if held_out.sum() < parameters.least_validation_points:
        return Smoothness(parameters.length_scales_radii[0], ObjectiveParameters.normal_reach_spacings)
    seen = rng.permutation(len(scene.samples))[: parameters.selection_points]
    x, distance = scene.volume(parameters.selection_volume_samples, rng)
    points, normals = scene.points[seen], scene.normals[seen]
    signed = scene.tensor(distance)
    center = torch.zeros(3).to(points)
    volume = scene.tensor(x), signed, signed, signed, torch.zeros_like(signed), signed.abs()
    patch = Patch(points, torch.zeros(len(points)).to(points), normals, *volume, center)
    features = Features.draw(parameters.selection_features, rng, points)
    out = np.flatnonzero(held_out)[: parameters.selection_points]
    left, turned = scene.tensor(samples.points[out]), scene.tensor(samples.normals[out])
    # Estimated normals are means over neighbours, which smooth fields predict too well.
    ignored = samples.estimated and len(samples) <= ModelSelectionParameters.sparse_points
    reaches = parameters.normal_reaches_spacings[: 1 if ignored else None]
    noise = parameters.position_noise_spacings
    best = []
    for length in parameters.length_scales_radii:
        system, scores = PatchSystem(patch, features, length, parameters.field_deviation_radii), []
        for reach in reaches:
            amplitudes = system.solve(noise * scene.coarse.spacing, noise / reach)
            value, gradient = features.sums(amplitudes, left, center, length, 1)
            angle = (gradient - turned).norm(dim=1).mean()
            scores.append((float(value.abs().mean() + scene.coarse.spacing * angle), reach))
        best.append((length, *min(scores)))
    least = min(score for _, score, _ in best)
    length, _, reach = max(tried for tried in best if tried[1] <= (1 + parameters.tie_share) * least)
    return Smoothness(length, reach)
