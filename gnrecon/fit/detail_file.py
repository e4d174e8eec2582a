"""The detail of a dense scan's field as tensors of a model file, and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.runtime.errors import InputError

LATTICE, NOISE, KEYS, LENGTHS = "detail.lattice", "detail.noise", "detail.keys", "detail.lengths"
FREQUENCIES, PHASES, AMPLITUDES = "detail.frequencies", "detail.phases", "detail.amplitudes"


def detail_tensors(detail: Detail) -> dict[str, Tensor]:
    """Return a detail as tensors by name; the lattice is its origin, its cell and its overlap."""
    lattice = [*detail.partition.origin.tolist(), detail.partition.cell, detail.partition.overlap]
    tensors = {
        LATTICE: torch.tensor(lattice, dtype=torch.float64),
        NOISE: torch.tensor([detail.position, detail.angle], dtype=torch.float64),
        KEYS: torch.as_tensor(detail.keys),
        LENGTHS: torch.as_tensor(detail.lengths),
        FREQUENCIES: detail.features.frequencies,
        PHASES: detail.features.phases,
        AMPLITUDES: detail.amplitudes,
    }
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}


def detail_of(path: str | Path, tensors: Mapping[str, Tensor]) -> Detail | None:
    """Return the detail among a file's tensors, or None where there is none.

    Raises
    ------
    InputError
        When tensors are missing or do not fit together.
    """
    if LATTICE not in tensors:
        return None
    lattice, noise, keys, lengths = (tensors[name].cpu().numpy() for name in (LATTICE, NOISE, KEYS, LENGTHS))
    frequencies, phases, amplitudes = (tensors[name] for name in (FREQUENCIES, PHASES, AMPLITUDES))
    cubes, features = len(lengths), len(phases)
    shapes = (lattice.shape, noise.shape, keys.shape, lengths.shape, tuple(frequencies.shape), tuple(amplitudes.shape))
    if shapes != ((5,), (2,), (cubes, 3), (cubes,), (features, 3), (cubes, features)):
        raise InputError(f"{path} holds a detail whose parts do not fit together: {shapes}.")
    if not ((lengths > 0).all() and (noise > 0).all() and lattice[3] > 0 and 0 < lattice[4] <= 1):
        raise InputError(f"{path} holds a detail whose lengths or noise are not positive.")
    partition = Partition(lattice[:3], float(lattice[3]), float(lattice[4]))
    of_all = Features(frequencies, phases)
    return Detail(partition, keys, lengths, of_all, amplitudes, float(noise[0]), float(noise[1]))
