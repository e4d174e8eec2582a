"""The smooth global field: a sine network by Gauss-Newton, or one linear layer of sine features.

A linear field is solved (`linear_field`) and, side by side, a network of several layers is fitted with eikonal
regularisation (`global_network`). The network is the global field where it predicts the validation points and the sign
of free space better, by more than chance: on organic scans nearly always. A thin wall that sparse points hardly show
may be lost on its way, and noise may hide that it is better; then the linear field remains, as it does in draft
quality. With curvature penalties the global field is the linear one, on which they are then minimised. What it leaves
over at the points is the data of the local fields (`FieldResiduals`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from gnrecon.field.partition_of_unity import Detail
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions, network_steps
from gnrecon.fit.free_space import Volume
from gnrecon.fit.global_network import NetworkTerms, Prediction
from gnrecon.fit.linear_field import fit_linear
from gnrecon.fit.local_solve import Patch
from gnrecon.fit.network_ladder import NetworkLadder, Rival
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import GlobalFieldParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density, scene_dipoles
from gnrecon.optim import Callback, Record, Solution
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GlobalField:
    """A global field and how it was solved.

    Parameters
    ----------
    sdf : the field
    solution : with the steps of Gauss-Newton as its history
    scene : what it saw
    length : of the linear field's features, in radii
    ladder : the network's, or None of a linear field
    linear : the linear field that the network was compared with, or None
    """

    sdf: NeuralSDF
    solution: Solution
    scene: Scene
    length: float
    ladder: NetworkLadder | None = None
    linear: NeuralSDF | None = None

    def values(self, samples: Samples) -> list[Float]:
        """Return the values at samples, each of shape (N,), world units, of all fields that were fitted."""
        x = samples.frame.to_world(samples.points)
        return [field.sdf(x) for field in (self.sdf, self.linear) if field is not None]

    def refitted(self, samples: Samples) -> NeuralSDF:
        """Return the field after some steps on all samples, which the validation points are a part of."""
        if self.ladder is None:
            return self.sdf
        field, theta = self.ladder.refit(self.scene.with_samples(samples))
        return replace(self.sdf, field=field, theta=theta)


@dataclass(frozen=True)
class FieldResiduals:
    """The global field at the points, whose values are residuals: all of shape (N,) or (N, 3), unit coordinates.

    `estimated`, `clean` and `deviations`, of shape (N,), are those of `Samples`; `noise` is the deviation that the
    points themselves show, or None.
    """

    points: Float
    normals: Float
    value: Float
    gradient: Float
    estimated: bool = False
    noise: float | None = None
    clean: bool | None = None
    deviations: Float | None = None

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples) -> FieldResiduals:
        """Evaluate a field at samples."""
        value, gradient = sdf.sdf_and_gradient(samples.frame.to_world(samples.points))
        given = samples.estimated, samples.noise, samples.clean, samples.deviations
        return cls(samples.points, samples.normals, value / samples.frame.scale, gradient, *given)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def density(self) -> Density:
        """How densely the points lie."""
        return Density(self.points)

    @cached_property
    def dipoles(self) -> DipoleTree:
        """Of the points, for their winding number."""
        return DipoleTree.of(self.points, *scene_dipoles(self.points, self.normals, self.density.disks))

    @cached_property
    def rms(self) -> float:
        """Root mean square of the values."""
        return float(np.sqrt(np.mean(self.value**2)))

    @cached_property
    def angle(self) -> float:
        """Median deviation of the normals, that of one of weight one; a radian where none are known."""
        return 1.0 if self.deviations is None else float(np.median(self.deviations))

    def take(self, rows: Int) -> FieldResiduals:
        """Return those of some points."""
        at = (self.points[rows], self.normals[rows], self.value[rows], self.gradient[rows])
        deviations = None if self.deviations is None else self.deviations[rows]
        return FieldResiduals(*at, self.estimated, self.noise, self.clean, deviations)

    def after(self, detail: Detail) -> FieldResiduals:
        """Return the residuals of the field with a detail that is added."""
        value, gradient = detail.value_and_gradient(self.points)
        return replace(self, value=self.value + value, gradient=self.gradient + gradient)

    def within(self, center: Float, reach: float) -> Int:
        """Return the rows of the points in the cube of half an edge `reach` about a centre, in order."""
        return np.sort(np.array(self.density.tree.query_ball_point(center, reach, p=np.inf), dtype=np.int64))

    def patch(self, rows: Int, center: Float, volume: Volume, device: str) -> Patch:
        """Return the patch of some rows, with samples of the volume."""
        turn = self.normals[rows] - self.gradient[rows]
        arrays = (self.points[rows], -self.value[rows], turn, *volume.arrays(), center)
        patch = Patch(*(torch.as_tensor(values, device=device) for values in arrays))
        if self.deviations is None:
            return patch
        weights = (self.angle / self.deviations[rows]) ** 2
        return replace(patch, normal_weights=torch.as_tensor(weights, device=device))


def fit_global(
    samples: Samples,
    held_out: Mask,
    rows: Int,
    options: FitOptions,
    rng: np.random.Generator,
    advance: ProgressCallback,
    callback: Callback | None = None,
    *,
    linear_only: bool = False,
    parameters: GlobalFieldParameters = GlobalFieldParameters(),
) -> GlobalField:
    """Fit the smooth field to some of the samples.

    Parameters
    ----------
    samples : Samples
    held_out : mask of shape (N,), of the validation points
    rows : of the samples that the field is fitted to, none of them a validation point
    options : of which the device and the curvature penalties are used
    rng : draws features, units and samples of the volume
    advance : called with the share that is done
    callback : called with the record of each step of Gauss-Newton
    linear_only : whether the linear field is wanted: for speed, as the start of curvature penalties, or for samples
        that cover the faces of a sharp shape, which leave a network nothing to predict
    parameters : of the linear field and of the network

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    seen = samples.select(rows)
    scene = Scene.of(seen, options.device, rng)

    def solved(advance: ProgressCallback) -> GlobalField:
        linear = fit_linear(samples, held_out, scene, options, rng, advance, parameters=parameters.linear)
        return GlobalField(linear.sdf, linear.solution, scene, linear.length)

    if linear_only:
        return solved(advance)
    points, normals = samples.points[held_out], samples.normals[held_out]
    # The linear field and the networks are fitted side by side, each with random numbers of its own.
    of_networks = rng.spawn(1)[0]
    terms = NetworkTerms.draw(scene, points, normals, of_networks, parameters=parameters.terms)
    linear: list[tuple[GlobalField, Prediction]] = []

    def score_of_linear() -> float:
        field = solved(ignore_progress)
        prediction = terms.prediction(field.sdf.field, field.sdf.theta)
        linear.append((field, prediction))
        return prediction.score

    rival = Rival(score_of_linear, exact_score=parameters.exact_score)
    step = _counted(callback, advance, network_steps(len(scene.points), parameters=parameters.ladder))
    ladder = NetworkLadder(terms, options, of_networks, step, rival, parameters.ladder)
    fitted = ladder.fit()
    ((first, of_linear),) = linear
    if fitted is None:
        _log.info("The linear field predicts the validation points: %.3g disk radii.", rival.score)
        return first
    field, solution, _ = fitted
    found = terms.prediction(field, solution.theta)
    _log.info("Score of validation points: linear field %.3g, network %.3g disk radii.", of_linear.score, found.score)
    better = found.is_better_than(of_linear, standard_errors=parameters.ladder.gain_standard_errors)
    if not (better or solution.interrupted):
        return replace(first, solution=replace(first.solution, history=solution.history))
    sdf = NeuralSDF(field, solution.theta, samples.frame, scene.box, options.as_dict())
    return GlobalField(sdf, solution, scene, first.length, ladder, first.sdf)


def _counted(callback: Callback | None, advance: ProgressCallback, most_steps: int) -> Callback:
    """Return a callback that also advances the progress, by each step's share of the most steps."""

    def step(record: Record) -> None:
        advance(min(record.step / most_steps, 1.0))
        if callback is not None:
            callback(record)

    return step
