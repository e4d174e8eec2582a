"""The paper's constraints as residuals of a field's value, gradient and second derivatives."""

from gnrecon.residuals.first_order import (
    Linearised,
    Residual,
    design_region,
    eikonal,
    free_space,
    interface,
    normal_cosine,
    normal_projection,
    normal_vector,
    signed_distance,
)
from gnrecon.residuals.formula import from_formula
from gnrecon.residuals.named import named
from gnrecon.residuals.second_order import (
    SecondOrder,
    clipped_strain,
    gauss_curvature,
    mean_curvature,
    surface_strain,
    tangents,
)

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
