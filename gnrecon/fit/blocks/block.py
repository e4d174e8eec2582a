"""Solves one block of a large fit: its cubes, in groups, each from the points around it only.

A block is a task: it is identified by its work folder and number, reads its data from there, and writes its result
there. So it can be solved in any process that sees the folder, in any order, and again after it was lost. A block holds
whole groups of cubes, and a group uses the same points and far field in whichever block it is: how groups are assigned
to blocks, and blocks to processes, changes no digit of the result. Entry: `solve_block`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from gnrecon.field.cube_lattice import cube_groups
from gnrecon.field.detail_tensors import detail_of
from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail, Partition, neighbour_offsets
from gnrecon.field.random_features import Features
from gnrecon.fit.blocks.store import Arrays, WorkFolder
from gnrecon.fit.free_space import Surroundings
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_fields import solve_group
from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.fit.parameters import LocalFieldParameters
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.octree import Codes, DipoleTree, morton_codes, ranges
from gnrecon.geometry.open_scenes import WindingLevel
from gnrecon.geometry.signed_distance import Box


def solve_block(folder: str | Path, number: int, device: str = "cpu") -> None:
    """Solve the cubes of a block and save the result in its work folder.

    Raises
    ------
    InputError
        When the folder is no work folder.
    """
    work = WorkFolder(Path(folder))
    work.save(number, BlockSolver.of(work, device).solve(number))


@dataclass(frozen=True)
class BlockSolver:
    """The data of a work folder, mapped from its files, from which any of its blocks is solved.

    Parameters
    ----------
    residuals : of the global field at all points, ordered by the Morton codes of their cells
    disks : array of shape (N,), radius of the disk that each point represents
    radius : their median
    cells, first : arrays of shapes (C,) and (C + 1,), codes of the occupied cells, and first point of each
    keys : array of shape (B, 3), of the cubes, block after block
    ends : array of shape (K + 1,), first cube of each block
    dipoles : of all points
    network, theta, box : the global field in unit coordinates
    coarser : local fields that are added to it, if there are some
    partition, features, hyperparameters, device : as in `gnrecon.fit.local_fields`
    """

    residuals: FieldResiduals
    disks: Float
    radius: float
    cells: Codes
    first: Int
    keys: Int
    ends: Int
    dipoles: DipoleTree
    network: Siren
    theta: torch.Tensor
    box: Box
    coarser: Detail | None
    partition: Partition
    features: Features
    hyperparameters: Hyperparameters
    device: str

    @classmethod
    def of(cls, work: WorkFolder, device: str) -> BlockSolver:
        """Map the arrays of a work folder."""
        facts, array = work.facts, work.array
        deviations = array("deviations") if facts["deviations"] else None
        at = array("points"), array("normals"), array("value"), array("gradient")
        residuals = FieldResiduals(*at, deviations=deviations)
        frequencies, phases, theta = (
            torch.tensor(np.array(array(name)), device=device) for name in ("frequencies", "phases", "theta")
        )
        tensors = {name: torch.tensor(np.array(array(name)), device=device) for name in facts["coarser"]}
        coarser = detail_of(work.folder, tensors)
        return cls(
            residuals=residuals,
            disks=array("disks"),
            radius=facts["radius"],
            cells=array("cells"),
            first=array("first"),
            keys=array("keys"),
            ends=array("ends"),
            dipoles=DipoleTree.of_arrays(array, facts["levels"], WindingLevel(facts["principal"])),
            network=Siren(tuple(facts["widths"])),
            theta=theta,
            box=Box(*array("box")),
            # Free space asks for no more than single precision.
            coarser=None if coarser is None else coarser.to(torch.float32),
            partition=Partition(array("origin"), facts["cell"], facts["overlap"]),
            features=Features(frequencies, phases),
            hyperparameters=Hyperparameters(**facts["hyperparameters"]),
            device=device,
        )

    def solve(self, number: int) -> Arrays:
        """Return the cubes of a block that hold enough points: their rows among all cubes, lengths and amplitudes."""
        first = self.ends[number]
        keys = self.keys[first : self.ends[number + 1]]
        # An empty first array gives the shape where no cube holds enough points.
        kept, lengths, amplitudes = [], [], [np.zeros((0, len(self.features)))]
        for rows in cube_groups(keys, LocalFieldParameters.group_cells):
            for row, cube in zip(rows, self._solve_group(keys[rows]), strict=True):
                if cube is not None:
                    kept.append(first + row)
                    lengths.append(cube[0])
                    amplitudes.append(cube[1].cpu().numpy()[None])
        return {
            "cubes": np.array(kept, dtype=np.int64),
            "lengths": np.array(lengths, dtype=np.float64),
            "amplitudes": np.concatenate(amplitudes),
        }

    def _solve_group(self, keys: Int) -> list[tuple[float, torch.Tensor] | None]:
        """Return the length and amplitudes of each cube of a group, or None where it holds too few points."""
        nearby = self._nearby_points(keys)
        tree = cKDTree(self.residuals.points[nearby])
        around = Surroundings(self.box, tree, self.disks[nearby], self.dipoles, self.network, self.theta, self.coarser)
        reach = self.partition.reach + LocalFieldParameters.data_margin_disk_radii * self.radius
        found = tree.query_ball_point(self.partition.center(keys), reach, p=np.inf)
        rows = [nearby[np.sort(np.array(some, dtype=np.int64))] for some in found]
        group = self.residuals, keys, rows, around, self.partition, self.features, self.hyperparameters
        return solve_group(*group, (self.disks, self.radius), self.device)

    def _nearby_points(self, keys: Int) -> Int:
        """Return the rows of the points in the cells of cubes and their neighbours, in order: all points of theirs."""
        # A cube and its margin reach less than a cell beyond its own cell.
        near = np.unique((keys[:, None] + neighbour_offsets()).reshape(-1, 3), axis=0)
        codes = np.sort(morton_codes(near[(near >= 0).all(axis=1)]))
        # Cells without points have no code among the occupied ones.
        at = np.minimum(np.searchsorted(self.cells, codes), len(self.cells) - 1)
        at = at[self.cells[at] == codes]
        return ranges(self.first[at], self.first[at + 1])
