"""The local fields as tensors of a model file, and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.runtime.errors import InputError

_COARSER = "coarser."


def plain_name(name: str) -> str:
    """Return the name that a tensor of a coarser detail has in the finest one; others as they are."""
    return name[name.rfind(_COARSER) + len(_COARSER) :] if name.startswith(_COARSER) else name


def detail_tensors(detail: Detail) -> dict[str, Tensor]:
    """Return a detail as tensors by name; the lattice is its origin, its cell and its overlap."""
    coarser = {} if detail.coarser is None else detail_tensors(detail.coarser)
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
    own = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return own | {_COARSER + name: tensor for name, tensor in coarser.items()}


def detail_of(
    path: str | Path, tensors: Mapping[str, Tensor], *, most_cells: int = 1 << 20, least_noise: float = 1e-9
) -> Detail | None:
    """Return the detail among a file's tensors, or None where there is none.

    Raises
    ------
    InputError
        When tensors are missing or do not fit together.
    """
    if not any("detail." in name for name in tensors):
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
    if len({frequencies.dtype, phases.dtype, amplitudes.dtype}) > 1 or not cubes or not features:
        raise InputError(f"{path} holds local fields of different types, or none.")
    if not (np.abs(keys) < most_cells).all() or len(np.unique(keys, axis=0)) != cubes:
        raise InputError(f"{path} holds local fields in cubes that repeat or are too far off.")
    numbers = np.concatenate([np.abs(lattice), 1 / lattice[3:], noise, least_noise / noise, lengths, 1 / lengths])
    if not (numbers < most_cells).all() or float(frequencies.abs().max()) > most_cells:
        raise InputError(f"{path} holds local fields whose lengths are out of range.")
    partition = Partition(lattice[:3], float(lattice[3]), float(lattice[4]))
    of_all = Features(frequencies, phases)
    rest = {name.removeprefix(_COARSER): tensor for name, tensor in tensors.items() if name.startswith(_COARSER)}
    noises = float(noise[0]), float(noise[1])
    return Detail(partition, keys, lengths, of_all, amplitudes, *noises, coarser=detail_of(path, rest))
