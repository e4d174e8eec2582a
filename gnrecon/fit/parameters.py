"""Tuning constants of the fit, one frozen dataclass for each method; `FitParameters` holds those of the default fit.

A radius is that of the scan, which lies in the unit ball. A spacing is the median distance between neighbours, and a
disk radius that of the disk of one point. Values without a source were chosen on the shapes of docs/benchmarks.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from gnrecon.fit.shape_priors.prior_parameters import BallFitParameters, ShapePriorParameters


@dataclass(frozen=True)
class TwoLevelParameters:
    """The default fit: a global field and local corrections (`fit.two_level`)."""

    global_field_points: int = 5000  # most that the global field is fitted to: few units resolve no more
    validation_one_in: int = 6  # one point in so many is a validation point
    most_validation_points: int = 2000  # where the local fields are not solved by blocks; more change no choice
    most_refitted_points: int = 800  # up to which the network sees all in its last steps: more, local fields fit well
    global_time_share: float = 0.4  # of the whole fit, measured, for the progress bar


@dataclass(frozen=True)
class LocalFieldParameters:
    """The cubes of local corrections (`fit.local_fields`, `fit.blocks`)."""

    cube_edge_lengths: float = 3.5  # in length scales: longer cubes need more features, shorter ones overlap more
    penalised_edge_lengths: float = 5.0  # of cubes under curvature penalties, as seams of more cubes bend the surface
    penalised_feature_ratio: int = 2  # of their features and those of other cubes
    data_margin_disk_radii: float = 2.0  # a cube is also fitted to data so far beyond it
    least_points: int = 4  # of a cube; fewer do not define a surface
    group_cells: int = 4  # edge of the boxes whose cubes share their samples of free space, in cells; a power of two
    most_length_stretch: float = 4.0  # most a cube's length scale may exceed the scan's where points are sparse
    length_features: int = 300  # most that the likelihood of a length is computed with
    length_step: float = 2.0**0.5  # between the lengths of which a cube's own data chooses
    most_length_steps: int = 2  # from the scan's length
    selection_time_share: float = 0.2  # of the local fit, until length and noise are chosen, for the progress bar


@dataclass(frozen=True)
class CoarserFieldParameters:
    """Local fields of longer lengths, on which those of a clean scan may be fitted (`fit.local_fields`)."""

    least_points: int = 500  # of the scan: between fewer, gaps are nothing special
    length_ratio: float = 3.0  # of their length scale and the scan's
    most_length_radii: float = 0.25  # of theirs: longer features are those of the global field
    least_rms_noises: float = 10.0  # that the global field is wrong by, over the noise: more noise hides steps
    far_share: float = 0.01  # of the points, that may be a length of the scan's, or more, off the global field
    point_share: float = 1 / 3  # of the points, that those of the least length are fitted to
    features: int = 300
    gap_samples: int = 10_000  # of space about the points
    gap_spread_lengths: float = 2.0  # standard deviation of their distance along each axis
    least_gap_samples: int = 2  # of an uncertain sign, clear of the points, which a closed scan has none of


@dataclass(frozen=True)
class FreeSpaceParameters:
    """Samples of free space in a cube (`fit.free_space`), at the nodes of a lattice."""

    clearance_disk_radii: float = 3.5  # their least distance from the data: nearer, the coarse distance is none
    near_step_lengths: float = 0.41  # at most, of the lattice, on which wrong signs are looked for about the data
    far_stride: int = 2  # nodes between those that are samples of the whole cube
    near_reach_lengths: float = 1.5  # from the noisy data to its farthest samples; beyond, corrections have faded
    near_clearance_disk_radii: float = 1.0  # their least distance; nearer, points do not tell the side
    near_clearance_noises: float = 3.0  # and so many standard deviations of the points' noise more
    near_bound_share: float = 0.25  # of the coarse distance, that the field gets where its sign is wrong there
    least_field_share: float = 0.7  # of the coarse distance: a field between this
    most_field_share: float = 1.5  # and this share of it needs no correction
    sign_bound_share: float = 0.5  # of the coarse distance, that the field must keep where the sign is certain


@dataclass(frozen=True)
class OutlierParameters:
    """Outliers near the surface, by the residuals of a first global field (`fit.consistency`)."""

    neighbours: int = 8  # whose median a point's residual is compared with
    quantile: float = 0.95  # of all differences: what points of the surface stay below
    quantile_factor: float = 4.0  # an outlier's difference is at least so many times that quantile
    least_distance_disk_radii: float = 0.75  # and at least so long, so that clean scans have none
    least_share: float = 0.002  # of the points; fewer are chance, or edges, and do no harm
    most_share: float = 0.04  # of the points; more mean that the field does not fit
    least_points: int = 100  # below, the quantile rests on fewer than five points


@dataclass(frozen=True)
class LinearFieldParameters:
    """The linear global field, with which the networks are compared (`fit.linear_field`)."""

    most_units: int = 1000  # with the shortest length
    least_units: int = 300
    wrong_sign_share: float = 4e-3  # of free space, that heavier normals may give the wrong sign
    length_scales_radii: tuple[float, ...] = (0.25, 0.5, 1.0)  # candidates
    # Candidates of the normals' weight: the length over which an angle counts as a height. The first is the default.
    normal_reaches_spacings: tuple[float, ...] = (0.4, 1.2, 3.0, 8.0, 20.0)
    least_length_spacings: float = 4.0  # shorter features oscillate between the points
    tie_share: float = 0.01  # by which a longer length scale may predict worse than the best
    selection_features: int = 300
    selection_points: int = 2000
    selection_volume_samples: int = 2000
    position_noise_spacings: float = 0.1  # assumed in the selection; that of normals is this over the reach, in radians
    least_validation_points: int = 5  # with fewer, nothing is selected
    field_deviation_radii: float = 1.0  # prior standard deviation of the field


@dataclass(frozen=True)
class NetworkTermParameters:
    """The rows of the global network's Gauss-Newton steps (`fit.global_network`)."""

    data_rows: int = 2500  # most points of a step; free space has as many samples, and the eikonal residual half
    pool_samples: int = 20_000  # of free space, of which each step draws a part
    trial_samples: int = 60_000  # places that are searched for wrong signs before the network is widened
    # One-sided bounds of f in free space, as shares of the coarse distance: the medial axis of a smooth field is round.
    least_share: float = 0.5
    most_share: float = 1.5
    free_space_deviation_share: float = 0.15  # standard deviation of these bounds, as a share of the distance
    film_deviation_share: float = 0.05  # likewise across holes, of the data's distance; exact points outweigh 0.15
    near_spacings: float = 2.0  # standard deviation of the places near the surface
    near_eikonal_deviation: float = 0.1  # of |grad f| there
    far_eikonal_deviation: float = 0.3  # of |grad f| in the box, where a distance has kinks
    robust_degrees_of_freedom: float = 4.0  # of Student's t distribution of the data (Lange, Little and Taylor 1989)
    least_deviation: float = 1e-3  # in disk radii and radians; below, rounding would decide
    # Radians, of normals that were estimated from neighbourhoods, and from all points of a sparse scan with noise.
    least_estimated_deviation: float = 0.3
    least_sparse_deviation: float = 0.6
    least_slope: float = 0.3  # of the field along a normal, in a distance |f| / slope
    least_validation_points: int = 10  # with fewer, the seen points are scored
    most_validation_points: int = 5000  # whose score has a standard error of a percent or two
    wrong_sign_score: float = 100.0  # disk radii for a field that is wrong in all of free space: sheets cost most
    eikonal_measured: int = 2000  # places at which the history's eikonal residual is measured


@dataclass(frozen=True)
class NetworkLadderParameters:
    """The widths of the global network, and its steps (`fit.network_ladder`)."""

    depth: int = 3  # hidden layers
    widths: tuple[int, ...] = (16, 24)  # the others where points are few, see `NetworkLadder`
    starts: int = 3  # of the first width, of which the best is fitted further, and widened
    trial_steps: int = 9  # Gauss-Newton steps of each; the one ahead by then is the best of 15 steps, or nearly so
    first_steps: int = 15  # of the best in all, or of a single start; and then most further ones
    # Most points of these steps, which find the shape as a whole: half as many again as the network has parameters.
    first_rows: int = 1000
    steps: int = 15  # of each further width
    patience_steps: int = 8  # without a better score
    least_gain: float = 0.01  # share of the score whose loss ends the steps
    gain_standard_errors: float = 2.0  # by which a wider network must predict better, and any network than linear field
    damping: float = 1e-2  # of the first step of each width
    refit_steps: int = 12  # with the validation points, once they have chosen everything
    refit_length: float = 0.5  # of these steps: points are drawn for each, so that shorter ones average over more
    points_per_member: int = 2000  # a scan of a half or a third of so many seen points gets two or three networks
    most_members: int = 4
    hopeless_ratio: float = 2.0  # of the first width's score and the linear field's, above which no wider one is tried


@dataclass(frozen=True)
class GlobalFieldParameters:
    """The smooth global field (`fit.global_field`)."""

    linear: LinearFieldParameters = LinearFieldParameters()
    terms: NetworkTermParameters = NetworkTermParameters()
    ladder: NetworkLadderParameters = NetworkLadderParameters()
    exact_score: float = 0.1  # of the linear field, disk radii and radians: below, a network has nothing to gain


@dataclass(frozen=True)
class InitialisationParameters:
    """Linear starts of sine networks (`fit.initialisation`)."""

    length_scale_radii: float = 0.12  # of the features of one wide layer; measured, docs/research
    degrees_of_freedom: float = 4.0  # of the Student t distribution of their frequencies: a Matern kernel of nu = 2
    ridge: float = 1e-8  # over the number of points: as little as rounding allows
    rounds: int = 3  # solves, each with samples where the last one had the wrong sign
    trial_factor: int = 3  # volume samples that are searched for wrong signs, over those of a solve
    wrong_sign_repeats: int = 5  # how often such a sample counts in the next solves: once, and horns grow
    ridge_attempts: int = 6  # each with ten times the ridge
    first_layer_frequency: float = 4.0  # standard deviation, per radius, in networks of several layers
    # Share of Sitzmann's bound that weights between layers start with: with all of it, the last layer's features are so
    # rough that a network of 16 units does not find a gyroid in 30 steps; docs/research/2026-11-26-default-network.md
    hidden_weight_share: float = 0.5
    spectral_ridge: float = 1e-4  # of their last layer, per unit of the terms' weight
    spectral_samples: int = 4000  # points and volume samples of that solve


@dataclass(frozen=True)
class LocalSolveParameters:
    """The linear solve of one cube (`fit.local_solve`)."""

    correction_rms_factor: float = 3.0  # prior standard deviation of the correction, over the residuals' RMS
    volume_deviation_share: float = 0.5  # standard deviation in free space, as a share of the distance from the data
    faded_share: float = 0.1  # of the prior standard deviation, that a correction has left far from the data
    bound_passes: int = 5  # most active-set passes, while samples have the wrong sign, or too little far away
    bound_deviation_share: float = 0.05  # first standard deviation of one that is alone, as a share of the distance
    bound_tightening: float = 0.65  # of that deviation from pass to pass, for samples that stay beyond
    damping_attempts: int = 6  # each with ten times the damping
    robust_deviations: float = 5.0  # of a misfit, beyond which a point loses its weight; by chance one in two million
    robust_passes: int = 3  # most solves for weights
    least_rest: float = 1e-6  # of one less a leverage, which rounding may make zero
    chunk_points: int = 16_384  # points whose features are held at once, so that memory does not grow with density


@dataclass(frozen=True)
class MarginalLikelihoodParameters:
    """Noise by the marginal likelihood of a Gaussian process (`fit.marginal_likelihood`)."""

    position_noises_disk_radii: tuple[float, ...] = (
        *(0.005, 0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5),
    )  # candidates
    angle_noises_radians: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.13, 0.17, 0.23, 0.3, 0.4)
    first_index: tuple[int, int] = (6, 5)  # in both tables, where the search begins
    strides: tuple[int, ...] = (2, 1)  # of the search, coarse to fine
    patches: int = 20
    patch_points: int = 60  # nearest points of a patch; the covariance has four rows for each
    features: int = 700  # that make up the covariance


@dataclass(frozen=True)
class SurfaceLikelihoodParameters:
    """Length, size and noise where normals are estimated (`fit.marginal_likelihood`)."""

    patches: int = 20
    patch_points: int = 200  # nearest foot points of a patch, which several lengths span
    features: int = 700  # that make up the covariance
    ratios: tuple[float, ...] = tuple(2.0 ** (step / 2) for step in range(-8, 15))  # of size and noise, candidates
    most_height_medians: float = 6.0  # of a point over the median of all heights
    least_slope: float = 0.2  # of the field at a point, in the height |f| / slope
    angle_radians: float = 1.0  # deviation of estimated normals in the solve: they say which side is out


@dataclass(frozen=True)
class CleanScanParameters:
    """Detection of scans whose noise need not be selected (`fit.marginal_likelihood.clean_noise`)."""

    neighbours: int = 5
    reach_disk_radii: float = 2.0  # most distance of a neighbour
    most_normal_angle_degrees: float = 25.0  # between normals on one smooth piece of surface
    # Median pair height, over a disk radius or the distance if longer, up to which a scan is clean. Vertices of scanned
    # meshes have 0.017 to 0.024, a noise of 0.08 disk radii gives 0.06, range scans 0.14 and more.
    most_height: float = 0.04
    least_pairs: int = 20  # fewer decide nothing
    most_points: int = 50_000  # whose neighbours are looked up
    least_residual_disk_radii: float = 0.01  # RMS of the global field's residuals; below, there is nothing to gain
    least_position_noise_disk_radii: float = 0.005
    least_angle_noise_radians: float = 0.01
    angle_over_position_noise: float = 2.0  # if neighbours are a disk radius apart, normals alone make such heights
    estimated_angle_noise_radians: float = 0.1  # of estimated normals, whose errors are alike among neighbours


@dataclass(frozen=True)
class ModelSelectionParameters:
    """Length scale and noise by cross-validation (`fit.model_selection`)."""

    lengths_disk_radii: tuple[float, ...] = (2.0, 2.8, 4.0, 5.6, 8.0, 11.3, 16.0, 22.6)  # candidates, sqrt(2) apart
    short_length_disk_radii: float = 1.4  # another, where normals have deviations; 1.0 makes handles in thin walls
    position_noises_disk_radii: tuple[float, ...] = (0.02, 0.1, 0.3, 0.8)  # candidates
    angle_noises_radians: tuple[float, ...] = (0.03, 0.1, 0.3)  # candidates
    tie_share: float = 0.025  # by which a score may exceed the best and yet count as equal
    gain_standard_errors: float = 2.0  # by which a longer length must predict a clean scan better
    search_standard_errors: float = 1.0  # by which the next length must predict any other scan better, to go on
    least_position_noise_disk_radii: float = 1e-3  # below, rounding would decide
    most_noise_factor: float = 2.0  # between the noise that is tried with estimated normals, and that of the survey
    first_length_index: int = 2  # of the length that is tried first
    # As many patches as predict each validation point so often, on average, between the least and the most.
    predictions: int = 2
    least_patches: int = 10
    most_patches: int = 80
    patch_validation_points: int = 20  # that each patch predicts
    # Points up to which estimated normals are ignored, and errors taken for independent. Normals of denser scans are
    # means over little of the surface; where scans do not quite match, a field through all of them is the likeliest.
    sparse_points: int = 20_000
    most_patch_points: int = 2500  # more change no score, and time grows with the square of the length
    features: int = 300
    least_slope: float = 0.05  # of the field along the normal, in a distance |f| / slope
    margin_lengths: float = 1.5  # how far a patch's data reaches beyond what it predicts, in length scales


@dataclass(frozen=True)
class ObjectiveParameters:
    """Terms of a fit of one network and the scene that they are sampled in (`fit.objective`)."""

    chunk_points: int = 16_384  # most points that are evaluated together
    chunk_bytes: int = 64_000_000  # most memory of one layer's activations
    factor_bytes: int = 1_500_000_000  # most memory of the stored factors of the Jacobian
    normal_reach_spacings: float = 0.4  # length over which an angle of a normal counts as a height
    least_normal_reach_radii: float = 0.012
    eikonal_reach_spacings: float = 0.05
    eikonal_samples: int = 3000
    distance_weight_per_sample: float = 1e-4  # times volume samples over points: sparse data needs free space more
    least_distance_weight: float = 4e-4  # the denser the data, the steeper a fit can turn in free space
    box_margin_radii: float = 0.1  # how far the box reaches beyond the data
    volume_samples: int = 10_000
    shell_spacings: float = 4.0  # standard deviation of the samples near the data


@dataclass(frozen=True)
class SingleNetworkParameters:
    """Fits of one network (`fit.single_network`, `fit.fit_options`)."""

    wide_steps: int = 4  # of Gauss-Newton after the start
    deep_steps: int = 120
    adam_steps: int = 2000
    lbfgs_steps: int = 40  # each of 20 iterations
    least_points_to_refine: int = 1000  # docs/research/2026-11-21-one-wide-layer.md
    units_per_point: int = 3  # of one wide layer
    least_units: int = 1000
    points_per_unit: int = 4  # more units than data rows only make it slower and less smooth
    most_sparse_units: int = 2000
    most_units: int = 3000
    start_points: int = 20_000  # most data points of the linear start of one wide layer
    wide_start_time_share: float = 0.4  # of the fit, measured, for the progress bar
    deep_start_time_share: float = 0.05
    first_points: int = 600  # of the first step of a deep fit, at least one for so many of its parameters:
    parameters_per_point: int = 4
    points_growth: float = 1.1  # of the points from step to step, up to those of the global network's steps
    least_gain: float = 0.01  # share of the left-out points' score whose loss ends a deep fit
    # A network that has to follow the detail, too, is not held to a distance as firmly as the smooth global one.
    near_eikonal_deviation: float = 0.3
    far_eikonal_deviation: float = 1.0
    least_points_to_hold_out: int = 1000
    held_out_one_in: int = 20
    held_out_patience_steps: int = 8
    subspace_units: int = 400  # whose frequencies a step of a wide fit frees, so that J^T J stays small
    step_points: int = 4000  # most data points of a step of a wide fit
    krylov_tolerance: float = 0.3  # relative error in the energy norm: steps that a search shortens need no better
    least_step_share: float = 0.1  # of a step of a deep fit, down to which it is shortened before the damping rises


@dataclass(frozen=True)
class PenaltyFitParameters:
    """Curvature penalties on the fitted surface (`fit.penalties.regularisers`, `fit.penalties.surface_penalties`)."""

    minimal_weight: float = 1e-2  # default of `fill`
    developable_weight: float = 1e-3  # default of `prior`
    crease_curvature: float = 8.0  # Gauss curvature, per squared radius, from which a place counts as a crease
    global_steps: int = 8  # most Gauss-Newton steps of the global field
    cube_steps: int = 3  # of a cube, which is nearly linear, because the global field has done most of it
    least_decrease_share: float = 0.01  # of the loss, for a step to count as progress
    patience_steps: int = 2  # without progress
    newton_steps: int = 3  # that bring points onto the surface
    global_step_radii: float = 0.05  # most that a point moves in one of them
    cube_step_lengths: float = 0.5
    samples_per_length: float = 2.0  # surface samples along one length scale of the features
    rounds: int = 2  # of the global field, each with more samples where the last one has the wrong sign
    ridge_attempts: int = 8  # each with ten times the ridge
    free_space_weight: float = 100.0
    free_space_clearance_radii: float = 0.05  # distance from the scan at which free space begins
    free_space_factor: int = 3  # its samples, over the volume samples of the fit
    most_free_space_distance_radii: float = 0.03  # the most that |f| is required to be there
    near_disk_radii: float = 2.0  # one in fifty places of a uniformly sampled surface is farther from all points
    far_disk_radii: float = 3.5  # five in a million are: from here on a place counts as a hole
    least_surface_samples: int = 1000
    most_surface_samples: int = 30_000
    surface_nodes: int = 30_000  # of the grid that finds the surface
    joined_spacings: float = 3.0  # distance between samples of one sheet, in their mean spacing


@dataclass(frozen=True)
class LaplaceParameters:
    """The Laplace approximation of a fit (`fit.posterior.laplace_approximation`)."""

    prior_deviation_radii: float = 10.0  # by which each layer's prior moves f; the fit's own ridge is as weak
    noise_passes: int = 6
    noise_tolerance: float = 0.02  # relative change of the noise at which the passes end
    least_noise_radii: float = 1e-5  # below, rounding would decide
    noise_attempts: int = 6  # where rounding makes the system indefinite
    noise_growth: float = 3.0  # factor of the noise at each attempt
    most_free_parameters: int = 3000
    wide_units: int = 600  # of a last layer whose features span the field
    factor_bytes: int = 200_000_000  # most memory of the stored factors of the Jacobian


@dataclass(frozen=True)
class UncertaintyParameters:
    """Standard deviation of the surface and its calibration (`fit.posterior.uncertainty`)."""

    most_points: int = 20_000  # of the data; thinned at random, so that sigma is rather too large
    batch_points: int = 8192
    least_slope: float = 0.1  # of the field; near its critical points the first order is meaningless
    patch_sizes: tuple[int, ...] = (1, 8, 40)  # points that are left out together
    patch_counts: tuple[int, ...] = (200, 40, 12)  # patches of each size
    coverage: float = 0.9545  # of a normal distribution within two standard deviations
    calibration_batch_points: int = 240
    least_residual_variance: float = 1e-10  # eigenvalue of I - H, which rounding may make negative


@dataclass(frozen=True)
class FitParameters:
    """The tuning constants that `gnrecon.fit.fit` passes on to the default fit.

    The other groups of this module are the defaults of the functions that their docstrings name. The local fields of a
    fit by blocks take their defaults.
    """

    two_level: TwoLevelParameters = TwoLevelParameters()
    ball: BallFitParameters = BallFitParameters()
    shape_priors: ShapePriorParameters = ShapePriorParameters()
    global_field: GlobalFieldParameters = GlobalFieldParameters()
    outliers: OutlierParameters = OutlierParameters()
    local_fields: LocalFieldParameters = LocalFieldParameters()
