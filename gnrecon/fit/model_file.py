"""Fitted fields in files: one safetensors file (`.gnr`) with parameters, frame, box and options; no pickle."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from gnrecon.atomic import atomic_write
from gnrecon.cloud import Frame
from gnrecon.errors import InputError
from gnrecon.field.siren import Siren
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.sampling import Box
from gnrecon.version import __version__

FORMAT = "gnrecon-sdf-1"


def save_sdf(sdf: NeuralSDF, path: str | Path, overwrite: bool = False) -> None:
    """Write a field to one file, atomically.

    Raises
    ------
    OutputError
        When the file exists and may not be overwritten, or cannot be written.
    """
    from safetensors.torch import save_file

    tensors = {
        "theta": sdf.theta.detach().cpu().contiguous(),
        "frame.center": torch.as_tensor(sdf.frame.center),
        "frame.scale": torch.tensor(sdf.frame.scale, dtype=torch.float64),
        "box": torch.as_tensor([sdf.box.lower.tolist(), sdf.box.upper.tolist()], dtype=torch.float64),
    }
    metadata = {
        "format": FORMAT,
        "gnrecon": __version__,
        "widths": json.dumps(sdf.field.widths),
        "options": json.dumps(dict(sdf.options)),
    }
    with atomic_write(path, overwrite) as temporary:
        save_file(tensors, temporary, metadata)


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
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except SafetensorError as error:
        raise InputError(f"{path} is not a gnrecon model ({error}).") from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path} is not a gnrecon model: its format is {metadata.get('format')!r}, not {FORMAT!r}.")
    lower, upper = tensors["box"].cpu().numpy()
    return NeuralSDF(
        Siren(tuple(json.loads(metadata["widths"]))),
        tensors["theta"],
        Frame(tensors["frame.center"].cpu().numpy(), float(tensors["frame.scale"])),
        Box(lower, upper),
        json.loads(metadata["options"]),
    )
