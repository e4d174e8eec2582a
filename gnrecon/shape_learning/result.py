"""A learned field, its mesh in a box, and measurements of its loss and error at fresh points."""

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
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import ShapeProblem


@dataclass(frozen=True)
class LearnedField:
    """A network's values as a field in its own coordinates; approximately a distance if the terms require it.

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


def mesh_of(field: LearnedField, shown: Box, resolution: int, *, margin_cells: int = 2) -> Mesh:
    """Return the mesh of a field's zero level in a box, with normals; it is open where it leaves the box.

    Parameters
    ----------
    resolution : cells along the longest side of the box
    margin_cells : cells around the box that are meshed too, so that the cap that closes the mesh is cut off

    Raises
    ------
    MeshError
        When there is no zero level in the box.
    """
    sides = shown.upper - shown.lower
    cell = float(sides.max() / resolution)
    # Whole cells, so that the planes of the box are planes of the lattice if its sides allow it.
    cells = np.ceil(sides / cell - 1e-9)
    grow = (cells * cell - sides) / 2 + margin_cells * cell
    outer = np.stack([shown.lower - grow, shown.upper + grow])
    whole = extract(field, resolution=int(cells.max()) + 2 * margin_cells, bounds=outer)
    mesh = clip_to_box(whole, np.stack([shown.lower, shown.upper]))
    if not len(mesh.faces):
        raise MeshError("The field has no zero level in the box, so there is no surface to mesh.")
    return project(mesh, field)


@dataclass(frozen=True)
class Measurement:
    """A surface at a step.

    Parameters
    ----------
    step : its number; 0 is the start
    seconds : since the run began, measuring included
    loss : at fresh points, with the terms' reported weights; infinite where there is no surface
    shares : of the loss, by the terms' names
    chamfer : root mean square distance from the known solution to the surface, by projection, as in the paper
    chamfer_back : the same from the surface to the solution
    """

    step: int
    seconds: float
    loss: float
    shares: dict[str, float]
    chamfer: float | None
    chamfer_back: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return all fields by name."""
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


def _shares(problem: ShapeProblem, theta: Tensor, seed: int, *, draws: int = 2) -> dict[str, float]:
    """Return the loss of each term with its last weight, or nothing if there is no surface.

    The loss is the mean over `draws` samples of points.
    """
    step = ShapeLearningParameters.measurement_step
    rng = np.random.default_rng(seed)
    total: dict[str, float] = {}
    try:
        for _ in range(draws):
            for name, share in problem.freeze(step, theta, rng).shares(theta).items():
                total[name] = total.get(name, 0.0) + share / draws
    except FitError:
        return {}
    return total
