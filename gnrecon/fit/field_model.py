"""The fitted field in the frame and units of its file (`NeuralSDF`), and its model files (`save_sdf`, `load_sdf`)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.field.detail_tensors import detail_of, detail_tensors, plain_name
from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box, continued, continued_values
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.files import atomic_write
from gnrecon.runtime.parallel import map_in_threads
from gnrecon.version import __version__


@dataclass(frozen=True)
class NeuralSDF:
    """A signed distance field: negative inside, in file units.

    Parameters
    ----------
    field : Siren
    theta : parameters of shape (p,), of the field in unit coordinates
    frame : the similarity from unit to file coordinates
    box : where the field was fitted, in unit coordinates
    options : of the fit, as plain values
    support : points that the field was fitted to, of shape (N, 3), unit coordinates; where there were many, some of
        them; None where they are not known
    detail : the local fields of the default fit, added near the data, unit coordinates
    """

    field: Siren
    theta: Tensor
    frame: Frame
    box: Box
    options: Mapping[str, Any] = dataclass_field(default_factory=dict)
    support: npt.NDArray[np.float32] | None = None
    detail: Detail | None = None

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.4g}" for side in self.bounds[1] - self.bounds[0])
        return f"<NeuralSDF: {self.parameters:,} parameters, box of {size}>"

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Write the field to one file, conventionally `.gnr`, see `gnrecon.fit.field_model`."""
        from gnrecon.fit.field_model import save_sdf

        save_sdf(self, path, overwrite)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> NeuralSDF:
        """Read a field from a file that `save` wrote."""
        from gnrecon.fit.field_model import load_sdf

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
        levels = () if self.detail is None else self.detail.levels
        parts = [self.theta, *(level.amplitudes for level in levels)]
        return all(bool(torch.isfinite(values).all()) for values in parts)

    @property
    def parameters(self) -> int:
        """Number of parameters, those of the detail included."""
        return len(self.theta) + (0 if self.detail is None else self.detail.count)

    @property
    def bounds(self) -> Float:
        """Lower and upper corner of the box in which the field was fitted, of shape (2, 3), file units.

        All of the surface is within. Outside, a distance is that to the box and, from there, to the surface.
        """
        return self.frame.to_world(np.stack([self.box.lower, self.box.upper]))

    @property
    def data(self) -> Float | None:
        """The points that support the field, of shape (N, 3), file units, to about 1e-7 of the radius."""
        return None if self.support is None else self.frame.to_world(self.support.astype(np.float64))

    def sdf(self, points: npt.ArrayLike) -> Float:
        """Return signed distances, of shape (N,), at `points`, of shape (N, 3), all in file units."""
        x, beyond = self.box.nearest(self._unit(points))
        # Written in place: results kept apart would lie between the batches' large arrays, and hold their memory.
        values = np.empty(len(x))

        def fill(rows: slice) -> None:
            values[rows] = self.field.value(self.theta, self._tensor(x[rows])).cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            values += self.detail.value(x)
        return self.frame.scale * continued_values(values, beyond)

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
        values *= self.frame.scale
        # Only centres near the box's faces have offsets that may be outside.
        rows = np.flatnonzero(~self.box.holds(x, np.abs(apart).max(axis=0, initial=0.0)))
        if len(rows):
            places = self.frame.to_world((x[rows, None] + apart).reshape(-1, 3))
            values[rows] = self.sdf(places).reshape(-1, len(apart))
        return values

    def gradient(self, points: npt.ArrayLike) -> Float:
        """Return the gradient of the distance, of shape (N, 3), at `points`, of shape (N, 3); it has no unit."""
        return self.sdf_and_gradient(points)[1]

    def sdf_and_gradient(self, points: npt.ArrayLike) -> tuple[Float, Float]:
        """Return distances and gradients at once, as `sdf` and `gradient` do, at `points`, of shape (N, 3)."""
        unit = self._unit(points)
        x, beyond = self.box.nearest(unit)
        # The frame's scale enters value and coordinate alike and cancels in the gradient.
        values, gradients = np.empty(len(x)), np.empty((len(x), 3))

        def fill(rows: slice) -> None:
            value, gradient = self.field.value_and_gradient(self.theta, self._tensor(x[rows]))
            values[rows], gradients[rows] = value.cpu().numpy(), gradient.cpu().numpy()

        self._each_batch(fill, len(x))
        if self.detail is not None:
            more = self.detail.value_and_gradient(x)
            values, gradients = values + more[0], gradients + more[1]
        values, gradients = continued(values, gradients, unit - x, beyond)
        return self.frame.scale * values, gradients

    def hessian(self, points: npt.ArrayLike) -> Float:
        """Return second derivatives of the distance, of shape (N, 3, 3), per file unit, at `points`, of shape (N, 3).

        They are evaluated in double precision, whatever the field's own, and hold within `bounds` alone.
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

    def _each_batch(self, fill: Callable[[slice], None], count: int, *, batch_bytes: int = 4_000_000) -> None:
        """Fill `count` rows in batches whose activations stay in the processor's cache, which is twice as fast."""
        size = max(256, batch_bytes // (8 * max(self.field.widths)))
        map_in_threads(fill, slices(count, size), self.theta.device)


FORMAT = "gnrecon-sdf-1"


# A model file (`.gnr`) is one safetensors file with parameters, frame, box, options and some of the data, without code
# or pickle. Files without data, as earlier versions wrote them, are read too.


def save_sdf(sdf: NeuralSDF, path: str | Path, overwrite: bool = False) -> None:
    """Write a field to one file, atomically.

    Raises
    ------
    OutputError
        When the file exists and may not be overwritten, or cannot be written.
    """
    from safetensors.torch import save

    tensors = {
        "theta": sdf.theta.detach().cpu().contiguous(),
        "frame.center": torch.as_tensor(sdf.frame.center),
        "frame.scale": torch.tensor(sdf.frame.scale, dtype=torch.float64),
        "box": torch.as_tensor(np.stack([sdf.box.lower, sdf.box.upper])),
    }
    if sdf.support is not None:
        tensors["support"] = torch.as_tensor(sdf.support)
    if sdf.detail is not None:
        tensors |= detail_tensors(sdf.detail)
    facts = {"format": FORMAT, "gnrecon": __version__, "widths": sdf.field.widths, "options": dict(sdf.options)}
    # One entry, because safetensors writes several in an order that differs from run to run.
    metadata = {"gnrecon": json.dumps(facts)}
    with atomic_write(path, overwrite) as temporary:
        temporary.write_bytes(save(tensors, metadata))


def load_sdf(path: str | Path, device: str = "cpu") -> NeuralSDF:
    """Read a field that `save_sdf` wrote.

    Raises
    ------
    InputError
        When there is no such file, or it holds no field, or one with a part that no fit makes.
    """
    from safetensors import SafetensorError, safe_open

    if not Path(path).is_file():
        raise InputError(f"There is no file {path}.")
    try:
        with safe_open(str(path), framework="pt", device=device) as file:
            facts = json.loads((file.metadata() or {}).get("gnrecon", "{}"))
            # Copies, because they begin where fast instructions want it: elsewhere results differ in the last bit.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if not isinstance(facts, dict) or facts.get("format") != FORMAT:
            raise InputError(f"{path} is not a gnrecon model of the format {FORMAT!r}.")
        field = Siren(_widths(path, facts["widths"]))
        _require_plain_options(path, facts["options"])
        if tensors["theta"].shape != (field.layout.count,) or not tensors["theta"].is_floating_point():
            raise InputError(f"{path} holds {tuple(tensors['theta'].shape)} parameters for widths {field.widths}.")
        _require_sense(path, tensors)
        frame = Frame(tensors["frame.center"].cpu().numpy(), float(tensors["frame.scale"]))
        lower, upper = tensors["box"].cpu().numpy()
        support = tensors["support"].cpu().numpy() if "support" in tensors else None
        detail = detail_of(path, tensors)
        sdf = NeuralSDF(field, tensors["theta"], frame, Box(lower, upper), dict(facts["options"]), support, detail)
        _require_distances(path, sdf)
        return sdf
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    # RecursionError comes from lists in lists, OverflowError from whole numbers without bounds.
    except (SafetensorError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not a gnrecon model ({error}).") from error


def _require_sense(
    path: str | Path,
    tensors: Mapping[str, torch.Tensor],
    *,
    least_scale: float = 1e-16,
    most_scale: float = 1e16,
    most_reach: float = 1e3,
) -> None:
    """Raise an error for types, shapes and numbers that no fit makes."""
    shapes = {"frame.center": (3,), "frame.scale": (), "box": (2, 3)}
    kinds = {"support": (torch.float32,), "detail.keys": (torch.int64,), "theta": (torch.float64, torch.float32)}
    kinds |= dict.fromkeys(("detail.frequencies", "detail.phases", "detail.amplitudes"), kinds["theta"])
    lengths = ("frame.center", "frame.scale", "box", "detail.lattice", "detail.noise", "detail.lengths")
    kinds |= dict.fromkeys(lengths, (torch.float64,))
    for name, tensor in tensors.items():
        plain = plain_name(name)
        if plain not in kinds:
            raise InputError(f"{path} holds {name!r}, which is no part of a gnrecon model.")
        if tensor.dtype not in kinds[plain]:
            raise InputError(f"{path} holds {name!r} as {str(tensor.dtype).removeprefix('torch.')}.")
        if name in shapes and tensor.shape != shapes[name]:
            raise InputError(f"{path} holds {name!r} of shape {tuple(tensor.shape)}, not {shapes[name]}.")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{path} holds numbers in {name!r} that are not finite.")
    box, support = tensors["box"], tensors.get("support")
    if not (float(tensors["frame.scale"]) > 0 and bool((box[1] > box[0]).all())):
        raise InputError(f"{path} holds a frame or a box without extent.")
    scale, far = float(tensors["frame.scale"]), float(tensors["frame.center"].abs().max())
    if not (least_scale <= scale <= most_scale and far <= most_scale):
        raise InputError(f"{path} holds a frame of radius {scale:.3g} at {far:.3g}, which is out of range.")
    reach = max(float(box.abs().max()), 0.0 if support is None or not len(support) else float(support.abs().max()))
    if reach > most_reach or not float((box[1] - box[0]).min()) >= 1 / most_reach:
        raise InputError(f"{path} holds a box or points that are not those of a unit ball: they reach {reach:.3g}.")
    if support is not None and (support.dtype != torch.float32 or support.ndim != 2 or support.shape[1:] != (3,)):
        raise InputError(f"{path} holds {tuple(support.shape)} numbers as the data's points, not rows of three.")
    if support is not None and not (len(support) and float((support.amax(dim=0) - support.amin(dim=0)).max()) > 1e-6):
        raise InputError(f"{path} holds no points of the data, or points that all coincide.")


def _widths(path: str | Path, widths: Any, *, most_layers: int = 64, most: int = 10**9) -> tuple[int, ...]:
    """Return the sizes of the hidden layers, if they are some."""
    if not isinstance(widths, list) or not 1 <= len(widths) <= most_layers:
        raise InputError(f"{path} holds no list of 1 to {most_layers} widths.")
    if not all(type(width) is int and 1 <= width <= most for width in widths):
        raise InputError(f"{path} holds widths that are not whole numbers from 1 on.")
    return tuple(widths)


def _require_plain_options(path: str | Path, options: Any) -> None:
    """Refuse options that are not names with values, or of other types than those of a fit."""
    if not isinstance(options, dict):
        raise InputError(f"{path} holds options that are not names with values.")
    for name, value in options.items():
        items = value if isinstance(value, list) else [value]
        if not all(item is None or isinstance(item, bool | int | float | str) for item in items):
            raise InputError(f"{path} holds an option {name[:40]!r} that is neither a value nor a list of values.")
    seed = options.get("seed", 0)
    if type(seed) is not int or not 0 <= seed < 2**63:
        raise InputError(f"{path} holds a seed that is not a whole number from 0 on.")


def _require_distances(path: str | Path, sdf: NeuralSDF, *, each: int = 6, most_boxes: float = 1e6) -> None:
    """Refuse a field that is not finite, or larger than `most_boxes` boxes, on a grid of `each` points cubed."""
    low, high = sdf.box.lower, sdf.box.upper
    steps = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, each)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = low + steps * (high - low)
    with np.errstate(all="ignore"):
        values, gradients = sdf.sdf_and_gradient(sdf.frame.to_world(x))
        size = np.abs(values).max() / sdf.frame.scale + np.abs(gradients).max()
    if not size <= most_boxes * max(1.0, float(np.linalg.norm(high - low))):
        raise InputError(f"{path} holds a field whose values are no distances: they reach {size:.3g} radii.")
