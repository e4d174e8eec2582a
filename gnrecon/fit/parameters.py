"""Tuning constants of the fit, one frozen dataclass for each method, gathered in `FitParameters`.

A radius is that of the scan, which lies in the unit ball. A spacing is the median distance between neighbouring points,
and a disk radius that of the disk that one point stands for. Values without a source were chosen on the benchmark
shapes of docs/benchmarks.md.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TwoLevelParameters:
    """The default fit: a global field and local corrections (`fit.two_level`)."""

    global_field_points: int = 5000  # most points that the global field is fitted to; its 1,000 units resolve no more
    validation_one_in: int = 6  # one point in so many is a validation point
    most_validation_points: int = 2000  # where the local fields are not solved by blocks; more change no choice
    global_time_share: float = 0.25  # of the whole fit, measured, for the progress bar


@dataclass(frozen=True)
class LocalFieldParameters:
    """The cubes of local corrections (`fit.local_fields`, `fit.blocks`)."""

    cube_edge_lengths: float = 5.0  # in length scales: longer cubes need more features, shorter ones overlap too much
    data_margin_disk_radii: float = 2.0  # a cube is also fitted to data so far beyond it
    volume_samples: int = 400  # samples of free space a cube
    clearance_disk_radii: float = 3.5  # their least distance from the data: nearer, the winding number is unreliable
    least_points: int = 4  # of a cube; fewer do not define a surface
    most_length_stretch: float = 4.0  # most a cube's length scale may exceed the scan's where points are sparse
    selection_time_share: float = 0.2  # of the local fit, until length and noise are chosen, for the progress bar


@dataclass(frozen=True)
class FitParameters:
    """All tuning constants of the fit."""

    two_level: TwoLevelParameters = TwoLevelParameters()
    local_fields: LocalFieldParameters = LocalFieldParameters()
