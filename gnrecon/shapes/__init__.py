"""Shape learning: surfaces from constraints alone, such as minimal and developable ones."""

from collections.abc import Callable

from gnrecon.shapes.developable import cone, developable_surface
from gnrecon.shapes.learn import OPTIMISERS, Learned, learn
from gnrecon.shapes.learned import LearnedField, mesh_of
from gnrecon.shapes.measure import Measurement
from gnrecon.shapes.minimal import catenoid, enneper, minimal_surface
from gnrecon.shapes.part import bracket
from gnrecon.shapes.problem import Pretraining, ShapeProblem, circle, cube, plane_through, z_cylinder, z_plane
from gnrecon.shapes.scanned import ScannedSurface, scanned
from gnrecon.shapes.term import Drawn, Moment, Term, at_points, fading, in_box, on_surface, rising

PROBLEMS: dict[str, Callable[[], ShapeProblem]] = {"catenoid": catenoid, "enneper": enneper, "cone": cone}
"""Makes each of the paper's data-free problems by its name."""

__all__ = [
    "OPTIMISERS",
    "PROBLEMS",
    "Drawn",
    "Learned",
    "LearnedField",
    "Measurement",
    "Moment",
    "Pretraining",
    "ScannedSurface",
    "ShapeProblem",
    "Term",
    "at_points",
    "bracket",
    "catenoid",
    "circle",
    "cone",
    "cube",
    "developable_surface",
    "enneper",
    "fading",
    "in_box",
    "learn",
    "mesh_of",
    "minimal_surface",
    "on_surface",
    "plane_through",
    "rising",
    "scanned",
    "z_cylinder",
    "z_plane",
]
