"""How long a run will take and how much memory it will need, by a model of measured runs.

Processor seconds of one thread, measured for clouds of 500 to 35,000 points, three qualities and three resolutions:

    fit    6.8 s (points / 500)^0.545 (0.72 + 0.28 (features / 600)^2)
    mesh   50 s (cells / 256)^2 (0.51 + 0.49 features / 600)
    start  3 s, and 1 s for each 100,000 points that are read

Two idle cores take half of the sum: 24 s were measured where the model says 34, at 2,009 points, 54 for 41 at 7,189,
42 for 44 at 10,044 and 76 for 84 at 85,127. Shapes differ, so that an estimate is right to within a factor of about
one and a half on such a machine. The peak of resident memory was 0.75 to 0.95 GB in the fit of one thread, and
0.5 GB + 0.89 GB (cells / 512)^2 in the mesh; the points themselves are small beside that until there are millions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from gnrecon.geometry.arrays import Float
from gnrecon.options import Options

_FIT_SECONDS, _FIT_POINTS, _FIT_POWER = 6.8, 500, 0.545
_MESH_SECONDS, _MESH_CELLS = 50.0, 256
_FEATURES = 600
_START_SECONDS, _POINTS_A_SECOND = 3.0, 100_000
_CORES_SHARE = 0.5
"""Of the processor seconds that pass on two idle cores; more of them help little."""

_FIT_MB, _MESH_BASE_MB, _MESH_MB, _MESH_MEMORY_CELLS = 950, 505, 886, 512
_BYTES_A_POINT = 600


@dataclass(frozen=True)
class Estimate:
    """What a run is expected to take.

    Parameters
    ----------
    seconds : on two idle cores, to within a factor of about 1.5
    memory_mb : peak of resident memory, in MB of 10^6 bytes
    """

    seconds: float
    memory_mb: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)

    def describe(self) -> str:
        """Return the estimate as a sentence."""
        time = f"{_rounded(self.seconds)} seconds" if self.seconds < 120 else f"{self.seconds / 60:.0f} minutes"
        return f"It would take about {time} on two idle cores, and {self.memory_mb / 1000:.1f} GB of memory."


def estimate(read: int, points: int, bounds: Float, options: Options) -> Estimate | None:
    """Return what a run is expected to take, or None where no such run was measured.

    That is so for one network instead of global field and detail, on a GPU, and where the mesh's cells are not known
    before (a greatest error). What is asked for besides, such as refinement or uncertainty, comes on top.

    Parameters
    ----------
    read, points : that were read, and that will be fitted
    bounds : box of the field, of shape (2, 3), in file units
    options : Options
    """
    fit = options.fit()
    if not fit.adaptive or not options.device.startswith("cpu") or options.max_error is not None:
        return None
    cells, detail = options.mesh().cells(bounds), fit.features / _FEATURES
    fitting = _FIT_SECONDS * (points / _FIT_POINTS) ** _FIT_POWER * (0.72 + 0.28 * detail**2)
    meshing = _MESH_SECONDS * (cells / _MESH_CELLS) ** 2 * (0.51 + 0.49 * detail)
    seconds = _CORES_SHARE * (_START_SECONDS + read / _POINTS_A_SECOND + fitting + meshing)
    memory = max(_FIT_MB, _MESH_BASE_MB + _MESH_MB * (cells / _MESH_MEMORY_CELLS) ** 2) + read * _BYTES_A_POINT / 1e6
    return Estimate(round(seconds, 1), round(memory))


def _rounded(seconds: float) -> str:
    return f"{round(seconds, -1):.0f}" if seconds >= 20 else f"{seconds:.0f}"
