"""Points of a fitted field's surface, and how far each is from the scan, as in its holes.

Distances count in radii of the disk that the nearest scanned point stands for. On points thrown evenly at random onto a
surface, one in fifty of its places is 2 radii from all of them, and five in a million are 3.5 radii away. What lies
between counts in part, so that nothing is left without a say at a hole's rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.fit.sdf import NeuralSDF
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.signed_distance import Density
from gnrecon.level_set import LevelSet, sample_surface

NEAR, FAR = 2.0, 3.5
"""Where far begins to count, and where it counts fully."""

LEAST, MOST = 1000, 30_000
"""Fewest and most points."""

NODES = 30_000

JOINED = 3.0
"""Mean distances between points within which two of them belong to one sheet."""


@dataclass(frozen=True)
class Sheet:
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
    def of(cls, sdf: NeuralSDF, density: Density, spacing: float, rng: np.random.Generator) -> Sheet:
        """Draw points of a field's zero level about `spacing` apart, in radii; none where there is no surface.

        Sheets on which no point is near the scan are no part of the shape, and are left out.
        """
        scanned = float(np.pi * np.square(density.disks).sum())
        count = int(np.clip(scanned / spacing**2, LEAST, MOST))
        points = sample_surface(_level_set(sdf), count, rng, NODES, sweeps=0).points.cpu().numpy()
        distance, nearest = density.tree.query(points)
        far = np.clip((distance / density.disks[nearest] - NEAR) / (FAR - NEAR), 0.0, 1.0)
        kept = _joined(points, far == 0.0, JOINED * np.sqrt(scanned / count))
        return cls(points[kept], far[kept])

    def told(self, x: Float, signed: Float, value: Float, density: Density) -> Float:
        """Return coarse signed distances, with those to the far part where it is nearer than all scanned points.

        Parameters
        ----------
        x : points of the volume, of shape (Q, 3)
        signed : what their coarse distances are, of shape (Q,)
        value : of the field there, whose sign tells the far part's sides, of shape (Q,)
        density : of the scanned points
        """
        film = self.points[self.far == 1.0]
        if not len(film):
            return signed
        distance = cKDTree(film).query(x)[0]
        told: Float = np.where(distance < density.tree.query(x)[0], np.sign(value) * distance, signed)
        return told


def _joined(points: Float, near: Mask, reach: float) -> Mask:
    """Return which points, of shape (N, 3), lead to a near one in leaps of at most `reach`."""
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
