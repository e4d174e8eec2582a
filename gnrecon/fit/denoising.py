"""Whether a scan's points are averaged before their detail is fitted, and how: what predicts left-out points better.

The left-out points are as they were scanned, and the patches are the same, so that scores compare patch by patch. Only
scans in which noise was found are tried.

Some tens of patches tell a gain of less than their scatter from a loss no better than a coin does, so that it decides
what is known of the shape beside them. Where faces meet at edges, the fit is better for averaging unless the patches
contradict; anywhere else it smooths better by itself, unless they show that it does not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.local_solve import Hyperparameters
from gnrecon.fit.model_selection import CrossValidation, FieldResiduals, SelectedModel
from gnrecon.fit.parameters import DenoisingParameters
from gnrecon.fit.shape_priors.bilateral_filter import Averaging
from gnrecon.fit.shape_priors.sharp_shape import Sharp, has_edges
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Samples

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LocalData:
    """What a fit of the detail is told.

    Parameters
    ----------
    samples : averaged, or as they were
    leftover : of a global field at the samples
    belief : about them
    averaging : how they were averaged, or None
    """

    samples: Samples
    residuals: FieldResiduals
    hyperparameters: Hyperparameters
    averaging: Averaging | None = None

    @classmethod
    def of_faces(cls, sdf: NeuralSDF, sharp: Sharp) -> LocalData:
        """Return what faces that were continued to their edges tell by themselves, beside a global field."""
        return cls(sharp.samples, FieldResiduals.of(sdf, sharp.samples), sharp.hyperparameters, sharp.averaging)


def choose_local_data(
    sdf: NeuralSDF,
    samples: Samples,
    held: Mask,
    features: int,
    rng: np.random.Generator,
    device: str,
    outliers: bool = False,
    *,
    parameters: DenoisingParameters = DenoisingParameters(),
) -> LocalData:
    """Choose how the points are averaged, if at all, and the belief that then predicts left-out points best.

    A clean scan is not averaged, and its belief is what its points tell by themselves.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    samples : all of them
    held : mask of shape (N,), of samples that the global field has not seen
    features : number of features a cube
    rng : draws patches and features
    device : a torch device
    outliers : whether some were found; those that are left would make horns on what is fitted as clean
    """
    residuals = FieldResiduals.of(sdf, samples)
    radius = residuals.density.radius
    validation = CrossValidation.draw(residuals, held, radius, rng, device, features)
    clean = None if outliers else validation.clean()
    if clean is not None:
        return LocalData(samples, residuals, clean)
    choice = validation.choice()
    # Outliers that are left have no part in the noise that evidence tells.
    plain = choice.hyperparameters if outliers else choice.best
    # Estimated normals are means over edges already. The noise may be the limit itself, but for rounding.
    if samples.estimated or choice.hyperparameters.position <= 1.001 * parameters.least_noise_disk_radii * radius:
        return LocalData(samples, residuals, plain)

    def with_kept(averaging: Averaging) -> CrossValidation:
        points, normals = samples.points.copy(), samples.normals.copy()
        points[~held], normals[~held] = averaging.of(points[~held], normals[~held])
        # The noise of averaged points is alike among neighbours, of which no evidence is made.
        of_averaged = FieldResiduals.of(sdf, replace(samples, points=points, normals=normals))
        return replace(validation, residuals=of_averaged, likelihood=None)

    first = _candidates(parameters)[0]
    found = _best(choice, with_kept, lambda: has_edges(*first.of(samples.points, samples.normals)), parameters)
    if found is None:
        return LocalData(samples, residuals, plain)
    averaging, better = found
    points, normals = averaging.of(samples.points, samples.normals)
    samples = replace(samples, points=points, normals=normals)
    _log.info("Points are averaged over %.2g radii of their disks where normals agree.", averaging.width)
    return LocalData(samples, FieldResiduals.of(sdf, samples), better.choice().hyperparameters, averaging)


def _best(
    choice: SelectedModel,
    kept_averaged: Callable[[Averaging], CrossValidation],
    edges: Callable[[], bool],
    parameters: DenoisingParameters = DenoisingParameters(),
) -> tuple[Averaging, CrossValidation] | None:
    """Return the averaging that predicts best and its trials, or None where the points are better left as they are.

    Whether there are edges is asked where the patches alone do not decide. All are compared at the length that suits
    the points as they are; a better one is chosen afterwards.
    """
    plain = _of_best_noise(choice.scores)
    first, *others = _candidates(parameters)

    def tried(averaging: Averaging) -> tuple[Float, CrossValidation]:
        validation = kept_averaged(averaging)
        return plain - _of_best_noise(validation.scores(choice.hyperparameters.length)), validation

    gain, validation = tried(first)
    doubt = gain.std() / np.sqrt(len(gain))
    if not (gain.mean() > parameters.gain_standard_errors * doubt or (gain.mean() > -doubt and edges())):
        return None
    best, averaging = float(gain.mean()), first
    for other in others:
        gain, of_other = tried(other)
        if gain.mean() > best:
            best, averaging, validation = float(gain.mean()), other, of_other
    return averaging, validation


def _candidates(parameters: DenoisingParameters) -> list[Averaging]:
    """Return the filters to try, of which the others are tried only where the first one helps."""
    return [Averaging(width, parameters.normal_difference) for width in parameters.widths_disk_radii]


def _of_best_noise(scores: Float) -> Float:
    """Return the patches' scores, of shape (patches,), of the noise that is best on the mean of (patches, noises)."""
    best: Float = scores[:, int(scores.mean(axis=0).argmin())]
    return best
