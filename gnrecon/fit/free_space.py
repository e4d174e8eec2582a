"""Samples of free space around the data of one cube, and what they ask of its correction.

Far from the data a field is to be about the coarse distance. Nearer to it, down to where points no longer tell the side
by the winding number, it must at least keep that sign: without such samples, points that contradict each other, as in
a narrow crease, pull the correction so far beyond the surface that a wart grows next to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.parameters import FreeSpaceParameters
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import Box, is_sign_certain, sign_of_winding, winding_number


@dataclass(frozen=True)
class Volume:
    """Samples of space, of shape (Q, 3), where a correction is known roughly; the rest of shape (Q,).

    Parameters
    ----------
    wanted : target of the correction
    lower, upper : what it must be at least, and at most
    zero : what makes the corrected field vanish
    distance : how far the data is
    """

    points: Float
    wanted: Float
    lower: Float
    upper: Float
    zero: Float
    distance: Float

    @classmethod
    def around(
        cls,
        points: Float,
        own: Float,
        signed: Float,
        certain: Mask,
        distance: Float,
        *,
        parameters: FreeSpaceParameters = FreeSpaceParameters(),
    ) -> Volume:
        """Return samples at which a field is to be about the coarse distance, and of its sign where that is certain.

        A field that is somewhat steeper or flatter than a distance needs no correction; forcing it to the distance
        would overshoot between samples. Nor does one of the other sign where the sign is uncertain, as in a cavity of
        which little was scanned: the smooth field closes it no worse.

        Parameters
        ----------
        points : array of shape (Q, 3)
        own, signed : arrays of shape (Q,), the field, and the coarse distance
        certain : mask of shape (Q,), where the sign of that is certain
        distance : array of shape (Q,), of the data
        """
        near, far = parameters.least_field_share * signed, parameters.most_field_share * signed
        agreed = certain | (own * signed > 0)
        wanted = np.where(agreed, own.clip(np.minimum(near, far), np.maximum(near, far)) - own, 0.0)
        bound = parameters.sign_bound_share * signed - own
        lower = np.where(certain & (signed > 0), bound, -np.inf)
        upper = np.where(certain & (signed < 0), bound, np.inf)
        return cls(points, wanted, lower, upper, -own, distance)

    @classmethod
    def none(cls) -> Volume:
        """Return no samples."""
        return cls(np.zeros((0, 3)), *np.zeros((5, 0)))

    def rows(self) -> tuple[Float, Float, Float, Float, Float, Float]:
        """Return all six arrays."""
        return self.points, self.wanted, self.lower, self.upper, self.zero, self.distance


@dataclass(frozen=True)
class CubeSpace:
    """The space of one cube, of which samples are drawn.

    Parameters
    ----------
    center, reach : of the cube, reach being half of its edge, unit coordinates
    box : where the field is fitted
    points : of the cube and its margin, of shape (N, 3)
    tree, disks : of these and of all around them: a k-d tree, and the radius of the disk of each of its points
    dipoles : of all points
    network, theta : the global field in unit coordinates
    rng : draws the samples
    parameters : FreeSpaceParameters
    signed_by : returns other signed distances than the coarse ones, for places and these, where a penalty fills holes
    """

    center: Float
    reach: float
    box: Box
    points: Float
    tree: Any
    disks: Float
    dipoles: DipoleTree
    network: Siren
    theta: Tensor
    rng: np.random.Generator
    parameters: FreeSpaceParameters = FreeSpaceParameters()
    signed_by: Callable[[Float, Float], Float] | None = None

    def far(self) -> Volume:
        """Return samples of the whole cube that lie clear of the data."""
        x = self.center + self.reach * self.rng.uniform(-1.0, 1.0, (self.parameters.volume_samples, 3))
        return self._volume(x, self.parameters.clearance_disk_radii, 0.0)

    def near(self, spread: float, noise: float) -> Volume:
        """Return samples about the data at which the sign is certain.

        Parameters
        ----------
        spread : standard deviation of the samples from a point: the length over which the correction fades
        noise : standard deviation of the points' positions
        """
        limits, count = self.parameters, self.parameters.near_samples
        some = self.points[self.rng.integers(len(self.points), size=count)]
        x = some + spread * self.rng.standard_normal((count, 3))
        x = x[(np.abs(x - self.center) < self.reach).all(axis=1)]
        found = self._volume(x, limits.near_clearance_disk_radii, limits.near_clearance_noises * noise)
        bound = np.isfinite(found.lower) | np.isfinite(found.upper)
        return Volume(*(rows[bound] for rows in found.rows()))

    @cached_property
    def _seen_dipoles(self) -> tuple[Float, Float, Float]:
        """Dipoles, seen from the centre: distances to those near by keep their digits in single precision."""
        places, moments, radii = self.dipoles.dipoles_for(self.center, self.reach)
        return places - self.center, moments, radii

    def _volume(self, x: Float, clear_disks: float, clear: float) -> Volume:
        """Return the samples that are far enough from the data: by so many radii of its disks, plus a length."""
        x = x[((x > self.box.lower) & (x < self.box.upper)).all(axis=1)]
        distance, nearest = self.tree.query(x)
        disks = self.disks[nearest]
        kept = distance > clear_disks * disks + clear
        x, distance, disks = x[kept], distance[kept], disks[kept]
        winding = winding_number(x - self.center, *self._seen_dipoles, dtype=torch.float32)
        winding = self.dipoles.sides.centred(winding, distance)
        # A surface seen through points is nearer than these: see `gnrecon.geometry.signed_distance`.
        signed = sign_of_winding(winding) * np.sqrt(distance**2 - disks**2)
        if self.signed_by is not None:
            signed = self.signed_by(x, signed)
        value = self.network.value(self.theta, torch.as_tensor(x).to(self.theta)).double().cpu().numpy()
        return Volume.around(x, value, signed, is_sign_certain(winding), distance, parameters=self.parameters)
