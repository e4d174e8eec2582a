"""The numbers that tune meshing, with their units and where their values come from.

`ExportParameters` holds those of every method; a number that a single function needs is a keyword of that function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ExtractionParameters:
    """Of the sparse grid and of marching cubes."""

    # Cells along a leaf, the unit of evaluation: so small that few of its 64 nodes are far from the surface.
    leaf_cells: int = 4
    # Cells along a chunk, the unit of marching cubes, which then takes 33^3 nodes at once.
    chunk_cells: int = 32
    # Most coarse blocks along the longest side, so that the first search costs the same at any resolution.
    coarse_blocks: int = 96
    # Coarse blocks whose gradients estimate the field's slope: nearest to the surface, and as many all over the box.
    slope_samples: int = 2048
    # Percentile of those slopes that counts as the steepest: a single fold of the field would set the maximum.
    slope_percentile: float = 99.5
    # Bound on the slope over what was measured: a quarter more than the gradients at neighbouring centres show.
    slope_margin: float = 1.25
    # Cells beyond a data point in which the surface is searched; what lies farther off is found by propagation.
    data_reach_cells: float = 2.0
    # Blocks that are subdivided at once, so that memory does not grow with the resolution.
    batch_blocks: int = 4096
    # Least magnitude of a node's value, in cells over the slope: no vertex falls on a node, no face is degenerate.
    least_node_cells: float = 1e-4
    # Greatest magnitude, likewise: the ratio of the two keeps crossings clear of nodes in scikit-image's float32.
    greatest_node_cells: float = 8.0


@dataclass(frozen=True)
class ResolutionParameters:
    """Of how fine a field is meshed."""

    # Mean length of marching cubes' edges in cells; tests/export/test_export_resolution.py checks it.
    mean_edge_cells: float = 0.97
    # Fewest and most cells along the longest side that an edge length may ask for.
    least_cells: int = 16
    most_cells: int = 4096
    # Cells along the longest side up to which a mesh is refined for its chord error.
    most_refined_cells: int = 1024
    # Share of the wanted chord error that counts as reached: projecting the whole mesh may change it a little.
    accepted_error_share: float = 0.95
    # Share of the points whose chord error is below the reported one; at the rest the field may fold.
    error_quantile: float = 0.999
    # Faces at which the chord error is measured: four points each, so that 20 lie beyond this quantile.
    error_faces: int = 5_000
    # Distance of vertices from the zero level, in half edges, that is no matter next to that of the faces.
    projection_tolerance: float = 1e-3


@dataclass(frozen=True)
class HandleParameters:
    """Of dropping handles and tunnels; a rim is the circumference of the disk that a point stands for."""

    # Most rims of a loop, and the angle about its axis that normals of supporting points must leave free to drop it:
    # a tunnel or rod that was scanned has points on more than half of the circle.
    loop_rims_and_free_angles: tuple[tuple[float, float], ...] = ((1.0, np.pi), (2.0, 5 / 3 * np.pi))
    # Most rims of a loop around a neck that no point is near.
    neck_rims: float = 3.0
    # Disks within which a point supports a place, and within which it lies on the surface.
    near_disks: float = 2.0
    surface_disks: float = 0.7
    # Greatest cosine between a loop's axis and a normal that counts: others do not look around the loop.
    axis_cosine: float = 0.7
    # Least cosine between the normals of a vertex and of a point that supports it: 60 degrees.
    normal_cosine: float = 0.5
    # Points that a vertex is compared with, and that a point's plane is fitted to in addition to the point itself.
    ring_points: int = 8
    # Loop lengths from a cap within which unsupported surface, and any surface, is faired.
    stub_lengths: float = 3.0
    fairing_lengths: float = 0.3
    # Most times that loops are searched: those cut at once hide others.
    rounds: int = 20
    # Loops that are cut at once: of so many signatures of 64 bits, hardly one depends on the others by chance, and a
    # loop of which that is so is cut in the next round.
    loops_at_once: int = 48


@dataclass(frozen=True)
class RepairParameters:
    """Of repairing a mesh and of dropping stray components."""

    # How far coincident vertices are separated, as a share of the way to the middle of their faces.
    separation_share: float = 1e-3
    # Most edges of a hole that is closed: a larger one is missing surface, which no repair should make up.
    hole_edges: int = 100
    # Least number and least share of the points that must lie nearest to a component for it to stay.
    stray_points: int = 3
    stray_point_share: float = 0.005


@dataclass(frozen=True)
class TrimParameters:
    """Of cutting off surface that is far from data; a reach is the distance of the cut."""

    # Standard deviation of the smoothing of distances: a line at a distance from single points is ragged.
    smoothing_reaches: float = 1 / 3
    # The same for the distance beyond the outermost points: that from a smooth line is ragged only at its corners.
    overhang_smoothing_reaches: float = 0.15
    # Area below which a hole is not cut: the points around it support it well enough.
    hole_squared_reaches: float = 1.0
    # Area below which a leftover piece goes: a disk of two reaches, as around a few stray points.
    crumb_squared_reaches: float = 4 * np.pi
    # How far a crossing stays from the ends of its edge, as a share of the edge: no face becomes a sliver.
    edge_clearance: float = 0.1


@dataclass(frozen=True)
class RemeshParameters:
    """Of isotropic remeshing; the two ratios are those of Botsch and Kobbelt (2004)."""

    # An edge is split beyond the long ratio of the target length, and collapsed below the short one: halves of a long
    # edge are then nearer to the target than the edge itself, and are not collapsed again.
    long_edge_ratio: float = 4.0 / 3.0
    short_edge_ratio: float = 4.0 / 5.0
    # Rounds of splitting, collapsing, flipping and relaxing.
    rounds: int = 8
    # Shortest adapted length as a share of the longest: 64 faces in place of one.
    finest_length_share: float = 1.0 / 8.0


@dataclass(frozen=True)
class AttributeParameters:
    """Of carrying a scan's attributes over."""

    # Points that a vertex averages: about the first ring around a point of an even scan.
    nearest_points: int = 8


@dataclass(frozen=True)
class ExportParameters:
    """All numbers that tune meshing, by method.

    `mesh_field` passes extraction, resolution, handles and remesh on. The others are the defaults of their functions.
    """

    extraction: ExtractionParameters = ExtractionParameters()
    resolution: ResolutionParameters = ResolutionParameters()
    handles: HandleParameters = HandleParameters()
    repair: RepairParameters = RepairParameters()
    trim: TrimParameters = TrimParameters()
    remesh: RemeshParameters = RemeshParameters()
    attributes: AttributeParameters = AttributeParameters()
