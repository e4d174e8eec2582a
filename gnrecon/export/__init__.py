"""From a field to a verified mesh: extract, project, refine, repair, cut, verify, measure, draw, and attributes."""

from gnrecon.export.ambient import vertex_sky
from gnrecon.export.attribute import Attribute
from gnrecon.export.carry import carry
from gnrecon.export.curvature import curvatures
from gnrecon.export.decimate import decimate, simplify
from gnrecon.export.definitions import DISTANCES, Metrics
from gnrecon.export.error import vertex_error
from gnrecon.export.examine import Findings, examine
from gnrecon.export.extract import extract
from gnrecon.export.handles import remove_handles
from gnrecon.export.invented import Invented, invented
from gnrecon.export.lighten import lighten
from gnrecon.export.metrics import measure
from gnrecon.export.neighbours import Neighbourhood
from gnrecon.export.picture import render
from gnrecon.export.project import project
from gnrecon.export.protocol import SignedDistance
from gnrecon.export.quality import MeshQuality, quality
from gnrecon.export.refine import RefineOptions, refine
from gnrecon.export.remesh import remesh
from gnrecon.export.repair import repair
from gnrecon.export.sharpen import sharpen
from gnrecon.export.sheet import render_sheet
from gnrecon.export.sparsely import sparsely
from gnrecon.export.stray import drop_stray, remove_stray
from gnrecon.export.trim import Trimming, trim
from gnrecon.export.verify import MeshFacts, require_bordered, require_sound, verify, verify_file

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
    "render",
    "render_sheet",
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
    "vertex_sky",
]
