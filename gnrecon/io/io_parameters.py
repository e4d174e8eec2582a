"""Parameters of reading and writing that several functions share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IOParameters:
    """Sizes and tolerances of reading and writing files."""

    most_points: int = 2_000_000
    # Points to keep of a scan: far fewer describe a surface well, and all later stages fit into memory.
    chunk_points: int = 1 << 20
    # Points in a chunk: their arrays take some ten megabytes, and libraries read so many at full speed.
    visible_rounding_diagonals: float = 1e-6
    # Rounding to float32, in diagonals of the mesh, that is reported or avoided: about eight times the float32 epsilon.
    most_built_numbers: int = 100_000_000
    # Coordinates and indices that a file may build by using what it stores many times: they take some 3 GB while read.
