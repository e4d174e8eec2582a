"""Moving level sets: even samples of them, distances to known surfaces, transport, and connectedness."""

from gnrecon.levelset.chamfer import ChamferDivergence, chamfer_divergence
from gnrecon.levelset.crossings import Crossings, find_crossings
from gnrecon.levelset.known import catenoid, cone, enneper
from gnrecon.levelset.level_set import LevelSet, Value, ValueAndGradient
from gnrecon.levelset.newton import Projection, nearest, project
from gnrecon.levelset.parametric import ParametricSurface
from gnrecon.levelset.sample import SurfaceSample, sample_surface
from gnrecon.levelset.transport import derivative_along, transported

__all__ = [
    "ChamferDivergence",
    "Crossings",
    "LevelSet",
    "ParametricSurface",
    "Projection",
    "SurfaceSample",
    "Value",
    "ValueAndGradient",
    "catenoid",
    "chamfer_divergence",
    "cone",
    "derivative_along",
    "enneper",
    "find_crossings",
    "nearest",
    "project",
    "sample_surface",
    "transported",
]
