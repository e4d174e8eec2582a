"""The paper's constraints as residuals of a field's value, gradient and second derivatives."""

from gnrecon.residuals.constraints import (
    Linearised,
    Residual,
    SecondOrder,
    clipped_strain,
    design_region,
    eikonal,
    free_space,
    from_formula,
    gauss_curvature,
    interface,
    mean_curvature,
    normal_cosine,
    normal_projection,
    normal_vector,
    signed_distance,
    surface_strain,
    tangents,
)
from gnrecon.residuals.named_residuals import named

__all__ = [
    "Linearised",
    "Residual",
    "SecondOrder",
    "clipped_strain",
    "design_region",
    "eikonal",
    "free_space",
    "from_formula",
    "gauss_curvature",
    "interface",
    "mean_curvature",
    "named",
    "normal_cosine",
    "normal_projection",
    "normal_vector",
    "signed_distance",
    "surface_strain",
    "tangents",
]
