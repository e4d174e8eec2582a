"""Parts of the default fit that can be left out, each by the tuning constants of a fit without it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from gnrecon.fit.parameters import (
    FitParameters,
    GlobalFieldParameters,
    LocalFieldParameters,
    NetworkLadderParameters,
    NetworkTermParameters,
    OutlierParameters,
    TwoLevelParameters,
)
from gnrecon.fit.shape_priors.prior_parameters import (
    BallFitParameters,
    BoreParameters,
    HoleCompletionParameters,
    ResamplingParameters,
    ShapePriorParameters,
    SharpShapeParameters,
    SnappingParameters,
)

_NEVER = 10**9  # points; no scan has so many


def _terms(terms: NetworkTermParameters) -> FitParameters:
    return FitParameters(global_field=GlobalFieldParameters(terms=terms))


def _ladder(ladder: NetworkLadderParameters) -> FitParameters:
    return FitParameters(global_field=GlobalFieldParameters(ladder=ladder))


def _priors(priors: ShapePriorParameters) -> FitParameters:
    return FitParameters(shape_priors=priors)


PARTS: Mapping[str, FitParameters] = {
    # The linear field counts as exact, whatever its score: no network is fitted.
    "Gauss-Newton": FitParameters(global_field=GlobalFieldParameters(exact_score=math.inf)),
    "eikonal": _terms(NetworkTermParameters(near_eikonal_deviation=1e9, far_eikonal_deviation=1e9)),
    "robust weights": _terms(NetworkTermParameters(robust_degrees_of_freedom=1e9)),
    "several networks": _ladder(NetworkLadderParameters(starts=1, most_members=1)),
    "widening": _ladder(NetworkLadderParameters(widths=NetworkLadderParameters.widths[:1])),
    "last steps": FitParameters(two_level=TwoLevelParameters(most_refitted_points=0)),
    "lengths by place": FitParameters(local_fields=LocalFieldParameters(most_length_steps=0)),
    "outliers": FitParameters(outliers=OutlierParameters(least_points=_NEVER)),
    "ball": FitParameters(ball=BallFitParameters(min_points=_NEVER)),
    "sharp faces": _priors(ShapePriorParameters(sharp=SharpShapeParameters(max_points=0))),
    "snapping": _priors(ShapePriorParameters(snapping=SnappingParameters(min_snapped_share=2.0))),
    "resampling": _priors(ShapePriorParameters(resampling=ResamplingParameters(max_points=0))),
    # A bore without a radius.
    "bores": _priors(ShapePriorParameters(holes=HoleCompletionParameters(bores=BoreParameters(max_bore_radii=1e-9)))),
    "holes": _priors(ShapePriorParameters(holes=HoleCompletionParameters(min_points=_NEVER))),
}
"""The parameters of a fit without each part, by the part's name."""
