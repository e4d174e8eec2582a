"""The parameters of shape learning: of a run, and of each family of problems.

Lengths are in the coordinates of a problem: those of the curves, the radius of a scan, or half the longest side of a
part's design region.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RunParameters:
    """A run of an optimiser: when it measures, and how it starts, averages and prunes."""

    # Limit if only a budget of seconds is given.
    most_steps: int = 10**6
    # First measurement after so many seconds, or steps without a budget, and the factor from one to the next: frequent
    # at first, when the surface changes, and rare later, so that measuring costs a small part of a run.
    first_measurement: float = 5.0
    measurement_growth: float = 1.5
    # Pretraining on the start's values: points in the box per step, and most steps. The paper takes thousands of steps.
    pretraining_points: int = 1500
    pretraining_steps: int = 15
    # Fraction of the budget within which pretraining must end.
    pretraining_budget_share: float = 0.25
    # Weight of the previous mean in the running mean of the parameters.
    mean_memory: float = 0.6
    # Pruning a wider network: fraction of the budget for the wide one, and steps after each removed unit. Measured on
    # the rocker arm, docs/research/2026-11-25-vertex-normals-and-width.md.
    wide_budget_share: float = 0.14
    steps_per_removal: int = 4
    # Damping of the first step after a removal: this factor of the last one, but at most the value below.
    removal_damping_factor: float = 3.0
    most_removal_damping: float = 1e-3


@dataclass(frozen=True)
class CurveParameters:
    """Minimal and developable surfaces through curves."""

    # Points of each term per step.
    surface_points: int = 2000
    curve_points: int = 500
    box_points: int = 300
    # The weight of the curves is one for so many steps, then grows by the factor per step up to the maximum: once the
    # surface has its shape, its error is about the residual on the curves. Minimal surfaces only.
    weight_hold_steps: int = 40
    weight_growth: float = 1.1
    most_weight: float = 50.0
    # The eikonal term has the weight one for so many steps, then fades by the factor per step. It keeps the slope of
    # the field from vanishing on the curves; the paper's begins with 1e-3 and ends after 500 steps.
    eikonal_hold_steps: int = 10
    eikonal_factor: float = 0.7
    # Distance from the curves to the faces of the default box, in longest sides of the curves.
    box_margin_sides: float = 0.25


@dataclass(frozen=True)
class PartParameters:
    """The design of a part."""

    # The paper's network has 2 x 32 wavelets; the cost of a step grows with the fourth power of the width.
    widths: tuple[int, ...] = (24, 24)
    frequencies: tuple[float, float] = (14.0, 4.0)
    # Weights. The paper's are 1e-4 for the strain, 1 eikonal, 10 normal, 1e3 connectedness, 10 interface and 1e3 design
    # region. A slope of exactly one everywhere would cost the part accuracy elsewhere.
    strain_weight: float = 1e-4
    eikonal_weight: float = 0.1
    normal_weight: float = 0.3
    connectedness_weight: float = 1e3
    # These two rise, because the residual that a term leaves is inversely proportional to its weight, and large weights
    # at once would destroy the start.
    interface_weight: float = 3e3
    most_interface_weight: float = 1.5e4
    region_weight: float = 3e4
    most_region_weight: float = 1e6
    weight_hold_steps: int = 60
    weight_growth: float = 1.02
    # Points of each term per step.
    surface_points: int = 600
    interface_points: int = 1000
    box_points: int = 600
    region_points: int = 12_000
    # Points around the region and on the interfaces from which each step draws, so that distances are computed once.
    pool_points: int = 100_000
    # Depth of the layer inside the region's border that is kept free too, and its most as a multiple of the distance to
    # the interfaces, which may lie on the border.
    layer_depth: float = 0.018
    layer_depth_per_interface_distance: float = 0.33
    # Least value of f outside of the region as a multiple of the distance from it; a signed distance would have one.
    clearance_per_distance: float = 0.5
    # Points outside of the region where f exceeds its least value by more have no residual, before and after a step.
    active_value: float = 0.015
    # Clipping of the strain starts at this multiple of its final maximum and falls by the factor per step: clipped
    # strain is not reduced, so sharp edges of an unfinished part would stay.
    clip_start_factor: float = 100.0
    clip_fall: float = 0.99
    # Distance from an interface within which the strain is not penalised.
    interface_strain_distance: float = 0.02
    # Cells along the longest side of the grid on which components are found, as in the paper.
    component_cells: int = 64
    # Value of f at points where components are joined or removed.
    neck_value: float = 0.02
    # Points on the interfaces to which components must be attached in order to stay.
    anchor_points: int = 2000
    # The start is the region eroded by this depth; the depth falls to zero at interfaces from the distance below on.
    erosion_depth: float = 0.04
    erosion_interface_distance: float = 0.08
    # Pretraining: most steps, points of the distance per step, and weights of the interfaces and their normals.
    pretraining_steps: int = 120
    pretraining_points: int = 4000
    pretraining_interface_weight: float = 10.0
    pretraining_normal_weight: float = 3e-3
    # Weight of the previous mean of J^T J in the next one, and the fraction of each step that is taken.
    matrix_mean_memory: float = 0.8
    step_length: float = 0.2
    first_damping: float = 0.1


@dataclass(frozen=True)
class ScanParameters:
    """The reconstruction of a scan, with coordinates in radii of the scan."""

    # The paper's network, with larger initial frequencies.
    widths: tuple[int, ...] = (32, 32, 32)
    first_layer_frequency: float = 12.0
    # Points per step: the first number, its growth per step, and the slower growth above the second number. With 8,000
    # points of the bunny a quarter of the final loss is due to overfitting the points of the last steps; early in a run
    # that is small compared with what a step gains.
    first_points: int = 1500
    point_growth: float = 1.25
    many_points: int = 5000
    slow_point_growth: float = 1.012
    box_points: int = 1000
    # Distance from the scan to the faces of the box, as in the paper.
    box_margin_radii: float = 0.2
    # Initial weight of the eikonal term (the paper's), its factor per step, and its least.
    eikonal_weight: float = 1e-2
    eikonal_factor: float = 0.7
    least_eikonal_weight: float = 1e-4
    # Residuals of points and normals per parameter above which they determine the network: the eikonal term is then
    # dropped once it has its least weight.
    determined_rows_per_parameter: int = 4
    # Weight of the free space. Without the eikonal term small pockets open far from the points; ten makes them a fifth
    # as large, but slows the surface down.
    free_space_weight: float = 1.0
    # Points of the box with a known sign, and how many of them are tested in each step. Hardly any has a residual.
    free_space_pool_points: int = 150_000
    free_space_points: int = 20_000
    # If points and normals determine the network, the free space is dropped after so many steps, once the root mean
    # square of f at the points below is smaller than this. Steps then hardly move the surface, the free space is a
    # sixteenth of the remaining loss, and pockets far from the points are not in the mesh. Adam, and L-BFGS for long,
    # do not come so near.
    free_space_steps: int = 250
    settled_distance_radii: float = 5e-3
    settled_points: int = 2000
    # Least distance of free-space points from the scan, and from the nearest point in radii of its disk: nearer, the
    # sign of sparse points is sometimes wrong.
    clear_distance_radii: float = 0.05
    clear_disks: float = 3.0
    # Largest |f| that the free space demands. With 0.05 the rocker arm's loss is higher by a seventh.
    deepest_value_radii: float = 0.01


@dataclass(frozen=True)
class ShapeLearningParameters:
    """All parameters of shape learning."""

    # The step number of measurements: all weights have reached their last values, and all points are used.
    measurement_step: int = 10**9
    run: RunParameters = RunParameters()
    curves: CurveParameters = CurveParameters()
    part: PartParameters = PartParameters()
    scan: ScanParameters = ScanParameters()
