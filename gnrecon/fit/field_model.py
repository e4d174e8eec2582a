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

from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
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
    detail : what is added to the network near the data of a dense scan, unit coordinates
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
        When there is no such file or it holds no field.
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
        field = Siren(_require_widths(path, facts["widths"]))
        if tensors["theta"].shape != (field.layout.count,):
            raise InputError(f"{path} holds {tuple(tensors['theta'].shape)} parameters for widths {field.widths}.")
        _require_sense(path, tensors)
        frame = Frame(tensors["frame.center"].cpu().numpy(), float(tensors["frame.scale"]))
        lower, upper = tensors["box"].cpu().numpy()
        support = tensors["support"].cpu().numpy() if "support" in tensors else None
        detail = detail_of(path, tensors)
        return NeuralSDF(field, tensors["theta"], frame, Box(lower, upper), dict(facts["options"]), support, detail)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    # JSON that is nested too deeply, and numbers that are too large for their use, are damage as well.
    except (SafetensorError, KeyError, ValueError, TypeError, RecursionError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not a gnrecon model ({error}).") from error


def _require_widths(path: str | Path, widths: Any, *, most_layers: int = 64) -> tuple[int, ...]:
    """Return the widths of a network, or raise an error where they are no list of positive whole numbers."""
    if not isinstance(widths, list) or not 1 <= len(widths) <= most_layers:
        raise InputError(f"{path} holds no list of 1 to {most_layers} network widths.")
    if not all(type(width) is int and width >= 1 for width in widths):
        raise InputError(f"{path} holds network widths that are not positive whole numbers.")
    return tuple(widths)


def _require_sense(
    path: str | Path,
    tensors: Mapping[str, torch.Tensor],
    *,
    most_unit: float = 100.0,
    most_number: float = 1e15,
    scales: tuple[float, float] = (1e-16, 1e25),
    least_length: float = 1e-9,
    least_overlap: float = 1e-3,
) -> None:
    """Raise an error for types, shapes and numbers that no fit makes.

    Parameters
    ----------
    path : named in the error
    tensors : of the file, by name
    most_unit : largest coordinate in units of the frame, where all data lies in the unit ball
    most_number : largest other number; sums of squares of larger ones leave no digits
    scales : range of the frame's scale, in file units, which includes every scan that ingest accepts
    least_length : of the cubes and correlation lengths of local fields, in units of the frame
    least_overlap : of the cubes, as a share of their edge
    """
    for name, tensor in tensors.items():
        whole = name == "detail.keys"
        if tensor.dtype not in ((torch.int64, torch.int32) if whole else (torch.float32, torch.float64)):
            kind = str(tensor.dtype).removeprefix("torch.")
            raise InputError(f"{path} holds {name!r} as {kind}, not as {'whole' if whole else 'real'} numbers.")
    for name in ("frame.center", "frame.scale", "box"):
        if tensors[name].dtype != torch.float64:
            raise InputError(f"{path} holds {name!r} in single precision, not in double.")
    shapes = {"frame.center": (3,), "frame.scale": (), "box": (2, 3)}
    for name, tensor in tensors.items():
        if name in shapes and tensor.shape != shapes[name]:
            raise InputError(f"{path} holds {name!r} of shape {tuple(tensor.shape)}, not {shapes[name]}.")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{path} holds numbers in {name!r} that are not finite.")
        unit = name in ("box", "support", "detail.lattice")
        world, most = name in ("frame.center", "frame.scale"), most_unit if unit else most_number
        if not world and tensor.numel() and float(tensor.double().abs().max()) > most:
            raise InputError(f"{path} holds numbers in {name!r} that are too large.")
    box, support, scale = tensors["box"], tensors.get("support"), float(tensors["frame.scale"])
    if not (scale > 0 and bool((box[1] - box[0] > least_length).all())):
        raise InputError(f"{path} holds a frame or a box without extent.")
    if not scales[0] < scale < scales[1]:
        raise InputError(f"{path} holds a frame of the scale {scale:g}, which cannot be computed with.")
    # Farther from the origin, float64 does not tell the corners of the box apart.
    if float(tensors["frame.center"].abs().max()) > most_number * scale:
        raise InputError(f"{path} holds a frame that lies too far from the origin for its scale.")
    if "detail.lattice" in tensors:
        lattice, lengths = tensors["detail.lattice"], tensors["detail.lengths"]
        if lattice.shape != (5,) or not (float(lattice[3]) >= least_length and bool((lengths >= least_length).all())):
            raise InputError(f"{path} holds local fields whose lengths are not positive.")
        if float(lattice[4]) < least_overlap:
            raise InputError(f"{path} holds local fields that do not overlap.")
    if support is not None and (support.dtype != torch.float32 or support.shape[1:] != (3,) or not len(support)):
        raise InputError(f"{path} holds {tuple(support.shape)} numbers as the data's points, not rows of three.")


# The local fields as tensors of a model file, and back.


def detail_tensors(detail: Detail) -> dict[str, Tensor]:
    """Return a detail as tensors by name; the lattice is its origin, its cell and its overlap."""
    lattice = [*detail.partition.origin.tolist(), detail.partition.cell, detail.partition.overlap]
    tensors = {
        "detail.lattice": torch.tensor(lattice, dtype=torch.float64),
        "detail.noise": torch.tensor([detail.position, detail.angle], dtype=torch.float64),
        "detail.keys": torch.as_tensor(detail.keys),
        "detail.lengths": torch.as_tensor(detail.lengths),
        "detail.frequencies": detail.features.frequencies,
        "detail.phases": detail.features.phases,
        "detail.amplitudes": detail.amplitudes,
    }
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}


def detail_of(path: str | Path, tensors: Mapping[str, Tensor]) -> Detail | None:
    """Return the detail among a file's tensors, or None where there is none.

    Raises
    ------
    InputError
        When tensors are missing or do not fit together.
    """
    if "detail.lattice" not in tensors:
        return None
    lattice, noise, keys, lengths = (
        tensors[f"detail.{name}"].cpu().numpy() for name in ("lattice", "noise", "keys", "lengths")
    )
    frequencies, phases, amplitudes = (tensors[f"detail.{name}"] for name in ("frequencies", "phases", "amplitudes"))
    cubes, features = len(lengths), len(phases)
    shapes = (lattice.shape, noise.shape, keys.shape, lengths.shape, tuple(frequencies.shape), tuple(amplitudes.shape))
    if shapes != ((5,), (2,), (cubes, 3), (cubes,), (features, 3), (cubes, features)):
        raise InputError(f"{path} holds local fields whose parts do not fit together: {shapes}.")
    if not ((lengths > 0).all() and (noise > 0).all() and lattice[3] > 0 and 0 < lattice[4] <= 1):
        raise InputError(f"{path} holds local fields whose lengths or noise are not positive.")
    partition = Partition(lattice[:3], float(lattice[3]), float(lattice[4]))
    of_all = Features(frequencies, phases)
    return Detail(partition, keys, lengths, of_all, amplitudes, float(noise[0]), float(noise[1]))
