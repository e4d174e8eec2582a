"""Level sets: sampling, distances to known surfaces, transport of residuals, and connectedness."""

from gnrecon.level_set.known_surfaces import (
    ChamferDivergence,
    KnownSurface,
    ParametricSurface,
    catenoid,
    chamfer_divergence,
    cone,
    enneper,
)
from gnrecon.level_set.lagged_worker import LaggedWorker
from gnrecon.level_set.level_set import LevelSet, Value, ValueAndGradient
from gnrecon.level_set.newton_projection import Projection, nearest, project
from gnrecon.level_set.sampling import SurfaceSample, sample_surface
from gnrecon.level_set.surface_search import Crossings, find_crossings
from gnrecon.level_set.topology import (
    ConnectionTargets,
    GridRegion,
    SeparateComponents,
    joints,
    refined,
    separate_components,
)
from gnrecon.level_set.transport import derivative_along, transported

__all__ = [
    "ChamferDivergence",
    "ConnectionTargets",
    "Crossings",
    "GridRegion",
    "KnownSurface",
    "LaggedWorker",
    "LevelSet",
    "ParametricSurface",
    "Projection",
    "SeparateComponents",
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
