"""From a field to a verified mesh: extract, project, refine, repair, cut, verify, measure, draw, and attributes."""

from gnrecon.export.attributes import Attribute, Neighbourhood, distances_between_points, transfer_attributes
from gnrecon.export.components import drop_stray_components, remove_stray
from gnrecon.export.handles import remove_handles
from gnrecon.export.marching_cubes import extract
from gnrecon.export.mesh_statistics import MeshQuality, quality
from gnrecon.export.metrics import DISTANCES, Metrics, measure, vertex_error
from gnrecon.export.project import SignedDistance, project
from gnrecon.export.remeshing.decimate import decimate, decimate_by_clustering, simplify
from gnrecon.export.remeshing.refine import RefineOptions, refine
from gnrecon.export.remeshing.remesh import remesh
from gnrecon.export.remeshing.sharpen import sharpen
from gnrecon.export.repair import repair
from gnrecon.export.trim import Trimming, UnsupportedArea, same_side_distances, trim, unsupported_area
from gnrecon.export.verify import Findings, MeshFacts, examine, require_bordered, require_sound, verify, verify_file
from gnrecon.geometry.curvature import curvatures, interpolate_from_samples

__all__ = [
    "DISTANCES",
    "Attribute",
    "Findings",
    "MeshFacts",
    "MeshQuality",
    "Metrics",
    "Neighbourhood",
    "RefineOptions",
    "SignedDistance",
    "Trimming",
    "UnsupportedArea",
    "curvatures",
    "decimate",
    "decimate_by_clustering",
    "distances_between_points",
    "drop_stray_components",
    "examine",
    "extract",
    "interpolate_from_samples",
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
    "same_side_distances",
    "sharpen",
    "simplify",
    "transfer_attributes",
    "trim",
    "unsupported_area",
    "verify",
    "verify_file",
    "vertex_error",
]
