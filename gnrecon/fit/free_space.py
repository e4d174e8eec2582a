"""Samples of free space around the data of one cube, and what they ask of its correction.

Far from the data a field is to be about the coarse distance. Nearer to it, down to where points no longer tell the side
by the winding number, it must at least keep that sign: without such samples, points that contradict each other, as in
a narrow crease, pull the correction so far beyond the surface that a wart grows next to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
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
    tree, disks : of all points: a k-d tree, and the radius of the disk of each of its points
    dipoles : of all points
    network, theta : the global field in unit coordinates
    rng : draws the samples
    parameters : FreeSpaceParameters
    signed_by : returns other signed distances than the coarse ones, for places and these, where a penalty fills holes
    """

    center: Float
    reach: float
    box: Box
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

    def near(self, length: float, noise: float) -> Volume:
        """Return samples all over the space about the data where the sign is certain, one in each cell of a lattice.

        Samples drawn at random would miss most warts, which are no larger than the length of the features.

        Parameters
        ----------
        length : of the correction's features, over which it fades
        noise : standard deviation of the points' positions
        """
        limits = self.parameters
        count = math.ceil(2 * self.reach / (limits.near_step_lengths * length))
        cells = np.stack(np.meshgrid(*3 * [np.arange(count)], indexing="ij"), axis=-1).reshape(-1, 3)
        x = self.center + self.reach * (2.0 * (cells + self.rng.random(cells.shape)) / count - 1.0)
        clear = limits.near_clearance_noises * noise
        most = limits.near_reach_lengths * length + clear
        return self._volume(x, limits.near_clearance_disk_radii, clear, most)

    @cached_property
    def _seen_dipoles(self) -> tuple[Float, Float, Float]:
        """Dipoles, seen from the centre: distances to those near by keep their digits in single precision."""
        places, moments, radii = self.dipoles.dipoles_for(self.center, self.reach)
        return places - self.center, moments, radii

    def _volume(self, x: Float, clear_disks: float, clear: float, most: float | None = None) -> Volume:
        """Return the samples that are far enough from the data: by so many radii of its disks, plus a length.

        With `most`, the largest distance, those alone of which the sign is certain; bounds are all that is known there.
        """
        near = most is not None
        x = x[((x > self.box.lower) & (x < self.box.upper)).all(axis=1)]
        distance, nearest = self.tree.query(x, distance_upper_bound=most if near else np.inf)
        # A place with no point within that distance has a row beyond the last.
        found = np.isfinite(distance)
        x, distance, disks = x[found], distance[found], self.disks[nearest[found]]
        kept = distance > clear_disks * disks + clear
        x, distance, disks = x[kept], distance[kept], disks[kept]
        winding = winding_number(x - self.center, *self._seen_dipoles, dtype=torch.float32)
        winding = self.dipoles.sides.centred(winding, distance)
        certain = is_sign_certain(winding)
        if near:
            x, distance, disks, winding = (values[certain] for values in (x, distance, disks, winding))
            certain = certain[certain]
        # A surface seen through points is nearer than these: see `gnrecon.geometry.signed_distance`.
        signed = sign_of_winding(winding) * np.sqrt(distance**2 - disks**2)
        if self.signed_by is not None:
            signed = self.signed_by(x, signed)
        # A bound is wide, so that single precision is enough for the field.
        theta = self.theta.float() if near else self.theta
        value = self.network.value(theta, torch.as_tensor(x).to(theta)).double().cpu().numpy()
        share = self.parameters.near_bound_share if near else self.parameters.sign_bound_share
        parameters = replace(self.parameters, sign_bound_share=share)
        return Volume.around(x, value, signed, certain, distance, parameters=parameters)
