"""What the default fit did, in sentences."""

from __future__ import annotations

from dataclasses import replace

from gnrecon.fit.fit_summary import FitSummary, describe
from gnrecon.fit.penalties.regularisers import regularisers


def test_a_plain_fit_says_what_was_solved_and_chosen() -> None:
    assert describe(FitSummary(cubes=1200, length=0.25, position_noise=0.01, angle_noise=2.0)) == (
        "Fitted a global field and 1,200 local fields by linear least squares. "
        "Chosen from the data: length scale 0.25, noise 0.01 in position and 2 degrees in normals."
    )


def test_a_network_says_by_how_many_steps() -> None:
    summary = FitSummary(cubes=2, length=0.25, position_noise=0.01, angle_noise=2.0, steps=45)
    assert describe(summary).startswith(
        "Fitted a global field by 45 Gauss-Newton steps, and 2 local fields by linear least squares."
    )


def test_each_step_that_did_something_has_a_sentence() -> None:
    summary = FitSummary(
        cubes=1,
        length=0.25,
        position_noise=0.01,
        angle_noise=2.0,
        flipped_share=0.02,
        outliers=1,
        averaging_width=2.5,
        snapped_points=3000,
        primitives=5,
        edge_samples=120,
        hole_samples=40,
        holes=2,
        regularisers=regularisers("strain=1e-4", None, None),
    )
    assert describe(summary) == (
        "Fitted a global field and 1 local field by linear least squares. "
        "The length scale is 0.25, the shortest that the samples of sharp faces allow. "
        "Turned 2 % of the normals around: a first field contradicts them. "
        "Left out 1 outlier. "
        "Averaged noisy points over 2.5 disk radii where their normals agree. "
        "Snapped 3,000 points to 5 detected planes, cylinders and spheres. "
        "Extended faces to their sharp edges with 120 samples. "
        "Extended planes and cylinders across 2 holes with 40 samples. "
        "Applied curvature penalties: strain (weight 0.0001)."
    )


def test_a_ball_and_its_gaps() -> None:
    summary = FitSummary(2, 0.1, 0.01, 1.0, ball_radius=16.0, ball_points=80, ball_samples=900)
    assert "Snapped 80 points to a ball of radius 16. Filled gaps of the ball with 900 samples." in describe(summary)


def test_a_noise_far_from_that_of_the_points_is_said() -> None:
    summary = FitSummary(cubes=2, length=0.25, position_noise=0.01, angle_noise=2.0)
    for shown, way in ((0.031, "follows the points more closely"), (0.003, "smooths more")):
        text = describe(replace(summary, shown_noise=shown))
        assert f"Their spread about quadrics suggests a noise of {shown} in position; the fit {way}." in text
        assert "suggests" not in describe(replace(summary, shown_noise=shown, averaging_width=2.0))
    for shown in (None, 0.0, 0.004, 0.029):
        assert "suggests" not in describe(replace(summary, shown_noise=shown))
