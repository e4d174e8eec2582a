"""Moving level sets: even samples of them, distances to known surfaces, transport, and connectedness."""

from gnrecon.level_set.known_surfaces import (
    ChamferDivergence,
    KnownSurface,
    ParametricSurface,
    catenoid,
    chamfer_divergence,
    cone,
    enneper,
)
from gnrecon.level_set.level_set import LevelSet, Value, ValueAndGradient
from gnrecon.level_set.sampling import SurfaceSample, sample_surface
from gnrecon.level_set.surface_search import Beside, Crossings, Projection, find_crossings, nearest, project
from gnrecon.level_set.topology import Joints, Region, Separate, joints, refined, separate_components
from gnrecon.level_set.transport import derivative_along, transported

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
