"""Level sets with known geometry: each with its gradient, its distance, and the area of parts of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set import LevelSet


def cube(half: float) -> Box:
    return Box(np.full(3, -half), np.full(3, half))


def level_set(function: Callable[[Tensor], Tensor], box: Box) -> LevelSet:
    """The level set of any torch function, its gradient by autograd."""

    def value_and_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            value = function(leaf)
            (gradient,) = torch.autograd.grad(value.sum(), leaf)
        return value.detach(), gradient

    return LevelSet(function, value_and_gradient, box)


@dataclass(frozen=True)
class Shape:
    """A level set with an oracle.

    Parameters
    ----------
    level_set : LevelSet
    area : of the surface within the box
    distance : of points, (N, 3), from the surface, (N,)
    bins : the number of the part of the surface that each point belongs to, (N,)
    shares : of the area, for each part; they sum to one
    """

    level_set: LevelSet
    area: float
    distance: Callable[[Tensor], Tensor]
    bins: Callable[[Tensor], Tensor]
    shares: np.ndarray


def _cells(*parts: tuple[Tensor, float, float, int]) -> Tensor:
    """The number of the cell of a regular grid, from (coordinate, lowest, highest, cells) of each direction."""
    number = torch.zeros_like(parts[0][0], dtype=torch.int64)
    for value, low, high, count in parts:
        number = number * count + ((value - low) / (high - low) * count).long().clamp(0, count - 1)
    return number


def sphere(radius: float = 0.8) -> Shape:
    def norm(x: Tensor) -> Tensor:
        return torch.linalg.vector_norm(x, dim=1)

    # Not a distance: its gradient grows with the radius.
    return Shape(
        level_set(lambda x: 3 * (norm(x) ** 2 - radius**2), cube(1.0)),
        4 * np.pi * radius**2,
        lambda x: (norm(x) - radius).abs(),
        # Archimedes: equal heights have equal areas.
        lambda x: _cells((x[:, 2], -radius, radius, 6), (torch.atan2(x[:, 1], x[:, 0]), -np.pi, np.pi, 8)),
        np.full(48, 1 / 48),
    )


def torus(major: float = 0.6, minor: float = 0.25) -> Shape:
    def tube(x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.hypot(x[:, 0], x[:, 1]) - major, x[:, 2]

    def distance(x: Tensor) -> Tensor:
        return torch.hypot(*tube(x)) - minor

    def bins(x: Tensor) -> Tensor:
        across, up = tube(x)
        return _cells((torch.atan2(x[:, 1], x[:, 0]), -np.pi, np.pi, 6), (torch.atan2(up, across), -np.pi, np.pi, 8))

    ends = np.linspace(-np.pi, np.pi, 9)
    rings = major * np.diff(ends) + minor * np.diff(np.sin(ends))
    return Shape(
        level_set(distance, cube(1.0)),
        4 * np.pi**2 * major * minor,
        lambda x: distance(x).abs(),
        bins,
        np.tile(rings / rings.sum(), 6) / 6,
    )


def plane() -> Shape:
    """A tilted plane: the part of x + z / 2 = 0.1 in a box that cuts only two of its sides."""
    normal = torch.tensor([2.0, 0.0, 1.0], dtype=torch.float64) / 5**0.5

    def height(x: Tensor) -> Tensor:
        return x @ normal - 0.2 / 5**0.5

    return Shape(
        level_set(height, cube(1.0)),
        2 * 5**0.5,
        lambda x: height(x).abs(),
        lambda x: _cells((x[:, 1], -1, 1, 6), (x[:, 2], -1, 1, 8)),
        np.full(48, 1 / 48),
    )


def saddle() -> Shape:
    """z = x^2 - y^2 over the unit square, by a fine sum of its area; the distance is bounded by the height."""
    fine = (np.arange(480) + 0.5) / 240 - 1
    x, y = np.meshgrid(fine, fine, indexing="ij")
    areas = np.sqrt(1 + 4 * x**2 + 4 * y**2).reshape(6, 80, 8, 60).sum(axis=(1, 3)).ravel()
    return Shape(
        level_set(lambda p: p[:, 2] - p[:, 0] ** 2 + p[:, 1] ** 2, Box(np.full(3, -1.0), np.array([1.0, 1.0, 1.1]))),
        float(areas.sum()) / 240**2,
        lambda p: (p[:, 2] - p[:, 0] ** 2 + p[:, 1] ** 2).abs(),
        lambda p: _cells((p[:, 0], -1, 1, 6), (p[:, 1], -1, 1, 8)),
        areas / areas.sum(),
    )


def two_spheres() -> Shape:
    """Two spheres of different sizes, apart."""
    centers = torch.tensor([[-0.45, 0.0, 0.0], [0.6, 0.1, 0.2]], dtype=torch.float64)
    radii = torch.tensor([0.5, 0.2], dtype=torch.float64)

    def distance(x: Tensor) -> Tensor:
        return (torch.cdist(x, centers, compute_mode="donot_use_mm_for_euclid_dist") - radii).amin(1)

    def bins(x: Tensor) -> Tensor:
        which = (torch.cdist(x, centers) - radii).argmin(1)
        around = (x - centers[which]) / radii[which, None]
        return which * 24 + _cells(
            (around[:, 2], -1, 1, 4), (torch.atan2(around[:, 1], around[:, 0]), -np.pi, np.pi, 6)
        )

    squares = (radii**2 / (radii**2).sum()).numpy()
    return Shape(
        level_set(distance, cube(1.0)),
        float(4 * np.pi * (radii**2).sum()),
        lambda x: distance(x).abs(),
        bins,
        np.repeat(squares / 24, 24),
    )


SHAPES = {"sphere": sphere, "torus": torus, "plane": plane, "saddle": saddle, "two spheres": two_spheres}
