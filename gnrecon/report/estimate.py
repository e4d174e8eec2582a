"""Estimates the time and memory of a run from a model that was fitted to measured runs.

Processor seconds, fitted to runs with one thread of scans of 500 to 100,000 points, rippled balls, machine parts,
organic shapes and range scans, in three qualities and at three resolutions:

    start  2 s, and 1 s for each 40,000 points that are read
    fit    5 s (1.25 s in draft quality), and 0.5 s for each 1,000 points (0.65 + 0.35 (features / 300)^2)
    mesh   3.6 s (cells / 256)^2.9 (0.7 + 0.3 features / 300)

A resolution of the user's own is taken as it is, while noise may lower the usual one: so the power is above two. Two
idle cores take 0.7 of the sum. Of 35 runs on an EPYC (Zen 5), nine of ten were within a factor of 1.6 of what is
expected: smooth shapes take less than others with as many points, scans without normals more. One machine took 1.5
times as long as another. The peak of resident memory was 0.45 to 1 GB in the fit, and in the mesh 0.4 GB and 1.1 to 2.1
GB (cells / 512)^2, less in a long and thin box; the points themselves matter only from millions on.
`./scripts/bench estimate` compares runs with what is expected of them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.options import Options
from gnrecon.report.report_parameters import CostModel
from gnrecon.runtime.memory_budget import require_memory


@dataclass(frozen=True)
class Estimate:
    """Expected time and memory of a run.

    Parameters
    ----------
    seconds : on two idle cores, mostly to within a factor of two
    memory_mb : peak of resident memory, in MB of 10^6 bytes
    fit_seconds, mesh_seconds : those of the fit, and of the mesh
    """

    seconds: float
    memory_mb: float
    fit_seconds: float = 0.0
    mesh_seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)

    def describe(self) -> str:
        """Return the estimate as a sentence."""
        time = f"{_rounded(self.seconds)} seconds" if self.seconds < 120 else f"{self.seconds / 60:.0f} minutes"
        return f"It would take about {time} on two idle cores, and {self.memory_mb / 1000:.1f} GB of memory."


def estimate(
    read: int, points: int, bounds: Float, options: Options, *, model: CostModel = CostModel()
) -> Estimate | None:
    """Return what a run is expected to take, or None where no such run was measured.

    None is returned for one network instead of the default fit, for a GPU, and with ``max_error``, where the number of
    cells is not known in advance. Refinement, uncertainty and regularisers take additional time.

    Parameters
    ----------
    read, points : number of points that were read, and that will be fitted
    bounds : box of the field, of shape (2, 3), in file units
    options : Options
    model : measured times and memory
    """
    fit = options.fit()
    if not fit.adaptive or not options.device.startswith("cpu") or options.max_error is not None:
        return None
    cells, detail = options.mesh().cells(bounds), fit.features / model.detail_features
    starting = model.start_seconds + read / model.read_points_per_second
    fitting = model.fit_seconds * (1.0 if fit.fits_network else 1.0 - model.network_share)
    fitting += model.fit_point_seconds * points * (0.65 + 0.35 * detail**2)
    meshing = model.mesh_seconds * (cells / model.mesh_cells) ** model.mesh_exponent * (0.7 + 0.3 * detail)
    seconds = model.two_core_share * (starting + fitting + meshing)
    mesh_memory = mesh_memory_mb(cells, bounds, model=model)
    fit_memory = model.fit_memory_mb + model.dense_fit_memory_mb * min(1.0, points / model.dense_fit_points)
    memory = max(fit_memory, mesh_memory) + read * model.read_point_bytes / 1e6
    parts = (round(model.two_core_share * part, 1) for part in (fitting, meshing))
    return Estimate(round(seconds, 1), round(memory), *parts)


def mesh_memory_mb(cells: float, bounds: Float, *, model: CostModel = CostModel()) -> float:
    """Return the peak of resident memory of a meshing, in MB of 10^6 bytes.

    Parameters
    ----------
    cells : along the longest side of the box
    bounds : the box, of shape (2, 3); one that is long and thin holds less surface than those that were measured
    model : measured memory
    """
    x, y, z = np.ptp(bounds, axis=0) / np.ptp(bounds, axis=0).max()
    # The faces of the flattest of those boxes had half the area of a cube's.
    filled = min(1.0, 2.0 * float(x * y + y * z + z * x) / 3.0)
    return model.mesh_memory_mb + model.mesh_cells_memory_mb * filled * (cells / model.mesh_memory_cells) ** 2


def network_memory_mb(widths: tuple[int, ...], *, model: CostModel = CostModel()) -> float:
    """Return the peak of resident memory of the fit of one network, in MB of 10^6 bytes, without its Jacobians.

    Its start solves the equations of the last layer, whose dense matrices grow with the square of that layer's width.
    """
    return model.fit_memory_mb + model.last_layer_matrices * 8 * (widths[-1] + 1) ** 2 / 1e6


def expected_within_memory(read: int, points: int, bounds: Float, options: Options) -> Estimate | None:
    """Return what `estimate` does, and refuse what needs more memory than is left.

    Raises
    ------
    MemoryLimitError
        When the run, its mesh, or its single network needs more.
    """
    expected, fit = estimate(read, points, bounds, options), options.fit()
    if expected is not None:
        require_memory(expected.memory_mb)
    require_memory(mesh_memory_mb(options.mesh().cells(bounds), bounds))
    if not fit.adaptive and options.device.startswith("cpu"):
        require_memory(network_memory_mb(fit.widths_for(points)))
    return expected


def _rounded(seconds: float) -> str:
    return f"{round(seconds, -1):.0f}" if seconds >= 20 else f"{seconds:.0f}"
