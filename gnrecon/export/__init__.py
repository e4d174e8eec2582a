"""From a field to a verified mesh: extract, project, refine, repair, cut, verify, measure, draw, and attributes."""

from gnrecon.export.attributes import Attribute, Neighbourhood, carry
from gnrecon.export.curvature import curvatures, sparsely
from gnrecon.export.handles import remove_handles
from gnrecon.export.marching_cubes import extract
from gnrecon.export.mesh_statistics import MeshQuality, quality
from gnrecon.export.metrics import DISTANCES, Metrics, measure, vertex_error
from gnrecon.export.project import SignedDistance, project
from gnrecon.export.remeshing.decimate import decimate, lighten, simplify
from gnrecon.export.remeshing.refine import RefineOptions, refine
from gnrecon.export.remeshing.remesh import remesh
from gnrecon.export.remeshing.sharpen import sharpen
from gnrecon.export.repair import drop_stray, remove_stray, repair
from gnrecon.export.trim import Invented, Trimming, invented, trim
from gnrecon.export.verify import Findings, MeshFacts, examine, require_bordered, require_sound, verify, verify_file

__all__ = [
    "DISTANCES",
    "Attribute",
    "Findings",
    "Invented",
    "MeshFacts",
    "MeshQuality",
    "Metrics",
    "Neighbourhood",
    "RefineOptions",
    "SignedDistance",
    "Trimming",
    "carry",
    "curvatures",
    "decimate",
    "drop_stray",
    "examine",
    "extract",
    "invented",
    "lighten",
    "measure",
    "project",
    "quality",
    "refine",
    "remesh",
    "remove_handles",
    "remove_stray",
    "repair",
    "require_bordered",
    "require_sound",
    "sharpen",
    "simplify",
    "sparsely",
    "trim",
    "verify",
    "verify_file",
    "vertex_error",
]
