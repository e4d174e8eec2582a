"""A learned field as the exporter sees it, and the mesh of the part that is shown."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gnrecon.export import extract, project
from gnrecon.export.trim import clip_to_box
from gnrecon.field import Network
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set import chamfer_divergence
from gnrecon.runtime.errors import FitError, MeshError
from gnrecon.shape_learning.shape_problem import LAST, ShapeProblem

MARGIN = 2
"""Cells around the shown box that are meshed as well, so that the cap that closes the field there is cut off."""


@dataclass(frozen=True)
class LearnedField:
    """A network's values as a field in its own coordinates; about a distance where the terms made it one.

    Parameters
    ----------
    network : Network
    theta : parameters, of shape (p,)
    box : where it was learned
    """

    network: Network
    theta: Tensor
    box: Box

    @property
    def frame(self) -> Frame:
        """The frame of the coordinates, moved and scaled to the box."""
        return Frame((self.box.lower + self.box.upper) / 2, float(np.linalg.norm(self.box.upper - self.box.lower) / 2))

    @property
    def bounds(self) -> Float:
        """Lower and upper corner of the box, of shape (2, 3)."""
        return np.stack([self.box.lower, self.box.upper])

    def sdf(self, points: Float) -> Float:
        """Return values, of shape (N,), at points of shape (N, 3)."""
        return self.network.value(self.theta, torch.as_tensor(points)).numpy()

    def gradient(self, points: Float) -> Float:
        """Return gradients, of shape (N, 3), at points of shape (N, 3)."""
        return self.sdf_and_gradient(points)[1]

    def sdf_and_gradient(self, points: Float) -> tuple[Float, Float]:
        """Return values and gradients at once."""
        value, gradient = self.network.value_and_gradient(self.theta, torch.as_tensor(points))
        return value.numpy(), gradient.numpy()

    def hessian(self, points: Float) -> Float:
        """Return second derivatives, of shape (N, 3, 3), at points of shape (N, 3)."""
        return self.network.curved_jet(self.theta, torch.as_tensor(points)).hessian.numpy()


def mesh_of(field: LearnedField, shown: Box, resolution: int) -> Mesh:
    """Return the mesh of the part of a field's zero level in a box, with normals: open where it leaves the box.

    Parameters
    ----------
    resolution : cells along the longest side of the box

    Raises
    ------
    MeshError
        When there is no zero level in the box.
    """
    sides = shown.upper - shown.lower
    cell = float(sides.max() / resolution)
    # Whole cells, so that the planes of the box are planes of the lattice where its sides allow it.
    cells = np.ceil(sides / cell - 1e-9)
    grow = (cells * cell - sides) / 2 + MARGIN * cell
    outer = np.stack([shown.lower - grow, shown.upper + grow])
    whole = extract(field, resolution=int(cells.max()) + 2 * MARGIN, bounds=outer)
    mesh = clip_to_box(whole, np.stack([shown.lower, shown.upper]))
    if not len(mesh.faces):
        raise MeshError("The field has no zero level in the box that is shown, so there is no surface to mesh.")
    return project(mesh, field)


DRAWS = 2
"""Times that each term's points are drawn for the loss; their mean counts."""


# How good a surface is, on points of its own that no step has seen.


@dataclass(frozen=True)
class Measurement:
    """A surface at a step.

    Parameters
    ----------
    step : its number; 0 is the start
    seconds : since the run began, measuring included
    loss : at fresh points, with the terms' reported weights; infinite where there is no surface
    shares : of the loss, by the terms' names
    chamfer : root mean square distance from the known solution to the surface, by projection: the paper's figure
    chamfer_back : that from the surface to the solution
    """

    step: int
    seconds: float
    loss: float
    shares: dict[str, float]
    chamfer: float | None
    chamfer_back: float | None

    def as_dict(self) -> dict[str, Any]:
        """All of it by name."""
        return asdict(self)


def measure(problem: ShapeProblem, theta: Tensor, step: int, seconds: float, seed: int) -> Measurement:
    """Measure the surface of parameters theta, of shape (p,); the points depend on the seed alone."""
    chamfer = None
    if problem.known is not None:
        chamfer = chamfer_divergence(problem.level_set(theta), problem.known, np.random.default_rng(seed))
    shares = _shares(problem, theta, seed)
    return Measurement(
        step,
        seconds,
        sum(shares.values()) if shares else float("inf"),
        shares,
        None if chamfer is None else chamfer.from_known,
        None if chamfer is None else chamfer.to_known,
    )


def _shares(problem: ShapeProblem, theta: Tensor, seed: int) -> dict[str, float]:
    """Return the loss by terms with their last weights, or nothing where there is no surface."""
    rng = np.random.default_rng(seed)
    total: dict[str, float] = {}
    try:
        for _ in range(DRAWS):
            for name, share in problem.freeze(LAST, theta, rng).shares(theta).items():
                total[name] = total.get(name, 0.0) + share / DRAWS
    except FitError:
        return {}
    return total
