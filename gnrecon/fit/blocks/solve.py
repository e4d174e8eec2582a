"""Detail for a large scan: the same cubes, dealt out to blocks that are solved side by side and can be taken up again.

The points are put in the order of an octree's cells into a work folder; each block of cubes (`octree`) then reads those
around it from there (`block`), in processes of their own (`workers`). Neither the number of processes nor how many
points make a block changes the result. Beside the points themselves, memory holds what one block of each process needs.
What signs free space is the winding number of all points by a tree of dipoles (`dipoles`): a few thousand of them, as
they serve for smaller scans, would leave it doubtful within many spacings of a large one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.blocks.store import Work
from gnrecon.fit.blocks.tree import Dipoles, morton, octree_blocks
from gnrecon.fit.blocks.workers import solve_blocks, solve_scheduled
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.local_solve import Hyperparameters
from gnrecon.fit.model_selection import FieldResiduals, select_hyperparameters
from gnrecon.fit.parameters import LocalFieldParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange

LARGE = 200_000
"""Points from which a scan is fitted by blocks."""

BLOCK_POINTS = 20_000
"""Most points of a block, but for single cubes with more: some seconds of work."""

ROWS = 100_000
"""Points whose cubes are looked up at once."""


def fit_large(
    sdf: NeuralSDF,
    samples: Samples,
    held: Mask,
    options: FitOptions,
    rng: np.random.Generator,
    folder: str | Path | None = None,
    advance: ProgressCallback = ignore_progress,
    scheduler: str | None = None,
    block_points: int = BLOCK_POINTS,
) -> Detail:
    """Return what to add to a global field.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    samples : all of them
    held : mask of shape (N,), of samples that the global field has not seen
    options : of which features, seed and device are used
    rng : draws the features
    folder : where the work is kept, so that the same fit takes it up again; by default a temporary one
    advance : told of the share that is done
    scheduler : address of a Dask scheduler whose workers see the folder and solve the blocks; by default processes do
    block_points : most points of a block

    Raises
    ------
    UsageError
        When the folder holds anything else, or no scheduler answers.
    FitError, MemoryLimitError
        When a block cannot be solved.
    """
    residuals = FieldResiduals.of(sdf, samples)
    hyperparameters = select_hyperparameters(residuals, held, residuals.density.radius, rng, options.device)
    chosen = LocalFieldParameters.selection_time_share
    advance(chosen)
    like = torch.zeros(0, dtype=torch.float64, device=options.device)
    features = Features.draw(options.features, rng, like)
    # Off the data by a part of a cell that no regular scan shares, as in `detail`.
    edge = LocalFieldParameters.cube_edge_lengths
    partition = Partition(
        residuals.points.min(axis=0) - 0.137 * edge * hyperparameters.length, edge * hyperparameters.length
    )
    arrays, facts = _tasks(sdf, residuals, hyperparameters, features, partition, block_points)
    with _folder(folder) as place:
        work = Work.begin(place, arrays, facts | {"seed": options.seed})
        count = len(arrays["ends"]) - 1
        missing = [number for number in range(count) if not work.done(number)]
        if scheduler is not None and missing:
            solve_scheduled(work, missing, scheduler, subrange(advance, chosen, 1.0))
        else:
            # As many as torch has threads, which is what was asked for, or the machine's cores.
            solve_blocks(work, missing, torch.get_num_threads(), options.device, subrange(advance, chosen, 1.0))
        return _gathered(work, count, arrays["keys"], partition, features, hyperparameters)


@contextmanager
def _folder(asked: str | Path | None) -> Iterator[Path]:
    if asked is not None:
        yield Path(asked)
        return
    with tempfile.TemporaryDirectory(prefix="gnrecon-") as temporary:
        yield Path(temporary)


def _tasks(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    features: Features,
    partition: Partition,
    block_points: int,
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the arrays and the plain values from which all blocks are solved."""
    density = residuals.density
    codes = morton(_cells(partition, residuals.points))
    order = np.argsort(codes, kind="stable")
    cells, first = np.unique(codes[order], return_index=True)
    keys, ends = _blocks(_cubes(partition, residuals.points), cells, np.append(first, len(codes)), block_points)
    dipoles = Dipoles.of(residuals.points, residuals.normals, density.disks)
    arrays = {
        "points": residuals.points[order],
        "normals": residuals.normals[order],
        "value": residuals.value[order],
        "gradient": residuals.gradient[order],
        "disks": density.disks[order],
        "cells": cells,
        "first": np.append(first, len(codes)),
        "keys": keys,
        "ends": ends,
        "origin": partition.origin,
        "box": np.stack([sdf.box.lower, sdf.box.upper]),
        "theta": sdf.theta.cpu().numpy(),
        "frequencies": features.frequencies.cpu().numpy(),
        "phases": features.phases.cpu().numpy(),
        **dipoles.arrays(),
    }
    facts = {
        "widths": list(sdf.field.widths),
        "levels": len(dipoles.levels),
        "cell": partition.cell,
        "overlap": partition.overlap,
        "radius": density.radius,
        "length": hyperparameters.length,
        "position": hyperparameters.position,
        "angle": hyperparameters.angle,
    }
    return arrays, facts


def _cells(partition: Partition, points: Float) -> Int:
    """Return the cell, of shape (N, 3), in which each point lies; numbers from 0."""
    return np.floor((points - partition.origin) / partition.cell).astype(np.int64)


def _cubes(partition: Partition, points: Float) -> Int:
    """Return the keys, of shape (B, 3), of all cubes that hold points; by parts, for a point is in several cubes."""
    stretches = slices(len(points), ROWS)
    return np.unique(np.concatenate([partition.members(points[rows])[0] for rows in stretches]), axis=0)


def _blocks(keys: Int, cells: npt.NDArray[np.uint64], first: Int, most: int) -> tuple[Int, Int]:
    """Return the cubes in the order of their blocks, of shape (B, 3), and where each block begins, with the end.

    A cube counts the points of its own cell.
    """
    codes = morton(keys + 1)
    order = np.argsort(codes, kind="stable")
    keys, codes = keys[order], codes[order]
    own = morton(np.maximum(keys, 0))
    at = np.minimum(np.searchsorted(cells, own), len(cells) - 1)
    held = (cells[at] == own) & (keys >= 0).all(axis=1)
    counts = np.where(held, first[at + 1] - first[at], 0)
    return keys, np.array([0, *(block.stop for block in octree_blocks(codes, counts, most))])


def _gathered(
    work: Work, count: int, keys: Int, partition: Partition, features: Features, hyperparameters: Hyperparameters
) -> Detail:
    """Return the detail of all blocks, its cubes in the order of their keys."""
    solved = [work.solved(number) for number in range(count)]
    cubes, lengths, amplitudes = (
        np.concatenate([block[name] for block in solved]) for name in ("cubes", "lengths", "amplitudes")
    )
    kept = keys[cubes]
    order = np.lexsort((kept[:, 2], kept[:, 1], kept[:, 0]))
    sums = torch.as_tensor(amplitudes[order], device=features.phases.device)
    return Detail(
        partition, kept[order], lengths[order], features, sums, hyperparameters.position, hyperparameters.angle
    )
