"""Samples of free space around the data of one cube, and what they ask of its correction.

Far from the data a field is to be about the coarse distance. Nearer to it, down to where points no longer tell the side
by the winding number, it must at least keep that sign: without such samples, points that contradict each other, as in
a narrow crease, pull the correction so far beyond the surface that a wart grows next to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail
from gnrecon.field.random_features import Features
from gnrecon.fit.parameters import FreeSpaceParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import Box, film_distance, is_sign_certain, sign_of_winding, winding_number


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
        winding: Float,
        distance: Float,
        bound_share: float = FreeSpaceParameters.sign_bound_share,
        *,
        parameters: FreeSpaceParameters = FreeSpaceParameters(),
    ) -> Volume:
        """Return samples at which a field is to be about the coarse distance, and of its sign where that is certain.

        A field that is somewhat steeper or flatter than a distance needs no correction; forcing it to the distance
        would overshoot between samples. Nor does one of the other sign where the sign is uncertain, as in a cavity of
        which little was scanned: the smooth field closes it no worse. Above a hole the least distance is that of the
        film, see `film_distance`.

        Parameters
        ----------
        points : array of shape (Q, 3)
        own, signed : arrays of shape (Q,), the field, and the coarse distance
        winding : array of shape (Q,), the winding number w
        distance : array of shape (Q,), of the data
        bound_share : of the coarse distance, that the field must keep where the sign is certain
        """
        certain, film = is_sign_certain(winding), film_distance(signed, winding)
        near, far = parameters.least_field_share * film, parameters.most_field_share * signed
        agreed = certain | (own * signed > 0)
        wanted = np.where(agreed, own.clip(np.minimum(near, far), np.maximum(near, far)) - own, 0.0)
        bound = bound_share * film - own
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
class CubeLattice:
    """The nodes of a cubic lattice in a cube, in blocks: at `offsets`, of shape (K, 3), from `corners`, (C, 3).

    Corners are relative to the cube's centre. A sum of sines at all nodes takes the sines of corners and offsets alone,
    see `Stencil`.
    """

    center: Float
    corners: Float
    offsets: Float

    @classmethod
    def of(cls, center: Float, reach: float, step: float, shift: Float, *, block: int = 4) -> CubeLattice:
        """Return nodes at most `step` apart, in a cube of half an edge `reach`; `shift`, of shape (3,), is in steps."""
        blocks = math.ceil(2 * reach / step / block)
        step = 2 * reach / (blocks * block)
        corners, offsets = (
            np.stack(np.meshgrid(*3 * [np.arange(float(count))], indexing="ij"), axis=-1).reshape(-1, 3)
            for count in (blocks, block)
        )
        return cls(center, step * (block * corners + shift) - reach, step * offsets)

    def nodes(self) -> Float:
        """Return all nodes, of shape (C K, 3), block by block."""
        return self.center + (self.corners[:, None] + self.offsets).reshape(-1, 3)


@dataclass(frozen=True)
class LatticeVolume:
    """Samples at some nodes of a lattice, of shape (Q,) as rows of `nodes`."""

    volume: Volume
    lattice: CubeLattice
    rows: Int

    def sums(self, features: Features, length: float) -> Callable[[Tensor], Tensor]:
        """Return the function from amplitudes, (m,), to sums of features of a length about the centre, (Q,)."""
        stencil = features.stencil(self.lattice.offsets / length)
        corners = torch.as_tensor(self.lattice.corners, device=features.phases.device)
        phases = features.phase(corners, torch.zeros_like(corners[0]), length)
        rows = torch.as_tensor(self.rows, device=phases.device)
        return lambda amplitudes: stencil.sums(phases, amplitudes.to(phases)).flatten()[rows]


class _Samples(NamedTuple):
    """Places, of shape (Q, 3), their rows, the nearest point's distance, its disk's radius, and the winding number."""

    rows: Int
    places: Float
    distance: Float
    disks: Float
    winding: Float

    def take(self, some: Mask) -> _Samples:
        """Return some of the samples."""
        rows, *values = self
        return _Samples(rows[some], *(value[some] for value in values))


@dataclass(frozen=True)
class CubeSpace:
    """The space of one cube, of which samples are drawn.

    Parameters
    ----------
    center, reach : of the cube, reach being half of its edge, unit coordinates
    box : where the field is fitted
    tree, disks : of the points in and around the cube, or of all: a k-d tree, and the radius of the disk of each
    dipoles : of all points
    network, theta : the global field in unit coordinates
    rng : draws the samples
    coarser : local fields that are added to the global one, if there are some
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
    coarser: Detail | None = None
    parameters: FreeSpaceParameters = FreeSpaceParameters()
    signed_by: Callable[[Float, Float], Float] | None = None

    def far(self) -> Volume:
        """Return samples of the whole cube that lie clear of the data."""
        limits = self.parameters
        x = self.center + self.reach * self.rng.uniform(-1.0, 1.0, (limits.volume_samples, 3))
        samples = self._clear(x, limits.clearance_disk_radii, 0.0)
        own = self.network.value(self.theta, torch.as_tensor(samples.places).to(self.theta))
        return self._volume(samples, own, limits.sign_bound_share)

    def near(self, length: float, noise: float) -> LatticeVolume:
        """Return samples all over the space about the data where the sign is certain, at the nodes of a lattice.

        Samples drawn at random would miss most warts, which are no larger than the length of the features.

        Parameters
        ----------
        length : of the correction's features, over which it fades
        noise : standard deviation of the points' positions
        """
        limits = self.parameters
        lattice = CubeLattice.of(self.center, self.reach, limits.near_step_lengths * length, self.rng.random(3))
        clear = limits.near_clearance_noises * noise
        most = limits.near_reach_lengths * length + clear
        samples = self._clear(lattice.nodes(), limits.near_clearance_disk_radii, clear, most)
        certain = samples.take(is_sign_certain(samples.winding))
        # Bounds are wide, so that single precision is enough for the field.
        theta = self.theta.float()
        corners, offsets = (torch.as_tensor(x).to(theta) for x in (self.center + lattice.corners, lattice.offsets))
        own = self.network.around(theta, offsets)(corners).flatten()[certain.rows]
        return LatticeVolume(self._volume(certain, own, limits.near_bound_share), lattice, certain.rows)

    @cached_property
    def _seen_dipoles(self) -> tuple[Float, Float, Float]:
        """Dipoles, seen from the centre: distances to those near by keep their digits in single precision."""
        places, moments, radii = self.dipoles.dipoles_for(self.center, self.reach)
        return places - self.center, moments, radii

    def _clear(self, x: Float, clear_disks: float, clear: float, most: float = np.inf) -> _Samples:
        """Return those of the places, of shape (Q, 3), that are far enough from the data, and nearer to it than `most`.

        Far enough is so many radii of the data's disks, plus a length.
        """
        rows = np.flatnonzero(((x > self.box.lower) & (x < self.box.upper)).all(axis=1))
        distance, nearest = self.tree.query(x[rows], distance_upper_bound=most)
        # A place with no point within that distance has a row beyond the last.
        found = np.isfinite(distance)
        rows, distance, disks = rows[found], distance[found], self.disks[nearest[found]]
        kept = distance > clear_disks * disks + clear
        rows, distance, disks = rows[kept], distance[kept], disks[kept]
        winding = winding_number(x[rows] - self.center, *self._seen_dipoles, dtype=torch.float32)
        return _Samples(rows, x[rows], distance, disks, self.dipoles.sides.centred(winding, distance))

    def _volume(self, samples: _Samples, own: Tensor, bound_share: float) -> Volume:
        """Return what is known at the samples, where the global field is `own`, of shape (Q,)."""
        _, x, distance, disks, winding = samples
        # A surface seen through points is nearer than these: see `gnrecon.geometry.signed_distance`.
        signed = sign_of_winding(winding) * np.sqrt(distance**2 - disks**2)
        if self.signed_by is not None:
            signed = self.signed_by(x, signed)
        value = own.double().cpu().numpy()
        if self.coarser is not None:
            value += self.coarser.value(x)
        return Volume.around(x, value, signed, winding, distance, bound_share, parameters=self.parameters)
