"""Moving level sets: even samples of them, distances to known surfaces, transport, and connectedness."""

from gnrecon.levelset.beside import Beside
from gnrecon.levelset.chamfer import ChamferDivergence, chamfer_divergence
from gnrecon.levelset.connect import Joints, Region, joints
from gnrecon.levelset.critical import refined
from gnrecon.levelset.crossings import Crossings, find_crossings
from gnrecon.levelset.known import catenoid, cone, enneper
from gnrecon.levelset.known_surface import KnownSurface
from gnrecon.levelset.level_set import LevelSet, Value, ValueAndGradient
from gnrecon.levelset.newton import Projection, nearest, project
from gnrecon.levelset.parametric import ParametricSurface
from gnrecon.levelset.persistence import Separate, separate_components
from gnrecon.levelset.sample import SurfaceSample, sample_surface
from gnrecon.levelset.transport import derivative_along, transported

__all__ = [
    "Beside",
    "ChamferDivergence",
    "Crossings",
    "Joints",
    "KnownSurface",
    "LevelSet",
    "ParametricSurface",
    "Projection",
    "Region",
    "Separate",
    "SurfaceSample",
    "Value",
    "ValueAndGradient",
    "catenoid",
    "chamfer_divergence",
    "cone",
    "derivative_along",
    "enneper",
    "find_crossings",
    "joints",
    "nearest",
    "project",
    "refined",
    "sample_surface",
    "separate_components",
    "transported",
]
