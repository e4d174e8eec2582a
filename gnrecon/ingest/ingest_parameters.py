"""Tuning constants of ingest, one frozen dataclass for each method, gathered in `IngestParameters`.

A spacing is the typical distance between neighbouring points; each method says which estimate it uses. Values without a
source are choices that hold on the scans and shapes of the tests, from sparse to dense and from clean to noisy.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DensityOutlierParameters:
    """Scattered points, found by local density (`ingest.outliers`)."""

    neighbours: int = 16  # whose mean distance measures the density at a point
    deviations: float = 6.0  # robust standard deviations of the log ratio beyond which a point is an outlier
    least_ratio: float = 3.0  # of a point's mean distance to its neighbours': uneven scans have smaller ones everywhere
    passes: int = 8  # at most, as each may uncover further outliers
    sparse_spacings: float = 4.0  # mean distance, in medians of all, beyond which the surface variation is tested
    most_surface_variation: float = 0.08  # at most 0.03 on a curved sheet, about 0.15 for scattered points


@dataclass(frozen=True)
class IsolatedClusterParameters:
    """Small groups of points far from all others (`ingest.isolated_clusters`)."""

    link_spacings: float = 10.0  # nearer points belong together
    cubes_per_link: int = 4  # along the link distance: points of one cube are linked at once, to within a quarter of it
    small_share: float = 0.01  # of all points, below which a part may be an isolated cluster
    neighbours: int = 16  # that the points of a small part are linked with
    own_spacing_neighbour: int = 4  # whose distance is the spacing within a small part; 4 neighbours need 5 points
    own_link_spacings: float = 4.0  # in these, so that a thinly scanned region stays whole


@dataclass(frozen=True)
class NoiseParameters:
    """Noise by the spread about quadrics (`ingest.noise`)."""

    small_neighbourhood: int = 10  # points, the fewest with a few degrees of freedom beyond the quadric's 6
    large_neighbourhood: int = 15  # points: 1.5 times as many, so that the reaches differ clearly
    queries: int = 4000  # neighbourhoods of the smallest size
    least_queries: int = 500  # of the largest; the larger they are, the fewer suffice
    least_reach_deviations: float = 6.0  # reach of a neighbourhood over the noise; less tilts its plane
    most_doublings: int = 6  # of the neighbourhoods' size
    points_per_neighbour: int = 32  # a neighbourhood has at most 1/32 of the points, or it would span the shape
    rounding_spacings: float = 0.005  # noise below is rounding


@dataclass(frozen=True)
class NormalParameters:
    """Unoriented normals (`ingest.normals`)."""

    neighbours: tuple[int, ...] = (12, 24, 48)  # tried in turn; twice as many halve the turn of a plane by noise
    points_per_first_neighbour: int = 8  # the smallest neighbourhood has at most 1/8 of the points: it must not span
    points_per_more_neighbours: int = 16  # the shape; the larger ones at most 1/16
    most_turn_radians: float = 0.06  # by which noise may turn a normal (3.4 degrees) before more neighbours are used
    quadric_neighbours: int = 24  # for the noise: four times the quadric's coefficients
    noise_rank: int = 2  # the third smallest noise among the neighbours' counts: an edge or a second sheet is no noise
    edge_neighbours: int = 10  # of the planes that are compared across sharp edges: few, so that some lie on one side
    edge_fit_ratio: float = 10.0  # by which another plane must fit better than the point's own
    off_plane_weight: float = 4.0  # of the point's squared distance to that plane against the plane's own variance
    chunk_points: int = 50_000  # handled at a time, which bounds memory


@dataclass(frozen=True)
class LineParameters:
    """Points along lines (`ingest.line_scans`)."""

    neighbours: int = 8  # of a point, itself included, that may lie on one line
    queries: int = 2000  # random points at which they are looked up
    most_width_share: float = 0.05  # second principal sum of squares over the first; 0.4 on surfaces, 0.3 in the median
    # where points are three times denser along lines than across
    least_share: float = 0.3  # of points on lines: 0.4 to 0.9 at four times, and 0.2 at three times
    most_thinned_share: float = 0.1  # of points on lines, below which they are thinned enough
    growth: float = 1.5  # of the side of the cubes in each step of thinning
    least_points: int = 50  # that thinning leaves
    given_side_share: float = 1 / 6  # of the side of these cubes, where normals are given: the fit then uses points
    # that are up to a dozen times closer on a line than lines are to each other
    most_own_width_share: float = (
        0.2  # of the neighbours of a point that gets a normal across lines: noise widens lines
    )
    across_neighbours: int = 24  # among which points on other lines are looked for
    most_along_cosine: float = 0.5  # of the angle, 60 degrees, between the line and a point off it
    own_line_weight: float = 2.0  # on the distances of points of the same line
    least_opposite_cosine: float = 0.3  # of the turn between both sides, at least 107 degrees
    most_second_ratio: float = 3.0  # of the distances of the points on both sides; beyond, only the nearer one counts
    least_confidence: float = 0.9  # of the winding number of few points that decides alone: 0.86 and more on tori and
    # spheres, 0.3 to 0.94 on boxes, whose edges it rounds, and below 0.6, or that of an open surface, on terrain
    chunk_points: int = 50_000  # handled at a time, which bounds memory


@dataclass(frozen=True)
class OrientationParameters:
    """Signs of normals (`ingest.orientation`)."""

    local_neighbours: int = 12  # of the tangent planes for propagation: keeps thin walls apart
    smooth_neighbours: int = 24  # and in a second attempt: steadier in noise
    off_plane_penalty: float = 2.0  # in the second attempt, against edges of the tree that leave the plane
    gauss_points: int = 2000  # at most, in the dense system of Gauss's formula, a matrix of 96 MB
    consistent_points: int = 6000  # at most, in the refinement, which needs two matrices of 144 MB
    most_disorder: float = 0.25  # of the winding number, above which signs are doubtful in places, or the scan is open
    closed_outwardness: float = 0.75  # from which on normals are those of a closed surface; half a sphere has 0.6
    closed_ratio: float = 1.1  # of disorders, and of outwardness, up to which signs by winding number are then taken
    better_disorder_ratio: float = 0.8  # that the global methods must reach against propagation to replace it
    most_conflicting: float = 0.003  # share of pairs of neighbours, see `Agreement`: 0.005 to 0.09 for signs by winding
    # number in open scenes, where propagation has up to 0.002


@dataclass(frozen=True)
class SmoothingParameters:
    """Smoothing by moving least squares (`ingest.smooth`)."""

    least_neighbours: int = 9  # with the point itself, for a quadric of 6 coefficients; points with fewer stay
    most_neighbours: int = 512  # which bounds the time
    neighbour_surplus: float = 2  # factor on the expected number within the width, for denser regions
    chunk_values: int = 4_000_000  # of the quadrics' design matrices at a time: 32 MB
    ridge: float = 1e-9  # regularisation, as a share of the system's trace
    most_move_widths: float = 0.5  # a point that would move farther stays: its quadric does not describe the surface


@dataclass(frozen=True)
class SurveyParameters:
    """The facts of a cloud (`ingest.survey`)."""

    points: int = 10_000  # at which neighbourhoods are measured; more would not change the figures
    border_neighbours: tuple[int, int] = (24, 40)  # both must show a gap: by chance, one may
    border_points: int = 2000  # from which borders show though the noise cannot be determined
    density_neighbour: int = 8  # whose distance measures the density
    border_gap_degrees: float = (
        120.0  # widest angle without neighbours, seen along the normal: 180 at a straight border
    )
    open_share: float = 0.005  # of points at a border, above which the scan is open
    length_tolerance: float = 0.05  # by which the length of unit normals may differ from 1


@dataclass(frozen=True)
class DoubleWallParameters:
    """Two layers of points where there is one surface (`ingest.double_walls`)."""

    places: int = 500  # at which the test is made, for a share to within a few per cent
    cylinder_radius_spacings: float = 3.0  # wide enough for 24 points
    cylinder_half_height_spacings: float = 12.0  # the largest offset that can be found
    least_facing_cosine: float = 0.5  # normals within 60 degrees face the same way
    least_points: int = 24  # that face the same way: four for each coefficient of a quadric
    separation_deviations: float = 5.0  # least offset; 2.7 for a normal distribution cut in two, 3.5 for a uniform one
    least_offset_spacings: float = 0.05  # the remainder of a quadric in an exact scan may look like two closer layers
    least_layer_share: float = 0.2  # of the points, in the smaller layer
    most_centre_distance: float = 0.5  # of the two layers in the plane, over the points' spread, or it is a step
    most_between_share: float = 0.1  # of points between the layers that face the other way, as at a thin wall
    least_place_share: float = 0.05  # of the places with two layers, above chance
    least_place_share_estimated: float = 0.15  # the same where normals were estimated and may be wrong at thin walls


@dataclass(frozen=True)
class IngestParameters:
    """All tuning constants of ingest."""

    least_points: int = 10  # fewer do not determine a closed surface
    outliers: DensityOutlierParameters = DensityOutlierParameters()
    clusters: IsolatedClusterParameters = IsolatedClusterParameters()
    noise: NoiseParameters = NoiseParameters()
    normals: NormalParameters = NormalParameters()
    lines: LineParameters = LineParameters()
    orientation: OrientationParameters = OrientationParameters()
    smoothing: SmoothingParameters = SmoothingParameters()
    survey: SurveyParameters = SurveyParameters()
    double_walls: DoubleWallParameters = DoubleWallParameters()
