"""Solves one block of a large fit: its cubes, each from the points around it only.

A block is a task: it is identified by its work folder and number, reads its data from there, and writes its result
there. So it can be solved in any process that sees the folder, in any order, and again after it was lost. Each cube has
a random generator of its own, seeded with its key, and uses the same points and far field in whichever block it is: how
cubes are assigned to blocks, and blocks to processes, changes no digit of the result. Entry: `solve_block`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Partition, neighbour_offsets
from gnrecon.field.random_features import Features
from gnrecon.fit.blocks.store import Arrays, WorkFolder
from gnrecon.fit.free_space import CubeSpace
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_fields import cube_generator, cube_length, solve_cube
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
    partition, features, hyperparameters, seed, device : as in `gnrecon.fit.local_fields`
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
    partition: Partition
    features: Features
    hyperparameters: Hyperparameters
    seed: int
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
            partition=Partition(array("origin"), facts["cell"], facts["overlap"]),
            features=Features(frequencies, phases),
            hyperparameters=Hyperparameters(**facts["hyperparameters"]),
            seed=facts["seed"],
            device=device,
        )

    def solve(self, number: int) -> Arrays:
        """Return the cubes of a block that hold enough points: their rows among all cubes, lengths and amplitudes."""
        # An empty first array gives the shape where no cube holds enough points.
        kept, lengths, amplitudes = [], [], [np.zeros((0, len(self.features)))]
        for cube in range(self.ends[number], self.ends[number + 1]):
            solved = self._solve_cube(self.keys[cube])
            if solved is not None:
                kept.append(cube)
                lengths.append(solved[0])
                amplitudes.append(solved[1][None])
        return {
            "cubes": np.array(kept, dtype=np.int64),
            "lengths": np.array(lengths, dtype=np.float64),
            "amplitudes": np.concatenate(amplitudes),
        }

    def _solve_cube(self, key: Int) -> tuple[float, Float] | None:
        """Return the length and amplitudes of a cube, or None where it holds too few points."""
        center, nearby = self.partition.center(key), self._nearby_points(key)
        reach = self.partition.reach + LocalFieldParameters.data_margin_disk_radii * self.radius
        rows = nearby[(np.abs(self.residuals.points[nearby] - center) <= reach).all(axis=1)]
        if len(rows) < LocalFieldParameters.least_points:
            return None
        length = cube_length(self.hyperparameters, self.disks[rows], self.radius)
        space = self._space(key, center, nearby)
        cube = self.residuals, rows, length, space, self.features, self.hyperparameters, self.device
        length, amplitudes = solve_cube(*cube)
        return length, amplitudes.cpu().numpy()

    def _nearby_points(self, key: Int) -> Int:
        """Return the rows of the points in a cell and its neighbours, in order: all points of the cube."""
        # A cube and its margin reach less than a cell beyond its own cell.
        keys = key + neighbour_offsets()
        codes = np.sort(morton_codes(keys[(keys >= 0).all(axis=1)]))
        # Cells without points have no code among the occupied ones.
        at = np.minimum(np.searchsorted(self.cells, codes), len(self.cells) - 1)
        at = at[self.cells[at] == codes]
        return ranges(self.first[at], self.first[at + 1])

    def _space(self, key: Int, center: Float, nearby: Int) -> CubeSpace:
        """Return the space of a cube, near which the points have these rows."""
        points = self.residuals.points
        return CubeSpace(
            center,
            self.partition.reach,
            self.box,
            cKDTree(points[nearby]),
            self.disks[nearby],
            self.dipoles,
            self.network,
            self.theta,
            cube_generator(self.seed, key),
        )
