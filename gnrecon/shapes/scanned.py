"""The paper's reconstruction of a scan as a problem of shape learning, so that its optimisers can be compared on it.

Its terms are f = 0 and n . grad f = 1 at the points, both of weight one, and the eikonal constraint in the box around
them; the network has 3 x 32 sine units. The eikonal weight falls from the paper's 1e-2 to a hundredth of that within
some thirteen steps, because it stands against the data, and the loss that is reported is that of points and normals,
which the paper's figures are. The paper begins with a sphere; here it is the cloud's own coarse signed distance
(`sampling`), on features of more than one wavelength, so that there is no plateau.

For a product's sake use `gnrecon.reconstruct`: it fits more finely, and holds the free space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.cloud import Samples
from gnrecon.field import Network
from gnrecon.field.activation import SINE
from gnrecon.linalg import Auto, layer_scaled
from gnrecon.optim import GainRatioDamping
from gnrecon.residuals import eikonal, interface, normal_projection
from gnrecon.sampling import Box, CoarseDistance
from gnrecon.shapes.problem import ShapeProblem, Start
from gnrecon.shapes.term import Term, at_points, growing, in_box

NETWORK = Network((32, 32, 32), SINE, (8.0,))
"""The paper's, with frequencies of the first layer that begin larger."""

POINTS, IN_BOX = growing(1500, 1.25, 8000), 1000
"""Points of each term at each step, and those in the box."""

ENERGY = 0.3
"""Error at which conjugate gradients stop, where there are so many rows that they solve for the steps."""

MARGIN = 0.2
"""The paper's: how far the box reaches beyond the scan, in radii."""

EIKONAL, FALL, LEAST = 1e-2, 0.7, 1e-4
"""Weight of the eikonal term to begin with, its factor from step to step, and the least."""


@dataclass(frozen=True)
class ScannedSurface:
    """A surface of which points are known, as what a level set is measured against.

    Parameters
    ----------
    points : of shape (N, 3)
    """

    points: Tensor

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return about `count` of the points, of shape (M, 3), and the share of each, 1 / M, of shape (M,)."""
        chosen = self.points[:: -(-len(self.points) // count)]
        return chosen, torch.full_like(chosen[:, 0], 1 / len(chosen))

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), to queries, (N, 3), all of which count."""
        rows = cKDTree(self.points.numpy()).query(queries.numpy())[1]
        return self.points[torch.as_tensor(rows)], torch.ones(len(queries), dtype=torch.bool)


def scanned(samples: Samples, all_points: Samples | None = None, name: str = "scan", seed: int = 0) -> ShapeProblem:
    """Return the problem of a surface through points with normals.

    Parameters
    ----------
    samples : what the surface is learned from, in the unit ball
    all_points : what it is measured against, in the same frame, by default `samples`
    name : of the problem
    seed : of the coarse distance
    """
    normals = samples.normals
    terms = (
        Term("interface", interface, at_points(samples.points, count=POINTS)),
        Term("normal", normal_projection, at_points(samples.points, normals, count=POINTS)),
        Term("eikonal", eikonal, in_box(IN_BOX), lambda step: max(EIKONAL * FALL ** min(step, 100), LEAST), 0.0),
    )
    known = ScannedSurface(torch.as_tensor((all_points or samples).points))
    search = GainRatioDamping(initial_damping=1e-2, metric=layer_scaled, geodesic=True)
    box = Box.around(samples.points, MARGIN)
    return ShapeProblem(
        name,
        terms,
        box,
        _coarse(samples, seed),
        NETWORK,
        known,
        search=search,
        solver=lambda: Auto(ENERGY),
        stored=torch.float32,
    )


def _coarse(samples: Samples, seed: int) -> Start:
    """Return the coarse signed distance to a cloud, zero where it is too near to be known."""
    coarse = CoarseDistance(samples.points, samples.normals, np.random.default_rng(seed))

    def start(x: Tensor) -> Tensor:
        known, signed, _ = coarse.at(x.numpy())
        values = np.zeros(len(x))
        values[known] = signed
        return torch.as_tensor(values)

    return start
