"""Shape learning: surfaces from constraints alone, such as minimal and developable ones."""

from collections.abc import Callable

from gnrecon.shape_learning.learn import OPTIMISERS, Learned, learn
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters
from gnrecon.shape_learning.part_problem import bracket
from gnrecon.shape_learning.problems import catenoid, cone, developable_surface, enneper, minimal_surface
from gnrecon.shape_learning.result import LearnedField, Measurement, mesh_of
from gnrecon.shape_learning.scanned_shapes import ScannedSurface, scanned
from gnrecon.shape_learning.shape_problem import (
    Pretraining,
    SampledPoints,
    ShapeProblem,
    StepState,
    Term,
    at_points,
    circle,
    cube,
    fading,
    in_box,
    on_surface,
    plane_through,
    rising,
    z_cylinder,
    z_plane,
)

PROBLEMS: dict[str, Callable[[], ShapeProblem]] = {"catenoid": catenoid, "enneper": enneper, "cone": cone}
"""Creates each of the paper's data-free problems by its name."""

__all__ = [
    "OPTIMISERS",
    "PROBLEMS",
    "Learned",
    "LearnedField",
    "Measurement",
    "Pretraining",
    "SampledPoints",
    "ScannedSurface",
    "ShapeLearningParameters",
    "ShapeProblem",
    "StepState",
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
