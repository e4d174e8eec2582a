"""The fitted field, answering in the file's own frame and units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
from gnrecon.runtime.parallel import abreast, slices

_BATCH_BYTES = 4_000_000
# What stays in the processor's cache is twice as fast as what does not.


@dataclass(frozen=True)
class NeuralSDF:
    """A signed distance field: negative inside, in file units.

    Parameters
    ----------
    field : Siren
    theta : parameters of shape (p,), of the field in unit coordinates
    frame : the similarity from unit to file coordinates
    box : where the field was fitted, in unit coordinates
    options : what the fit was asked to do, as plain values
    support : points that the field was fitted to, of shape (N, 3), unit coordinates; where there were many, some of
        them; None where they are not known
    detail : what is added to the network near the data of a dense scan, unit coordinates
    """

    field: Siren
    theta: Tensor
    frame: Frame
    box: Box
    options: Mapping[str, Any] = dataclass_field(default_factory=dict)
    support: npt.NDArray[np.float32] | None = None
    detail: Detail | None = None

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Write the field to one file, conventionally `.gnr`, see `gnrecon.fit.model_file`."""
        from gnrecon.fit.model_file import save_sdf

        save_sdf(self, path, overwrite)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> NeuralSDF:
        """Read a field from a file that `save` wrote."""
        from gnrecon.fit.model_file import load_sdf

        return load_sdf(path, device)

    def single(self) -> NeuralSDF:
        """Return the same field in single precision: several times as fast; good to about 1e-3 of the radius."""
        detail = None if self.detail is None else self.detail.to(torch.float32)
        return replace(self, theta=self.theta.to(torch.float32), detail=detail)

    def coarse(self) -> NeuralSDF:
        """Return the network alone, without detail."""
        return replace(self, detail=None)

    @property
    def finite(self) -> bool:
        """Whether all parameters that were fitted are finite."""
        parts = [self.theta] if self.detail is None else [self.theta, self.detail.amplitudes]
        return all(bool(torch.isfinite(values).all()) for values in parts)

    @property
    def parameters(self) -> int:
        """Number of parameters, those of the detail included."""
        return len(self.theta) + (0 if self.detail is None else self.detail.count)

    @property
    def bounds(self) -> Float:
        """Lower and upper corner of the box within which the field may be trusted, of shape (2, 3), file units."""
        return self.frame.to_world(np.stack([self.box.lower, self.box.upper]))

    @property
    def data(self) -> Float | None:
        """The points that support the field, of shape (N, 3), file units, to about 1e-7 of the radius."""
        return None if self.support is None else self.frame.to_world(self.support.astype(np.float64))

    def sdf(self, points: npt.ArrayLike) -> Float:
        """Return signed distances, of shape (N,), at `points`, of shape (N, 3), all in file units."""
        x = self._unit(points)
        # Written in place: results kept apart would lie between the batches' large arrays, and hold their memory.
        values = np.empty(len(x))

        def fill(rows: slice) -> None:
            values[rows] = self.field.value(self.theta, self._tensor(x[rows])).cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            values += self.detail.value(x)
        return self.frame.scale * values

    def sdf_around(self, centers: npt.ArrayLike, offsets: npt.ArrayLike) -> Float:
        """Return signed distances, of shape (N, K), at K offsets from each of N centres, all in file units.

        Where there are many centres, this is many times as fast as `sdf` at the same points.

        Parameters
        ----------
        centers : array of shape (N, 3)
        offsets : array of shape (K, 3)
        """
        x = self._unit(centers)
        apart = np.asarray(offsets, dtype=np.float64).reshape(-1, 3) / self.frame.scale
        values = np.empty((len(x), len(apart)))
        around = self.field.around(self.theta, self._tensor(apart))

        def fill(rows: slice) -> None:
            values[rows] = around(self._tensor(x[rows])).cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            values += self.detail.value_around(x, apart)
        return self.frame.scale * values

    def gradient(self, points: npt.ArrayLike) -> Float:
        """Return the gradient of the distance, of shape (N, 3), at `points`, of shape (N, 3); it has no unit."""
        return self.sdf_and_gradient(points)[1]

    def sdf_and_gradient(self, points: npt.ArrayLike) -> tuple[Float, Float]:
        """Return distances and gradients at once, as `sdf` and `gradient` do, at `points`, of shape (N, 3)."""
        x = self._unit(points)
        # The frame's scale enters value and coordinate alike and cancels in the gradient.
        values, gradients = np.empty(len(x)), np.empty((len(x), 3))

        def fill(rows: slice) -> None:
            value, gradient = self.field.value_and_gradient(self.theta, self._tensor(x[rows]))
            values[rows], gradients[rows] = value.cpu().numpy(), gradient.cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            more = self.detail.value_and_gradient(x)
            values, gradients = values + more[0], gradients + more[1]
        return self.frame.scale * values, gradients

    def hessian(self, points: npt.ArrayLike) -> Float:
        """Return second derivatives of the distance, of shape (N, 3, 3), per file unit, at `points`, of shape (N, 3).

        They are evaluated in double precision, whatever the field's own.
        """
        x = self._unit(points)
        theta = self.theta.to(torch.float64)
        hessians = np.empty((len(x), 3, 3))

        def fill(rows: slice) -> None:
            hessians[rows] = self.field.jet(theta, torch.as_tensor(x[rows]).to(theta)).hessian().cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            hessians += self.detail.to(torch.float64).hessian(x)
        return hessians / self.frame.scale

    def normals(self, points: npt.ArrayLike) -> Float:
        """Return outward unit normals of the level sets, of shape (N, 3), at `points`, of shape (N, 3)."""
        gradient = self.gradient(points)
        lengths = np.linalg.norm(gradient, axis=1, keepdims=True)
        unit: Float = gradient / np.maximum(lengths, np.finfo(np.float64).tiny)
        return unit

    def _unit(self, points: npt.ArrayLike) -> Float:
        return self.frame.to_unit(np.asarray(points, dtype=np.float64).reshape(-1, 3))

    def _tensor(self, x: Float) -> Tensor:
        return torch.as_tensor(x).to(self.theta)

    def _each_batch(self, fill: Callable[[slice], None], count: int) -> None:
        """Have `count` rows filled, so many at a time as the cache holds."""
        size = max(256, _BATCH_BYTES // (8 * max(self.field.widths)))
        abreast(fill, slices(count, size), self.theta.device)
