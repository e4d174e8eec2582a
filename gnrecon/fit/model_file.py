"""Fitted fields in files: one safetensors file (`.gnr`) with parameters, frame, box, options and some of the data.

Nothing in it is code or pickle. Files without data, as earlier versions wrote them, are read too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from gnrecon.field.networks import Siren
from gnrecon.fit.detail_file import detail_of, detail_tensors
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.files import atomic_write
from gnrecon.version import __version__

FORMAT = "gnrecon-sdf-1"


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
        field = Siren(tuple(int(width) for width in facts["widths"]))
        if tensors["theta"].shape != (field.layout.count,) or not tensors["theta"].is_floating_point():
            raise InputError(f"{path} holds {tuple(tensors['theta'].shape)} parameters for widths {field.widths}.")
        _require_sense(path, tensors)
        frame = Frame(tensors["frame.center"].cpu().numpy(), float(tensors["frame.scale"]))
        lower, upper = tensors["box"].cpu().numpy()
        support = tensors["support"].cpu().numpy() if "support" in tensors else None
        detail = detail_of(path, tensors)
        return NeuralSDF(field, tensors["theta"], frame, Box(lower, upper), dict(facts["options"]), support, detail)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not a gnrecon model ({error}).") from error


def _require_sense(path: str | Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Refuse numbers that no fit makes, before they become a mesh that nobody understands."""
    shapes = {"frame.center": (3,), "frame.scale": (), "box": (2, 3)}
    for name, tensor in tensors.items():
        if name in shapes and tensor.shape != shapes[name]:
            raise InputError(f"{path} holds {name!r} of shape {tuple(tensor.shape)}, not {shapes[name]}.")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{path} holds numbers in {name!r} that are not finite.")
    box, support = tensors["box"], tensors.get("support")
    if not (float(tensors["frame.scale"]) > 0 and bool((box[1] > box[0]).all())):
        raise InputError(f"{path} holds a frame or a box without extent.")
    if support is not None and (support.dtype != torch.float32 or support.ndim != 2 or support.shape[1:] != (3,)):
        raise InputError(f"{path} holds {tuple(support.shape)} numbers as the data's points, not rows of three.")
