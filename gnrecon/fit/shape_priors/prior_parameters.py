"""Parameters of the shape priors: one frozen dataclass for each method, and `ShapePriorParameters` for all of them.

Lengths that end in `_radii` are multiples of a point's disk radius (`gnrecon.geometry.signed_distance.Density`), which
is about half of the distance between neighbours. No paper prescribes these values: they are empirical, and the comments
give the meaning and the reason or the observation behind each, where one is on record.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DetectionParameters:
    """Detection of planes, cylinders and spheres, see `primitive_detection`."""

    angle_degrees: float = 10.0  # between a point's normal and its primitive's at most
    spheres: bool = False  # whether spheres are detected besides planes and cylinders
    sparse: bool = False  # whether planes may be sampled less densely than the rest, as faces scanned at grazing angles
    min_points: int = 12  # of a primitive: more than twice the five unknowns of a cylinder
    max_primitives: int = 12  # accepted from one round of proposals
    max_failures: int = 30  # failed proposals in a row that end a round: on machine parts one in 30 holds
    rounds: int = 3  # of proposals among the points that are left
    proposals: int = 200  # of each kind in a round
    max_refits: int = 6  # least-squares fits of a proposal while its support grows
    flat_neighbours: int = 12  # that decide whether a point proposes a plane
    flat_share: float = 0.3  # of them that lie on the plane at least
    flat_reach_radii: float = 3.0  # beyond which a neighbour does not count
    pair_reach_radii: float = 16.0  # between the two points of a cylinder or sphere
    min_pair_degrees: float = 12.0  # between their normals: below, the axis is too uncertain
    max_pair_degrees: float = 120.0  # and at most
    min_round_radii: float = 1.5  # radius of a cylinder or sphere; points do not resolve smaller ones
    max_cylinder_radii: float = 30.0  # radius of a cylinder; a larger one is nearly a plane
    max_center_miss: float = 0.2  # distance of two normals' closest points on a sphere, over its radius
    min_bend_degrees: float = 25.0  # of a round primitive's normals from their mean; less could be a plane
    rim_reach_radii: float = 5.0  # around a primitive, where points that nearly belong to it are counted
    rim_angle_degrees: float = 30.0  # between their normals and its own
    plane_rim_share: float = 1.0  # most of them, over the points on a plane
    round_rim_share: float = 1.2  # the same on a round primitive, whose rims are often bevelled
    redundant_share: float = 0.5  # of a proposal's points on an accepted primitive that remove the proposal
    normal_weight_radii: float = 0.3  # height that counts as much as a normal's difference of one, in fits


@dataclass(frozen=True)
class BilateralParameters:
    """Bilateral averaging of points and normals, see `bilateral_filter`."""

    passes: int = 3  # over the normals, and then as many over the points
    reach_widths: float = 2.0  # of the neighbourhood; beyond it weights are below 1/50
    max_neighbours: int = 100  # of a point, for time and memory
    height_deviations: float = 3.0  # height at which a weight falls to 1/e, in deviations of the heights
    min_weight_share: float = 0.2  # of the largest weight, from which on a height counts for that deviation
    min_height_widths: float = 1e-3  # least such height: on exact planes heights are rounding errors
    deviation_points: int = 20_000  # that estimate the deviation; their standard error is below 1 %
    chunk_points: int = 2_500  # averaged at a time by each thread, so that memory does not grow with the scan


@dataclass(frozen=True)
class EdgeParameters:
    """Samples towards edges and between points, see `edge_completion`."""

    neighbours: int = 40  # of a point at most
    reach_radii: float = 3.0  # to a neighbour at most
    same_face_degrees: float = 15.0  # between the normals of one face at most
    edge_degrees: float = 35.0  # between normals on two sides of an edge at least
    opposed_degrees: float = 150.0  # and at most: beyond, they are the two sides of a sheet
    min_face_neighbours: int = 3  # on a point's own face; outliers have fewer
    max_face_height_radii: float = 0.25  # mean height of these over its plane
    max_edge_radii: float = 2.5  # from a point to the edge
    max_aside_radii: float = 1.5  # between the two faces' points, along the edge
    min_edge_radii: float = 0.15  # from a point to an edge that needs a sample
    edge_fraction: float = 0.8  # of the way to the edge at which the sample lies: on the edge it has two normals
    other_face_degrees: float = 37.0  # between two other faces' normals, to both of which a point is extended
    contradiction_radii: float = 1.0  # from a sample to a point that may contradict it
    contradiction_height_radii: float = 0.15  # of that point over the face's plane
    edge_spacing_radii: float = 0.35  # of samples near edges
    face_spacing_radii: float = 0.5  # of samples between points
    midpoint_reach_radii: float = 2.0  # between two points with a sample between them
    midpoint_degrees: float = 25.0  # between their normals
    midpoint_height_radii: float = 0.2  # half the difference of their heights over each other's planes: more is noise


@dataclass(frozen=True)
class BoreParameters:
    """Walls of round bores, completed where they have no points, see `bores`."""

    # Heights and normals of 8 points are 24 equations for a cylinder's five unknowns.
    detection: DetectionParameters = DetectionParameters(min_points=8, proposals=1000, max_primitives=40)
    max_bore_radii: float = 10.0  # radius of a bore
    max_pairs: int = 10_000_000  # of points that may face each other, each twice, for memory
    max_open_degrees: float = 150.0  # widest angle around the axis without a point
    max_spacing_share: float = 0.5  # of the radius, between samples: 12 around a narrow bore
    max_gap_diameters: float = 10.0  # length of a gap, in diameters of the bore: as deep as drills reach
    backing_radii: float = 2.0  # behind the wall, where the winding number shows solid
    free_share: float = 0.5  # of the radius, from the axis to all points: else the bore ends there
    unseen_radii: float = 2.0  # from every point to a sample


@dataclass(frozen=True)
class HoleCompletionParameters:
    """Planes and cylinders extended across holes, see `hole_completion`."""

    detection: DetectionParameters = DetectionParameters()
    bores: BoreParameters = BoreParameters()
    hole_points: int = 6000  # in which holes are looked for; what so few do not show is small
    surface_points: int = 15_000  # in which primitives are looked for
    passes: int = 3  # as an extended face shows where others end
    min_gain_share: float = 0.05  # of new samples in a pass that another follows
    min_points: int = 50  # of a scan; nothing is extended from fewer
    min_planar_share: float = 0.2  # of points on planes: 0.4 to 1 on machine parts, at most 0.1 on free-form shapes
    lattice_step_radii: float = 2.0  # cell of the lattice in which holes are looked for
    max_lattice_cells: int = 500_000  # about as many, where points crowd and disks are small
    margin_units: float = 0.1  # of the lattice around the points, in unit coordinates
    hole_distance_radii: float = 3.0  # from a hole's cells to all points
    max_winding_offset: float = 0.3  # of the winding number in a hole from one half
    winding_slack: float = 0.05  # by which it is farther off at all nodes around a place that is not looked at
    min_hole_cells: int = 12  # of a hole; fewer are chance
    max_holes: int = 16  # the largest ones, for time
    max_hole_units: float = 1.2  # width of a hole, unit coordinates: a wider one is a side that was not scanned
    cut_cells: int = 26  # along the longest side of a hole's lattice: the cut takes time by their cube
    min_cell_radii: float = 0.8  # of that lattice
    room_radii: float = 4.0  # around the hole
    side_reach_radii: float = 2.5  # to points whose planes decide the side of a cell
    side_points: int = 3  # that must agree
    min_side_radii: float = 0.3  # of the cell off their planes
    max_winding_error: float = 0.02  # of the winding number from 0 or 1, elsewhere, for a cell to be fixed
    search_radii: float = 12.0  # around a hole, where primitives are looked for
    touch_radii: float = 6.0  # from the hole to some of a primitive's points
    min_touching_points: int = 6  # that are so near
    extension_widths: float = 3.0  # of a primitive's scanned part, by which it is extended at most
    width_deviations: float = 3.5  # width of that part: 3.46 deviations of a uniform strip along its narrow side
    min_height_radii: float = 0.3  # of a primitive's points over it, when they have no noise
    max_height_radii: float = 0.8  # and at most
    height_roughness: float = 2.5  # between both: in roughnesses of the scan
    unseen_radii: float = 2.0  # from every point to a sample
    sample_spacing_radii: float = 2.0  # as dense as the points are
    max_samples_per_cell: int = 24  # along its side, for memory


@dataclass(frozen=True)
class SnappingParameters:
    """Points snapped to the primitives from which noise does not distinguish them, see `snapping`.

    Deviations are those of the noise. The rims' share is lower than elsewhere: with 1.0, 0.8 of a torus's 3,000 points
    were snapped to cylinders that noise of a quarter of their disks cannot rule out.
    """

    detection: DetectionParameters = DetectionParameters(spheres=True, plane_rim_share=0.5, round_rim_share=0.5)
    min_snapped_share: float = 0.5  # of all points: 0.8 and more on machine parts, 0.2 on a gyroid
    first_degrees: float = 10.0  # between averaged normals and their primitive's, when looked for first
    narrow_degrees: float = 20.0  # and when looked for among points that were averaged over less
    narrow_width_radii: float = 2.0  # of that averaging, for bores narrower than the first one
    narrow_normal_scale: float = 0.6  # of that averaging
    search_points: int = 6000  # among which primitives are looked for at a time
    rounds: int = 3  # of the search while it finds any
    max_height_deviations: float = 3.0  # of a point over its primitive
    reach_radii: float = 3.0  # from a point to others of its primitive
    normal_weights: tuple[float, ...] = (0.3, 0.0, 0.0)  # of the fits; averaged normals are wrong in narrow bores
    exact_radii: float = 0.02  # noise below which heights need no test
    min_height_radii: float = 0.05  # granted in the search, where noise is smaller
    rim_reach: float = 3.0  # over `reach_radii`, where a shape that bends away from its primitive is noticed
    rim_deviations: float = 7.0  # of points there over the primitive
    rim_degrees: float = 30.0  # between their normals and its own
    max_rim_share: float = 0.1  # of such points, over its own


@dataclass(frozen=True)
class UnorientedSnappingParameters:
    """Points with estimated normals snapped to primitives, see `unoriented_snapping`."""

    snapping: SnappingParameters = SnappingParameters()
    min_noise_radii: float = 0.1  # assumed in the search, as estimated normals are rough
    max_noise_radii: float = 0.2  # with more, few points fit several shapes
    first_degrees: float = 20.0  # between estimated normals and their primitive's, in the first search
    later_degrees: tuple[float, ...] = (30.0, 40.0, 30.0, 40.0, 30.0)  # and after each new estimate
    max_turn_degrees: float = 75.0  # of a point on a primitive by place, while normals still improve
    min_first_share: float = 0.3  # of points on primitives after the first search; else no machine part


@dataclass(frozen=True)
class ResamplingParameters:
    """Samples spread over primitives up to where they meet, see `resampling`."""

    noise_radii: float = 0.005  # in the search for primitives: only clean scans are resampled
    angle_degrees: float = 10.0  # between a point's normal and its primitive's
    min_plane_points: int = 3  # of a small plane, whose normals agree much better than others
    plane_degrees: float = 2.0  # between them and the plane's
    bent_degrees: float = 40.0  # up to which a different normal nearby shows that the plane is bent
    max_plane_points: int = 2000  # left over, among which such planes are looked for, one by one
    target_samples: int = 6000  # about, or as many as the points if these are more
    max_samples_per_point: float = 12.0  # for time, on scans of few points
    max_points: int = 15_000  # of a scan; denser ones resolve their edges
    sure_radii: float = 2.0  # from a point, within which a sample needs no neighbours
    reach_radii: float = 3.0  # from a point, within which a sample may close a gap
    reach_cells: float = 24.0  # the same at most, in spacings of the samples
    point_spacings: float = 0.6  # from a sample to every point of its face
    neighbour_spacings: float = 1.2  # to a sample of another face, or a point, that closes an open side
    barrier_radii: float = 3.2  # of the piece of another face around its point that ways cannot cross
    passes: int = 2  # by winding number and open sides: what extends past a sheet's edge looks two-sided at first


@dataclass(frozen=True)
class SharpShapeParameters:
    """Which scans are sharp, and the belief about them, see `sharp_shape`.

    Differences are lengths of the difference of two unit normals.
    """

    max_points: int = 30_000  # of a scan; denser ones round their edges over a short spacing only
    neighbours: int = 6  # of a point that are compared with it
    edge_difference: float = 0.8  # from which on there is an edge between two normals (47 degrees)
    bend_difference: float = 0.4  # from there to `edge_difference` round shapes have more neighbours than sharp ones
    opposed_difference: float = 1.8  # from which on they are the two sides of a sheet (128 degrees)
    min_edge_share: float = 0.01  # of neighbours across an edge
    min_edge_ratio: float = 3.0  # of these over the bent ones
    averaging_width_radii: float = 4.0  # of rough points; validation points hardly prefer another width
    averaging_normal_scale: float = 0.4  # of that averaging
    max_raw_roughness_radii: float = 0.05  # of faces, beyond which points are averaged
    max_roughness_radii: float = 0.03  # of faces after that
    flat_bend_degrees: float = 1.0  # median bend up to which single points, as on a plate's sides, show edges
    min_agreement: float = 0.97  # of samples not contradicted: 0.99 on sharp shapes, 0.94 on edges rounded by scanners
    position_noise_radii: float = 0.02  # assumed for all samples
    exact_length_radii: float = 2.6  # of features, for scans that were not averaged
    exact_angle_radians: float = 0.2  # assumed noise of their normals
    averaged_length_radii: float = 3.2  # of features, for averaged scans
    averaged_angle_radians: float = 0.5  # larger: near an edge noisy points may have the other face's normal


@dataclass(frozen=True)
class BallFitParameters:
    """Scans of a ball, see `ball_fit`."""

    min_points: int = 30  # fewer do not distinguish a sphere from a quadric
    max_height_deviations: float = 5.0  # of a point, over the deviation of all heights
    exact_share: float = 1e-6  # of the radius, below which heights are rounding errors
    max_noise_radii: float = 0.5  # deviation of the heights; with more, neighbours could be on another shape
    max_gap_degrees: float = 45.0  # from any direction to a point; a wider gap may be no ball, as under a dome
    min_samples: int = 1000  # of a whole sphere; they leave errors of 1e-6 of the radius
    min_spacing_share: float = 0.6  # of the samples' spacing, from a filling sample to every point


@dataclass(frozen=True)
class ShapePriorParameters:
    """Parameters of all shape priors of a fit."""

    edges: EdgeParameters = EdgeParameters()
    holes: HoleCompletionParameters = HoleCompletionParameters()
    snapping: SnappingParameters = SnappingParameters()
    unoriented: UnorientedSnappingParameters = UnorientedSnappingParameters()
    resampling: ResamplingParameters = ResamplingParameters()
    sharp: SharpShapeParameters = SharpShapeParameters()


@dataclass(frozen=True)
class ConvexCompletionParameters:
    """Parameters of the completion of few points in convex position (`fit/shape_priors/convex_completion.py`).

    Parameters
    ----------
    most_points : more leave a free field little room between them
    most_depth_spacings : how deep a point may lie beneath the hull, in median distances of nearest points
    samples : of the whole hull, about
    """

    most_points: int = 100
    most_depth_spacings: float = 0.1
    samples: int = 300
