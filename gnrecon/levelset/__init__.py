"""Moving level sets: even samples of them, distances to known surfaces, transport, and connectedness."""

from gnrecon.levelset.crossings import Crossings, find_crossings
from gnrecon.levelset.level_set import LevelSet, Value, ValueAndGradient
from gnrecon.levelset.newton import Projection, nearest, project
from gnrecon.levelset.sample import SurfaceSample, sample_surface

__all__ = [
    "Crossings",
    "LevelSet",
    "Projection",
    "SurfaceSample",
    "Value",
    "ValueAndGradient",
    "find_crossings",
    "nearest",
    "project",
    "sample_surface",
]
