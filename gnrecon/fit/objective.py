"""A field's residuals under a list of terms, as the least-squares problem that the optimisers solve.

Row i of a term with weight w and N points is sqrt(w / N) r_i, so that |r|^2 / 2 is the paper's loss (its equations for
the Monte Carlo quadrature of the loss and of the Gauss-Newton matrix). The Jacobian is an operator made of the factors
of its rows (`least_squares.jacobian`); it is never stored as a matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.fit_options import FitOptions, normal_residual
from gnrecon.fit.parameters import ObjectiveParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Box, CoarseDistance, sample_near_surface
from gnrecon.least_squares.jacobian import Block
from gnrecon.least_squares.layer_products import LayerRows
from gnrecon.least_squares.layered_jacobian import LayeredJacobian
from gnrecon.residuals.constraints import Linearised, Residual, eikonal, interface, signed_distance
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import map_in_threads

Result = TypeVar("Result")

_Piece = tuple[list["ObjectiveTerm"], slice]
"""Terms that share points, and the rows of some of these."""


@dataclass(frozen=True)
class FieldProblem:
    """Terms on a sine network, of which all parameters or those of some units are free.

    Parameters
    ----------
    field : Siren
    terms : the constraints, each on frozen points
    theta : all parameters, of shape (p,), where the problem was posed
    units : for each layer the units whose incoming parameters are free (None: all of them), or None for all layers
    precision : in which the factors of J's rows are made and stored, by default that of theta; residuals keep theta's
    keep_bytes : memory that the factors of J's rows may take; above it they are made afresh for each product
    """

    field: Siren
    terms: Sequence[ObjectiveTerm]
    theta: Tensor
    units: tuple[Tensor | None, ...] | None = None
    precision: torch.dtype | None = None
    keep_bytes: int = ObjectiveParameters.factor_bytes

    @cached_property
    def columns(self) -> Tensor | None:
        """Places of the free parameters in theta, or None when all are free."""
        return None if self.units is None else self.field.layout.columns(self.units).to(self.theta.device)

    def free(self) -> Tensor:
        """Return the free parameters at theta."""
        return self.theta if self.columns is None else self.theta[self.columns]

    def whole(self, free: Tensor) -> Tensor:
        """Return all parameters, of shape (p,), from the free ones."""
        return free if self.columns is None else self.theta.index_copy(0, self.columns, free)

    def residual(self, theta: Tensor) -> Tensor:
        """Return the weighted residuals, of shape (M,), in the order of `linearise`'s rows."""
        whole = self.whole(theta)

        def rows_of(piece: _Piece) -> list[Tensor]:
            group, rows = piece
            points = group[0].points[rows]
            if all(map(_is_value_only, group)):
                value, gradient = self.field.value(whole, points), points
            else:
                value, gradient = self.field.value_and_gradient(whole, points)
            found = (_evaluate(term, rows, value, gradient) for term in group)
            return [(linear.residual * scale).T.flatten() for linear, scale in found]

        return torch.cat(list(chain.from_iterable(self._map(rows_of, groups(self.terms)))))

    def linearise(self, theta: Tensor) -> tuple[LayeredJacobian, Tensor]:
        """Return J, of shape (M, free), and r, of shape (M,), at the free parameters `theta`.

        The factors of J's rows are kept where they take at most `keep_bytes`, and made afresh for each
        product otherwise.
        """
        whole = self.whole(theta).to(self.precision or theta.dtype)
        gathered = groups([term for group in groups(self.terms) for term in _in_precision(group, whole.dtype)])

        def blocks_of(piece: _Piece) -> list[Block]:
            """Return the factors of J's rows at some points, one block for each residual of each term."""
            group, rows = piece
            jet = self.field.jet(whole, group[0].points[rows])
            found = [_evaluate(term, rows, jet.value, jet.gradient) for term in group]
            return [
                self._free_rows(jet.rows(*_column(linear, column, scale)))
                for linear, scale in found
                for column in range(linear.residual.shape[1])
            ]

        def blocks() -> Iterable[Block]:
            return chain.from_iterable(map(blocks_of, self._pieces(gathered)))

        keeps = self._factor_bytes(whole) <= self.keep_bytes
        kept = list(chain.from_iterable(self._map(blocks_of, gathered))) if keeps else None
        residual = self.residual(theta)
        source = blocks if kept is None else lambda: kept
        layers, device = self._layer_sizes(), theta.device
        return LayeredJacobian(source, len(residual), layers, device, stored=whole.dtype, kept=keeps), residual

    def _map(self, work: Callable[[_Piece], Result], gathered: list[list[ObjectiveTerm]]) -> list[Result]:
        """Return what a function makes of each piece, in threads."""
        return map_in_threads(work, self._pieces(gathered), self.theta.device)

    def _pieces(self, gathered: list[list[ObjectiveTerm]]) -> list[_Piece]:
        """Return groups of terms with some of their points."""
        return [(group, rows) for group in gathered for rows in self._chunks(group)]

    def _free_rows(self, layers: list[LayerRows]) -> list[LayerRows]:
        if self.units is None:
            return layers
        return [r if units is None else r.into(units) for r, units in zip(layers, self.units, strict=True)]

    def _free_outs(self) -> list[int]:
        """Number of free units of each layer."""
        shapes = self.field.layout.shapes
        chosen = self.units or [None] * len(shapes)
        return [out if units is None else len(units) for (out, _), units in zip(shapes, chosen, strict=True)]

    def _layer_sizes(self) -> tuple[int, ...]:
        shapes = self.field.layout.shapes
        return tuple(out * (into + 1) for out, (_, into) in zip(self._free_outs(), shapes, strict=True))

    def _chunks(
        self, group: list[ObjectiveTerm], *, parameters: ObjectiveParameters = ObjectiveParameters()
    ) -> list[slice]:
        """Return slices of the group's points, with limited memory for the activations of a layer."""
        size = max(256, min(parameters.chunk_points, parameters.chunk_bytes // (8 * max(self.field.widths))))
        return slices(len(group[0].points), size)

    def _factor_bytes(self, whole: Tensor) -> int:
        """Memory of all factors: inputs and adjoints once a point, lefts and tangents for each residual."""
        ins, outs = sum(into for _, into in self.field.layout.shapes), sum(self._free_outs())
        numbers = 0
        for group in groups(self.terms):
            numbers += len(group[0]) * (ins + outs)
            for term in group:
                linear = _probe(term)
                numbers += len(term) * linear.residual.shape[1] * (outs + (0 if linear.by_gradient is None else ins))
        return numbers * whole.element_size()


def _column(linear: Linearised, column: int, scale: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Return the scaled derivatives of one of the m residuals of each point: (N,) by value, (N, 3) by gradient."""
    by_value = None if linear.by_value is None else linear.by_value[:, column] * scale[:, 0]
    by_gradient = None if linear.by_gradient is None else linear.by_gradient[:, column] * scale
    return by_value, by_gradient


def _row_scale(weight: float | Tensor, count: int, like: Tensor) -> Tensor:
    """Return sqrt(weight / N) with shape (1, 1) or (N, 1)."""
    return torch.as_tensor(weight, dtype=like.dtype, device=like.device).div(count).sqrt().reshape(-1, 1)


def _evaluate(term: ObjectiveTerm, rows: slice, value: Tensor, gradient: Tensor) -> tuple[Linearised, Tensor]:
    """Return a term's residuals at some of its points, linearised, and the scale of their rows."""
    target = None if term.target is None else term.target[rows]
    linear = term.residual(value, gradient, target)
    weight = term.weight[rows] if isinstance(term.weight, Tensor) else term.weight
    return linear, _row_scale(weight, len(term), linear.residual)


def _in_precision(group: list[ObjectiveTerm], dtype: torch.dtype) -> list[ObjectiveTerm]:
    """Return the terms of a group with points and targets in `dtype`, the points still one tensor for all of them."""
    points = group[0].points.to(dtype)
    return [
        replace(term, points=points, target=None if term.target is None else term.target.to(dtype)) for term in group
    ]


def _is_value_only(term: ObjectiveTerm) -> bool:
    """Whether the residual can be evaluated without the gradient."""
    return _probe(term).by_gradient is None


def _probe(term: ObjectiveTerm) -> Linearised:
    """Return what the residual looks like at one point."""
    probe = term.points.new_zeros(1)
    target = None if term.target is None else term.target[:1]
    return term.residual(probe, term.points.new_ones(1, 3), target)


# Terms of a fit: a residual, where it is sampled, and its weight.


@dataclass(frozen=True)
class ObjectiveTerm:
    """One constraint on one frozen set of points.

    The loss is  weight / (2 N) sum_i |r_i|^2  over the term's N points, the paper's Monte Carlo quadrature.

    Parameters
    ----------
    name : str
        What the history and the report call it.
    residual : function of (value, gradient, target)
    points : of shape (N, 3), unit coordinates
    target : of shape (N,), (N, 2) or (N, 3), or None
    weight : float, or a tensor of shape (N,) for weights that differ from point to point
    """

    name: str
    residual: Residual
    points: Tensor
    target: Tensor | None = None
    weight: float | Tensor = 1.0

    def __len__(self) -> int:
        return len(self.points)


def groups(terms: Sequence[ObjectiveTerm]) -> list[list[ObjectiveTerm]]:
    """Gather the terms that share one tensor of points, so that the network is differentiated once for all of them."""
    by_points: dict[int, list[ObjectiveTerm]] = {}
    for term in terms:
        by_points.setdefault(id(term.points), []).append(term)
    return list(by_points.values())


# The terms of a fit, sampled for each step.
#
# In the paper's Monte Carlo form (weights on mean squares, unit coordinates, h the spacing of the data):
#
#     interface   f = 0                  at the points        1
#     normal      grad f = n             at the points        max(r h, 0.012)^2, an angle as a height over that length;
#                                                             r is the scene's reach, 0.4 where nothing chose it
#     distance    f = coarse distance    in the box           max(1e-4 M / N, 4e-4), M samples and N points
#     eikonal     |grad f| = 1           near the surface     (0.05 h)^2
#                                        and in the box


def start_terms(
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    x: Tensor,
    distance: Tensor,
    most: int,
) -> list[ObjectiveTerm]:
    """Return the terms of a linear start: those of `linear_data_terms`, and of `distance_term`."""
    return [*linear_data_terms(scene, options, rng, most), distance_term(scene, x, distance)]


def linear_data_terms(scene: Scene, options: FitOptions, rng: np.random.Generator, most: int) -> list[ObjectiveTerm]:
    """Return the terms of at most `most` data points, of which other residuals of normals become linear ones."""
    # Other residuals than these two are not linear in f, or not known to be.
    linear = options if options.normals in ("vector", "projection") else replace(options, normals="vector")
    return data_terms(scene, linear, rng, most)


def step_terms(
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    volume: tuple[Tensor, Tensor],
    most: int,
    *,
    parameters: ObjectiveParameters = ObjectiveParameters(),
) -> list[ObjectiveTerm]:
    """Draw the terms of one step: at most `most` data points, and the volume.

    Parameters
    ----------
    volume : samples, of shape (Q, 3), and their coarse distances, of shape (Q,)
    """
    eikonal_count = min(parameters.eikonal_samples, most)
    near = sample_near_surface(scene.samples.points, 2 * scene.coarse.spacing, eikonal_count, rng)
    around = np.concatenate([near, scene.box.sample(eikonal_count // 3, rng)])
    eikonal_weight = (parameters.eikonal_reach_spacings * scene.coarse.spacing) ** 2
    return [
        *data_terms(scene, options, rng, most),
        distance_term(scene, *volume),
        ObjectiveTerm("eikonal", eikonal, scene.tensor(around), None, eikonal_weight),
    ]


def data_terms(scene: Scene, options: FitOptions, rng: np.random.Generator, most: int) -> list[ObjectiveTerm]:
    """Return interface and normals at the data points, or at a random `most` of them."""
    points, normals = scene.points, scene.normals
    if len(points) > most:
        rows = torch.as_tensor(np.sort(rng.permutation(len(points))[:most])).to(points.device)
        points, normals = points[rows], normals[rows]
    relative = normal_weight(scene.coarse.spacing, scene.reach)
    return [
        ObjectiveTerm("interface", interface, points),
        ObjectiveTerm("normal", normal_residual(options.normals), points, normals, relative),
    ]


def normal_weight(
    spacing: float,
    reach: float = ObjectiveParameters.normal_reach_spacings,
    *,
    least_reach_radii: float = ObjectiveParameters.least_normal_reach_radii,
) -> float:
    """Return the weight of normals relative to that of the interface, for data of a spacing in radii.

    An angle counts as a height over `reach` spacings, or over `least_reach_radii` if that is longer.
    """
    return max(reach * spacing, least_reach_radii) ** 2


def distance_term(scene: Scene, x: Tensor, distance: Tensor) -> ObjectiveTerm:
    """Return the term of coarse distances, of shape (Q,), at volume samples, of shape (Q, 3)."""
    return ObjectiveTerm("distance", signed_distance, x, distance, distance_weight(len(x), len(scene.points)))


def distance_weight(samples: int, points: int, *, parameters: ObjectiveParameters = ObjectiveParameters()) -> float:
    """Return the weight of so many volume samples for so many data points: more where data is sparse."""
    return max(parameters.distance_weight_per_sample * samples / points, parameters.least_distance_weight)


# What a fit is made in: the samples as tensors, their coarse distance, and the box around them.


@dataclass(frozen=True)
class Scene:
    """Data points and normals, of shape (N, 3), on the device; the rest in numpy, for sampling.

    `reach` is the length, in spacings, over which an angle of a normal counts as a height; see `normal_weight`.
    `deviations`, of shape (N,), are the least standard deviations of the normals, where they are known for each.
    """

    points: Tensor
    normals: Tensor
    samples: Samples
    coarse: CoarseDistance
    box: Box
    volume_count: int = ObjectiveParameters.volume_samples
    reach: float = ObjectiveParameters.normal_reach_spacings
    deviations: Tensor | None = None

    @classmethod
    def of(cls, samples: Samples, device: str, rng: np.random.Generator) -> Scene:
        """Put samples on a device."""
        coarse = CoarseDistance(samples.points, samples.normals, rng, may_be_open=True)
        points, normals, deviations = _tensors(samples, device)
        return cls(points, normals, samples, coarse, _box(samples), deviations=deviations)

    def with_samples(self, samples: Samples) -> Scene:
        """Return the scene with other samples of the same surface."""
        points, normals, deviations = _tensors(samples, str(self.points.device))
        return replace(self, points=points, normals=normals, samples=samples, deviations=deviations)

    def take(self, rows: Tensor) -> Scene:
        """Return the scene with some of the points; all else is that of all samples."""
        deviations = None if self.deviations is None else self.deviations[rows]
        return replace(self, points=self.points[rows], normals=self.normals[rows], deviations=deviations)

    def volume(self, count: int, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return about `count` points of the box, (Q, 3), half of them near the data, and their coarse distances."""
        return self.coarse.sample(self.places(count, rng))

    def places(
        self, count: int, rng: np.random.Generator, *, shell_spacings: float = ObjectiveParameters.shell_spacings
    ) -> Float:
        """Return such points, of shape (Q, 3), also where no distance is known because the data is too near."""
        shell = sample_near_surface(self.samples.points, shell_spacings * self.coarse.spacing, count // 2, rng)
        inside = ((shell > self.box.lower) & (shell < self.box.upper)).all(axis=1)
        return np.concatenate([self.box.sample(count - count // 2, rng), shell[inside]])

    def tensor(self, values: Float) -> Tensor:
        """Return `values` as a tensor like the data's."""
        return torch.as_tensor(values).to(self.points)


def _tensors(samples: Samples, device: str) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return points, normals and the normals' deviations, if they are known, on a device."""
    points, normals = (torch.as_tensor(rows, device=device) for rows in (samples.points, samples.normals))
    return points, normals, None if samples.deviations is None else torch.as_tensor(samples.deviations, device=device)


def bounds_of(samples: Samples) -> Float:
    """Lower and upper corner of the box in which samples will be fitted, of shape (2, 3), file units."""
    box = _box(samples)
    return samples.frame.to_world(np.stack([box.lower, box.upper]))


def _box(samples: Samples, *, margin_radii: float = ObjectiveParameters.box_margin_radii) -> Box:
    return Box.around(samples.points, margin_radii)
