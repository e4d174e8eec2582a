"""Local fields of a large scan: the cubes are divided into blocks, which are solved in parallel and can be resumed.

The points are written to a work folder (`store`) in the order of an octree's cells (`tree`). Each block of cubes reads
the points around it from there (`block`), in a process of its own or on a cluster (`workers`). Neither the number of
processes nor the size of the blocks changes the result. Besides the points, memory holds the data of one block for each
process. The sign of free space is that of the winding number of all points, by a tree of dipoles (`tree`): a subset of
a few thousand points, as for smaller scans, would leave it uncertain within many spacings of a large one.
Entries: `fit_large`, and `solve_by_blocks` where length and noise are known.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from gnrecon.field.detail_tensors import detail_tensors
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.store import WorkFolder
from gnrecon.fit.blocks.workers import Workers, solve_blocks, solve_on_cluster
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_fields import feature_count, with_coarser
from gnrecon.fit.model_selection import Hyperparameters, select_hyperparameters
from gnrecon.fit.parameters import LocalFieldParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.octree import morton_codes, octree_blocks
from gnrecon.geometry.point_cloud import Samples
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange


def fit_large(
    sdf: NeuralSDF,
    samples: Samples,
    held: Mask,
    options: FitOptions,
    rng: np.random.Generator,
    folder: str | Path | None = None,
    advance: ProgressCallback = ignore_progress,
    scheduler: str | None = None,
    workers: Workers | None = None,
    block_points: int | None = None,
) -> Detail:
    """Return the local fields to add to a global field.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    samples : all of them
    held : mask of shape (N,), of samples that the global field was not fitted to
    options : of which features, seed and device are used
    rng : draws the features
    folder : where the work is saved, so that the same fit can resume; by default a temporary one
    advance : called with the share that is done
    scheduler : address of a Dask scheduler whose workers see the folder and solve the blocks
    workers : local processes that do; by default this process solves them
    block_points : points of a block at most; by default a share of all, so that processes end at about the same time

    Raises
    ------
    UsageError
        When the folder holds other files, or no scheduler answers.
    FitError, MemoryLimitError
        When a block cannot be solved.
    """
    residuals = FieldResiduals.of(sdf, samples)
    hyperparameters = select_hyperparameters(residuals, held, residuals.density.radius, rng, options.device)
    chosen = LocalFieldParameters.selection_time_share
    advance(chosen)
    sdf, residuals = with_coarser(sdf, residuals, hyperparameters, rng, options.device)
    field = sdf, residuals, hyperparameters, options.features, rng, options.device, subrange(advance, chosen, 1.0)
    return solve_by_blocks(*field, options.seed, folder, scheduler, workers, block_points)


def solve_by_blocks(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    features: int,
    rng: np.random.Generator,
    device: str,
    advance: ProgressCallback = ignore_progress,
    seed: int = 0,
    folder: str | Path | None = None,
    scheduler: str | None = None,
    workers: Workers | None = None,
    block_points: int | None = None,
) -> Detail:
    """Return the local fields to add to a global field, for known hyperparameters.

    Parameters
    ----------
    sdf, residuals, hyperparameters : the global field, with coarser local ones if it has some, its residuals at the
        samples, and their length and noise
    features : of each cube
    seed : of the fit, which the work folder notes
    rng, device, advance, folder, scheduler, workers, block_points : as in `fit_large`, which says what it raises, too
    """
    count = feature_count(features, hyperparameters.length, residuals.density.radius)
    drawn = Features.draw(count, rng, torch.zeros(0, dtype=torch.float64, device=device))
    partition = Partition.about(residuals.points, LocalFieldParameters.cube_edge_lengths * hyperparameters.length)
    arrays, facts = _task_data(
        sdf, residuals, hyperparameters, drawn, partition, block_points or _most_points(len(residuals))
    )
    with _work_folder(folder) as path:
        work = WorkFolder.open(path, arrays, facts | {"seed": seed})
        blocks = len(arrays["ends"]) - 1
        # A resumed fit finds the blocks of earlier runs.
        missing = [number for number in range(blocks) if not work.is_solved(number)]
        if scheduler is not None and missing:
            solve_on_cluster(work, missing, scheduler, advance)
        else:
            solve_blocks(work, missing, workers, device, advance)
        return replace(_assembled(work, blocks, arrays["keys"], partition, drawn, hyperparameters), coarser=sdf.detail)


def _most_points(
    points: int, *, least_blocks: int = BlockParameters.least_blocks, most: int = BlockParameters.block_points
) -> int:
    """Return how many points a block of a scan of so many has at most."""
    return min(math.ceil(points / least_blocks), most)


@contextmanager
def _work_folder(folder: str | Path | None) -> Iterator[Path]:
    if folder is not None:
        yield Path(folder)
        return
    with tempfile.TemporaryDirectory(prefix="gnrecon-") as temporary:
        yield Path(temporary)


def _task_data(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    features: Features,
    partition: Partition,
    block_points: int,
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the arrays and the plain values from which all blocks are solved, see `BlockSolver`."""
    density = residuals.density
    codes = morton_codes(_cells(partition, residuals.points))
    # Stable sorting keeps the order of points within a cell, and so the sums over them.
    order = np.argsort(codes, kind="stable")
    cells, first = np.unique(codes[order], return_index=True)
    keys, ends = _divided(
        _occupied_cubes(partition, residuals.points), cells, np.append(first, len(codes)), block_points
    )
    dipoles = residuals.dipoles
    coarser = {} if sdf.detail is None else {name: part.numpy() for name, part in detail_tensors(sdf.detail).items()}
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
        **({} if residuals.deviations is None else {"deviations": residuals.deviations[order]}),
        **dipoles.arrays(),
        **coarser,
    }
    facts = {
        "widths": list(sdf.field.widths),
        "levels": len(dipoles.levels),
        "principal": dipoles.sides.principal,
        "cell": partition.cell,
        "overlap": partition.overlap,
        "radius": density.radius,
        "hyperparameters": asdict(hyperparameters),
        "deviations": residuals.deviations is not None,
        "coarser": list(coarser),
    }
    return arrays, facts


def _cells(partition: Partition, points: Float) -> Int:
    """Return the cell, of shape (N, 3), in which each point lies; numbers from 0."""
    return np.floor((points - partition.origin) / partition.cell).astype(np.int64)


def _occupied_cubes(partition: Partition, points: Float, *, lookup_points: int = BlockParameters.lookup_points) -> Int:
    """Return the keys, of shape (B, 3), of all cubes that hold points, from `lookup_points` of these at a time."""
    runs = slices(len(points), lookup_points)
    return np.unique(np.concatenate([partition.members(points[rows])[0] for rows in runs]), axis=0)


def _divided(keys: Int, cells: npt.NDArray[np.uint64], first: Int, most: int) -> tuple[Int, Int]:
    """Return the cubes in the order of their blocks, of shape (B, 3), and the first of each block, with the end.

    A cube counts the points of its own cell, not those of its overlap. Blocks consist of whole groups.
    """
    # Keys begin at -1, as cubes below the first cell overlap it; Morton codes begin at 0.
    codes = morton_codes(keys + 1)
    order = np.argsort(codes, kind="stable")
    keys, codes = keys[order], codes[order]
    own = morton_codes(np.maximum(keys, 0))
    at = np.minimum(np.searchsorted(cells, own), len(cells) - 1)
    held = (cells[at] == own) & (keys >= 0).all(axis=1)
    counts = np.where(held, first[at + 1] - first[at], 0)
    # A code without its last bits is that of the cube's group.
    bits = 3 * (LocalFieldParameters.group_cells.bit_length() - 1)
    groups, start = np.unique(codes >> np.uint64(bits), return_index=True)
    blocks = octree_blocks(groups, np.add.reduceat(counts, start), most)
    return keys, np.array([0, *np.append(start, len(codes))[[block.stop for block in blocks]]])


def _assembled(
    work: WorkFolder, count: int, keys: Int, partition: Partition, features: Features, hyperparameters: Hyperparameters
) -> Detail:
    """Return the local fields of all blocks, in the order of their keys."""
    solved = [work.load(number) for number in range(count)]
    cubes, lengths, amplitudes = (
        np.concatenate([block[name] for block in solved]) for name in ("cubes", "lengths", "amplitudes")
    )
    kept = keys[cubes]
    # The order in which smaller scans have them, whatever the blocks are.
    order = np.lexsort((kept[:, 2], kept[:, 1], kept[:, 0]))
    sums = torch.as_tensor(amplitudes[order], device=features.phases.device)
    return Detail(
        partition, kept[order], lengths[order], features, sums, hyperparameters.position, hyperparameters.angle
    )
