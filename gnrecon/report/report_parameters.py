"""Parameters of the estimate and of the page's charts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CostModel:
    """Model of what a default run takes, fitted to measured runs; see `gnrecon.report.estimate` for the formula.

    Times are processor seconds of one thread, of scans of 500 to 100,000 points at three qualities and resolutions.
    """

    start_seconds: float = 2.0  # measured: imports and the first stages of a small scan
    read_points_per_second: float = 40_000.0  # measured: reading and cleaning
    fit_seconds: float = 5.0  # measured: fit of the global field and of few local ones
    network_share: float = 0.75  # of it, which draft quality saves
    fit_point_seconds: float = 0.5e-3  # measured: local fields of each point, with `detail_features`
    mesh_seconds: float = 3.6  # measured: mesh of `mesh_cells` with `detail_features`
    mesh_cells: int = 256  # the usual resolution of 10,000 points and more
    mesh_exponent: float = 2.9  # slope of log time over log cells, where noise may lower the usual resolution
    detail_features: int = 300  # features per cube with --quality normal
    two_core_share: float = 0.7  # share of the processor seconds that pass on two idle cores; more cores help little
    fit_memory_mb: float = 550.0  # measured: fits of a few hundred points, with two threads
    dense_fit_memory_mb: float = 350.0  # measured: what a fit of `dense_fit_points` or more takes more, at most
    dense_fit_points: int = 20_000  # the size of that measurement; larger scans are fitted in pieces
    mesh_memory_mb: float = 430.0  # measured: mesh of few cells
    mesh_cells_memory_mb: float = 1700.0  # measured: what a mesh of `mesh_memory_cells` takes more
    mesh_memory_cells: int = 512  # the resolution of that measurement
    last_layer_matrices: int = 4  # equations of the data and of the volume, their sum, and its factor
    read_point_bytes: float = 600.0  # measured: each point that is read


@dataclass(frozen=True)
class ChartLayout:
    """Size of a chart and its margins, in SVG units, which are about a pixel on the page."""

    width: int = 440  # one of two columns of the page
    height: int = 210
    left: int = 12
    right: int = 12
    top: int = 14  # a note fits above the bars
    bottom: int = 40  # the axis, its numbers and its name
    strip_height: int = 12  # strip of colours below the bars of a legend
