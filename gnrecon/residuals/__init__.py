"""The paper's constraints as residuals of a field's value and gradient."""

from gnrecon.residuals.first_order import (
    Linearised,
    Residual,
    eikonal,
    interface,
    normal_cosine,
    normal_projection,
    normal_vector,
    signed_distance,
)

__all__ = [
    "Linearised",
    "Residual",
    "eikonal",
    "interface",
    "normal_cosine",
    "normal_projection",
    "normal_vector",
    "signed_distance",
]
