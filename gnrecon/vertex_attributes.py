"""Computes per-vertex attributes of a finished mesh: distance to the points, their attributes, curvature, sigma.

To add an attribute, write a function from `AttributeSources` to attributes and sentences, and call it in
`compute_attributes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from gnrecon.export import Attribute, Neighbourhood, curvatures, interpolate_from_samples, transfer_attributes
from gnrecon.fit import NeuralSDF, Uncertainty
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Samples
from gnrecon.io import supports_attribute
from gnrecon.options import Options
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class AttributeSources:
    """The data that attributes are computed from.

    Parameters
    ----------
    mesh : Mesh
        Final, in file units.
    sdf : NeuralSDF
        The field that the mesh was extracted from.
    cloud : PointCloud
        The scan as it was read.
    around : Neighbourhood
        Of the scan's points.
    distances : array of shape (V,)
        From each vertex to the nearest of these points, in file units.
    samples : Samples
        The points of the fit.
    options : Options
    """

    mesh: Mesh
    sdf: NeuralSDF
    cloud: PointCloud
    around: Neighbourhood
    distances: Float
    samples: Samples
    options: Options

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        """Uncertainty of the field, where the options request it and the data determines it."""
        if not self.options.uncertainty:
            return None
        try:
            return Uncertainty.of(self.sdf, self.samples, self.options.seed)
        except FitError:
            return None


MadeAttributes = tuple[list[Attribute], list[str]]
"""Attributes, and sentences about those that could not be made."""


def compute_attributes(
    sources: AttributeSources, advance: ProgressCallback = ignore_progress
) -> tuple[Mesh, list[Attribute], list[str]]:
    """Return the mesh with its attributes, the attributes themselves, and sentences for the user."""
    attributes: list[Attribute] = []
    sentences: list[str] = []
    functions = (_distance, _carried, _curvature, _sigma)
    for number, function in enumerate(functions):
        advance(number / len(functions))
        made, remarks = function(sources)
        attributes += made
        sentences += remarks
    by_name = {one.name: one for one in attributes}
    mesh = sources.mesh.with_attributes({name: one.values for name, one in by_name.items()})
    return mesh, list(by_name.values()), sentences


def requested_names(cloud: PointCloud, attributes: str) -> list[str]:
    """Return the attributes of a cloud that ``--attributes`` selects; ``distance`` may be among them.

    ``auto`` selects all but the row and column of a scanner's grid, which mean nothing on a surface.

    Raises
    ------
    UsageError
        When a name is neither ``distance`` nor one of the cloud's.
    """
    offered = list(dict.fromkeys(["distance", *cloud.attributes]))
    if attributes in ("auto", "none"):
        return [name for name in offered if name not in ("row", "column")] if attributes == "auto" else []
    names = [name.strip() for name in attributes.split(",")]
    for name in names:
        if name not in offered:
            raise UsageError(f"There is no attribute {name!r} to carry over; this scan has {', '.join(offered)}.")
    return names


def without_unsupported(mesh: Mesh, path: Path, attributes: str) -> Mesh:
    """Return a mesh without the automatic attributes that the file's format cannot hold.

    ``distance`` and ``error`` are automatic: they are added without a scan that holds them. With ``auto``, they are
    left out silently; others are kept, so that the writer reports what the format cannot hold.

    Parameters
    ----------
    mesh : Mesh
    path : file to write
    attributes : as in `Options`
    """
    if attributes != "auto":
        return mesh
    automatic = ("distance", "error")
    kept = {
        name: values
        for name, values in mesh.attributes.items()
        if name not in automatic or supports_attribute(path, name, values)
    }
    return replace(mesh, attributes=kept)


def _distance(sources: AttributeSources) -> MadeAttributes:
    """Distance from each vertex to the nearest point of the scan, file units."""
    if "distance" not in requested_names(sources.cloud, sources.options.attributes):
        return [], []
    return [Attribute("distance", sources.distances, "distance to the nearest point as read, file units")], []


def _carried(sources: AttributeSources) -> MadeAttributes:
    """The scan's own attributes of its points."""
    names = [
        name for name in requested_names(sources.cloud, sources.options.attributes) if name in sources.cloud.attributes
    ]
    if "distance" not in names:
        return transfer_attributes(sources.mesh.vertices, sources.cloud, names, sources.around)
    names.remove("distance")
    attributes, sentences = transfer_attributes(sources.mesh.vertices, sources.cloud, names, sources.around)
    return attributes, [*sentences, "The points' attribute 'distance' is replaced by the distance to the points."]


def _curvature(sources: AttributeSources) -> MadeAttributes:
    """Mean and Gauss curvature of the field's level sets through the vertices."""
    return (curvature_attributes(sources.mesh, sources.sdf) if sources.options.curvature else []), []


def curvature_attributes(mesh: Mesh, sdf: NeuralSDF) -> list[Attribute]:
    """Return mean and Gauss curvature of the field's level sets through a mesh's vertices."""
    mean, gauss = curvatures(sdf.gradient(mesh.vertices), sdf.hessian(mesh.vertices))
    origin = "of the field's level set, from its gradient and second derivatives; per"
    return [
        Attribute("mean_curvature", mean, f"mean curvature {origin} file unit"),
        Attribute("gauss_curvature", gauss, f"Gauss curvature {origin} squared file unit"),
    ]


def _sigma(sources: AttributeSources) -> MadeAttributes:
    """Standard deviation of each vertex's position along the normal, file units."""
    if not sources.options.uncertainty:
        return [], []
    uncertainty = sources.uncertainty
    if uncertainty is None:
        return [], ["There is no sigma: the data does not determine the field's parameters."]
    carried = "sigma" in requested_names(sources.cloud, sources.options.attributes)
    remarks = ["The points' attribute 'sigma' is replaced by the standard deviation of the surface."] * carried
    sigma = interpolate_from_samples(uncertainty.sigma, sources.mesh)
    return [Attribute("sigma", sigma, f"Laplace approximation, {uncertainty.describe()}")], remarks
