"""Curvature penalties on the global field (`penalise_global`) and on local fields (`SurfacePenalties.penalise_cube`).

Holes that are to be filled by a minimal surface need other distances in the volume: the coarse ones have the sign of
the winding number, which closes the hole elsewhere, and the distance to the hole's rim. Volume samples that are nearer
to the current surface in the hole than to any scanned point get the distance to that surface instead. This keeps the
field's sign and slope near it, and hardly fixes its place, because these rows have small weights.

With such small weights, features that follow the curvature penalty may make sheets in free space. Where the sign is
certain, a one-sided residual (`FreeSpace`) keeps it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.free_space import LatticeVolume
from gnrecon.fit.local_solve import PatchSystem
from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, Scene, data_terms, distance_term
from gnrecon.fit.parameters import InitialisationParameters, PenaltyFitParameters, SingleNetworkParameters
from gnrecon.fit.penalties.regularisers import Jet, PenaltyTerm, Regulariser, SineSum, minimise_penalised
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.signed_distance import Density, free_space_bounds, is_sign_certain
from gnrecon.least_squares.direct import damped_factor
from gnrecon.level_set import LevelSet, sample_surface
from gnrecon.residuals import SecondOrder, free_space
from gnrecon.runtime.errors import FitError


@dataclass(frozen=True)
class FreeSpace:
    """Points of the volume at which the sign is certain, and bounds of f there.

    Parameters
    ----------
    points : of shape (Q, 3)
    least : of shape (Q,), signed
    """

    points: Float
    least: Float

    @classmethod
    def of(
        cls, scene: Scene, rng: np.random.Generator, *, parameters: PenaltyFitParameters = PenaltyFitParameters()
    ) -> FreeSpace:
        """Draw points of a scan's box."""
        x = scene.places(parameters.free_space_factor * scene.volume_count, rng)
        known, distance, _, winding = scene.coarse.at(x)
        kept = is_sign_certain(winding) & (np.abs(distance) > parameters.free_space_clearance_radii)
        return cls(x[known][kept], free_space_bounds(distance[kept], parameters.most_free_space_distance_radii))

    def terms(
        self,
        rows: Mask,
        known: Float,
        scale: float,
        like: Tensor,
        *,
        weight: float = PenaltyFitParameters.free_space_weight,
    ) -> list[PenaltyTerm]:
        """Return the one-sided terms at some of the points.

        Parameters
        ----------
        rows : mask of them
        known : value at all points, of shape (Q,), of the field that the features are added to
        scale : of the root mean square residual of all points, for a weight of one
        like : tensor whose device is used
        """
        if not rows.any():
            return []
        points, least, fixed_value = (torch.as_tensor(part[rows]).to(like) for part in (self.points, self.least, known))
        scales = torch.full_like(least, scale * (weight / len(rows)) ** 0.5)[:, None]
        residual = SecondOrder("free space", lambda f, g, _, target: free_space(f, g, target))
        return [PenaltyTerm(residual, points, scales, target=least, fixed_value=fixed_value)]


@dataclass(frozen=True)
class SurfacePenalties:
    """Curvature penalties of a field and the points at which they apply.

    Parameters
    ----------
    regularisers : the penalties
    surface : points of the surface at which they apply
    sdf : the global field
    density : of the scanned points
    free : where the field is to keep its sign
    """

    regularisers: Sequence[Regulariser]
    surface: PenaltySamples
    sdf: NeuralSDF
    density: Density
    free: FreeSpace

    @classmethod
    def of(
        cls,
        regularisers: Sequence[Regulariser],
        sdf: NeuralSDF,
        density: Density,
        free: FreeSpace,
        length: float,
        rng: np.random.Generator,
    ) -> SurfacePenalties:
        """Draw points of the surface for features of a length, in radii."""
        return cls(
            regularisers,
            PenaltySamples.of(sdf, density, length / PenaltyFitParameters.samples_per_length, rng),
            sdf,
            density,
            free,
        )

    @cached_property
    def free_space_values(self) -> Float:
        """Values of the global field at the points of the free space, of shape (Q,)."""
        return self.sdf.sdf(self.sdf.frame.to_world(self.free.points)) / self.sdf.frame.scale

    def volume_distances(self, x: Float, signed: Float) -> Float:
        """Return signed distances at points of the volume, of shape (Q, 3), from coarse ones, of shape (Q,)."""
        if not any(one.holes for one in self.regularisers):
            return signed
        return self.surface.volume_distances(x, signed, self.sdf.sdf(self.sdf.frame.to_world(x)), self.density)

    def terms(self, rows: Mask, scale: float, like: Tensor) -> list[PenaltyTerm]:
        """Return the penalty terms at some points of the surface.

        Parameters
        ----------
        rows : mask of the surface points
        scale : of each point's residuals, for a weight of one
        like : tensor whose device is used
        """
        found = []
        for one in self.regularisers:
            share = self.surface.far * rows if one.holes else 1.0 * rows
            active = np.flatnonzero(share)
            if len(active):
                points, weights = (torch.as_tensor(part[active]).to(like) for part in (self.surface.points, share))
                scales = scale * (one.weight * weights[:, None]).sqrt()
                found.append(PenaltyTerm(one.residual, points, scales, one.crease))
        return found

    def penalise_cube(
        self,
        features: Features,
        length: float,
        center: Float,
        reach: float,
        hyperparameters: Hyperparameters,
        system: PatchSystem,
        near: LatticeVolume | None = None,
        *,
        parameters: PenaltyFitParameters = PenaltyFitParameters(),
    ) -> Tensor:
        """Return the amplitudes of a cube, of shape (m,), of half an edge `reach`; see `PatchSystem` for the rest."""
        amplitudes = system.solve_with_bounds(hyperparameters.position, hyperparameters.angle, near)
        equations = system.equations(hyperparameters.position, hyperparameters.angle)
        rows = np.asarray((np.abs(self.surface.points - center) < reach).all(axis=1))
        scale = (len(self.density.points) / len(self.surface)) ** 0.5 / hyperparameters.position
        terms = self.terms(rows, scale, amplitudes)
        if equations is None or not terms:
            return amplitudes
        around = np.asarray((np.abs(self.free.points - center) < reach).all(axis=1))
        terms += self.free.terms(
            around, self.free_space_values, len(self.density.points) ** 0.5 / hyperparameters.position, amplitudes
        )
        whole, known = as_sines(self.sdf)

        def base(x: Tensor) -> Jet:
            return whole.jet(known, x, whole.known(x))

        sines = SineSum(
            features, torch.as_tensor(center).to(amplitudes), length, parameters.cube_step_lengths * length, base
        )
        return minimise_penalised(sines, *equations, terms, amplitudes, parameters.cube_steps)


def penalise_global(
    penalties: SurfacePenalties,
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    *,
    parameters: PenaltyFitParameters = PenaltyFitParameters(),
) -> NeuralSDF:
    """Return the global field with output weights that also minimise the penalties.

    Raises
    ------
    FitError
        When the data's system cannot be factored.
    """
    sdf, like = penalties.sdf, scene.points
    everywhere, free = (np.ones(len(one), dtype=bool) for one in (penalties.surface.points, penalties.free.points))
    terms = penalties.terms(everywhere, max(len(everywhere), 1) ** -0.5, like)
    # The global field is all of f.
    terms += penalties.free.terms(free, np.zeros(len(free)), 1.0, like)
    x, wanted = _volume(penalties, scene, scene.volume_count, rng)
    for left in reversed(range(parameters.rounds)):
        volume = scene.tensor(x), scene.tensor(wanted)
        data = [*data_terms(scene, options, rng, SingleNetworkParameters.start_points), distance_term(scene, *volume)]
        sines, amplitudes = as_sines(sdf)
        problem, factor, right = _linear_part(sdf, data, amplitudes)
        sdf = replace(
            sdf,
            theta=problem.whole(minimise_penalised(sines, factor, right, terms, amplitudes, parameters.global_steps)),
        )
        if left:
            # Where the sign has become wrong, more samples bring it back, as at the fit's start.
            trial, expected = _volume(penalties, scene, 3 * scene.volume_count, rng)
            wrong = np.flatnonzero(sdf.sdf(sdf.frame.to_world(trial)) * expected <= 0)[: scene.volume_count // 2]
            x, wanted = np.concatenate([x, trial[wrong]]), np.concatenate([wanted, expected[wrong]])
    return sdf


def _volume(penalties: SurfacePenalties, scene: Scene, count: int, rng: np.random.Generator) -> tuple[Float, Float]:
    """Return points of the volume, of shape (Q, 3), and what their signed distances should be, of shape (Q,)."""
    x, distance = scene.volume(count, rng)
    return x, penalties.volume_distances(x, distance)


def _linear_part(
    sdf: NeuralSDF,
    terms: Sequence[ObjectiveTerm],
    amplitudes: Tensor,
    *,
    ridge: float = InitialisationParameters.ridge,
    attempts: int = PenaltyFitParameters.ridge_attempts,
) -> tuple[FieldProblem, Tensor, Tensor]:
    """Return the last layer's problem, and L and b of its normal equations L L^T a = b."""
    none = torch.zeros(0, dtype=torch.long, device=amplitudes.device)
    problem = FieldProblem(sdf.field, terms, sdf.theta, (none, None))
    jacobian, residual = problem.linearise(problem.free())
    product, ridge = jacobian.gram(), ridge / max(len(term) for term in terms)
    right = jacobian.tmv(jacobian.mv(amplitudes) - residual)
    for _ in range(attempts):
        factor = damped_factor(product, torch.full_like(right, ridge))
        if factor is not None:
            # The ridge holds the amplitudes where they are, as damping does.
            return problem, factor, right + ridge * amplitudes
        ridge *= 10
    raise FitError("The curvature penalties could not be applied: the linear system holds values that are not finite.")


def as_sines(sdf: NeuralSDF) -> tuple[SineSum, Tensor]:
    """Return a network of one layer as sine features, with one more for its bias, and their amplitudes."""
    (weights, bias), (out, constant) = sdf.field.layout.layers(sdf.theta)
    frequencies = torch.cat([weights, weights.new_zeros(1, 3)])
    phases = torch.cat([bias, bias.new_full((1,), torch.pi / 2)])
    sines = SineSum(Features(frequencies, phases), weights.new_zeros(3), 1.0, PenaltyFitParameters.global_step_radii)
    return sines, torch.cat([out[0], constant])


# Points of a fitted field's surface, and how far each is from the scan, as in its holes.
#
# Distances are in radii of the disk that the nearest scanned point stands for. If points are uniformly distributed on a
# surface, one in fifty of its places is 2 radii from all of them, and five in a million are 3.5 radii away. Weights
# between these are interpolated, so that the penalty begins smoothly at a hole's rim.


@dataclass(frozen=True)
class PenaltySamples:
    """Points of a surface, about uniform by area, unit coordinates.

    Parameters
    ----------
    points : of shape (N, 3)
    far : how much each counts as far from the scan, from 0 to 1, of shape (N,)
    """

    points: Float
    far: Float

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of(
        cls,
        sdf: NeuralSDF,
        density: Density,
        spacing: float,
        rng: np.random.Generator,
        *,
        parameters: PenaltyFitParameters = PenaltyFitParameters(),
    ) -> PenaltySamples:
        """Draw points of a field's zero level about `spacing` apart, in radii; none where there is no surface.

        Connected parts without a point near the scan are not part of the shape, and are dropped.
        """
        scanned = float(np.pi * np.square(density.disks).sum())
        count = int(np.clip(scanned / spacing**2, parameters.least_surface_samples, parameters.most_surface_samples))
        points = sample_surface(_level_set(sdf), count, rng, parameters.surface_nodes, sweeps=0).points.cpu().numpy()
        distance, nearest = density.tree.query(points)
        low, high = parameters.near_disk_radii, parameters.far_disk_radii
        far = np.clip((distance / density.disks[nearest] - low) / (high - low), 0.0, 1.0)
        kept = _connected(points, far == 0.0, parameters.joined_spacings * np.sqrt(scanned / count))
        return cls(points[kept], far[kept])

    def volume_distances(self, x: Float, signed: Float, value: Float, density: Density) -> Float:
        """Return coarse signed distances, with those to the far part where it is nearer than all scanned points.

        Parameters
        ----------
        x : points of the volume, of shape (Q, 3)
        signed : what their coarse distances are, of shape (Q,)
        value : of the field there, whose sign gives the side of the far part, of shape (Q,)
        density : of the scanned points
        """
        film = self.points[self.far == 1.0]
        if not len(film):
            return signed
        distance = cKDTree(film).query(x)[0]
        signed_distance: Float = np.where(distance < density.tree.query(x)[0], np.sign(value) * distance, signed)
        return signed_distance


def _connected(points: Float, near: Mask, reach: float) -> Mask:
    """Return which points, of shape (N, 3), are connected to a near one by steps of at most `reach`."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    labels = connected_components(graph, directed=False)[1]
    joined: Mask = np.isin(labels, np.unique(labels[near]))
    return joined


def _level_set(sdf: NeuralSDF) -> LevelSet:
    """Return the field's zero level in unit coordinates."""

    def both(x: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = sdf.sdf_and_gradient(sdf.frame.to_world(x.cpu().numpy()))
        return torch.as_tensor(value / sdf.frame.scale), torch.as_tensor(gradient)

    def value(x: Tensor) -> Tensor:
        return torch.as_tensor(sdf.sdf(sdf.frame.to_world(x.cpu().numpy())) / sdf.frame.scale)

    return LevelSet(value, both, sdf.box)
