"""What a finished mesh is told of each of its vertices: a stage of the pipeline, after all that moves vertices.

To add an attribute, write a function from `Sources` to attributes and sentences, and a line in `MAKERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from gnrecon.export import Attribute, Neighbourhood, carry, curvatures, sparsely
from gnrecon.fit import NeuralSDF, Uncertainty
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Samples
from gnrecon.io import supports_attribute
from gnrecon.options import Options
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class Sources:
    """All that attributes are made from.

    Parameters
    ----------
    mesh : Mesh
        In its final state, in file units.
    sdf : NeuralSDF
        The field that it was extracted from.
    cloud : PointCloud
        The scan as it was read.
    around : Neighbourhood
        Of its points.
    distances : array of shape (V,)
        From each vertex to the nearest of them, in file units.
    samples : Samples
        What the fit saw of it.
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
        """That of the field, where it was asked for and can be had."""
        if not self.options.uncertainty:
            return None
        try:
            return Uncertainty.of(self.sdf, self.samples, self.options.seed)
        except FitError:
            return None


GRID = ("row", "column")
"""Places in a scanner's grid: a surface has none, so they are carried over only where they are asked for by name."""

UNASKED = ("distance", "error")
"""What vertices carry without being asked to, and without a scan that holds it."""

Made = tuple[list[Attribute], list[str]]
"""Attributes, and sentences about what could not be made."""


def adorn(sources: Sources, advance: ProgressCallback = ignore_progress) -> tuple[Mesh, list[Attribute], list[str]]:
    """Return the mesh with its attributes, the attributes themselves, and sentences for the user."""
    attributes: list[Attribute] = []
    sentences: list[str] = []
    for number, maker in enumerate(MAKERS):
        advance(number / len(MAKERS))
        made, remarks = maker(sources)
        attributes += made
        sentences += remarks
    by_name = {one.name: one for one in attributes}
    mesh = sources.mesh.with_attributes({name: one.values for name, one in by_name.items()})
    return mesh, list(by_name.values()), sentences


def wanted(cloud: PointCloud, attributes: str) -> list[str]:
    """Return the names of a cloud's attributes that ``--attributes`` asks for; ``distance`` may be among them.

    Raises
    ------
    UsageError
        When a name is neither ``distance`` nor one of the cloud's.
    """
    offered = list(dict.fromkeys(["distance", *cloud.attributes]))
    if attributes in ("auto", "none"):
        return [name for name in offered if name not in GRID] if attributes == "auto" else []
    names = [name.strip() for name in attributes.split(",")]
    for name in names:
        if name not in offered:
            raise UsageError(f"There is no attribute {name!r} to carry over; this scan offers {', '.join(offered)}.")
    return names


def fitting(mesh: Mesh, path: Path, attributes: str) -> Mesh:
    """Leave out what nobody asked for where the format that the path names has no place for it.

    Parameters
    ----------
    mesh : Mesh
    path : file to write
    attributes : what was asked for, as in `Options`
    """
    if attributes != "auto":
        return mesh
    kept = {
        name: values
        for name, values in mesh.attributes.items()
        if name not in UNASKED or supports_attribute(path, name, values)
    }
    return replace(mesh, attributes=kept)


def _distance(sources: Sources) -> Made:
    """How far each vertex lies from the nearest scanned point, in file units."""
    if "distance" not in wanted(sources.cloud, sources.options.attributes):
        return [], []
    return [Attribute("distance", sources.distances, "distance to the nearest point as read, file units")], []


def _carried(sources: Sources) -> Made:
    """Whatever the scan holds of its points."""
    names = [name for name in wanted(sources.cloud, sources.options.attributes) if name in sources.cloud.attributes]
    if "distance" not in names:
        return carry(sources.mesh.vertices, sources.cloud, names, sources.around)
    names.remove("distance")
    attributes, sentences = carry(sources.mesh.vertices, sources.cloud, names, sources.around)
    return attributes, [*sentences, "The points' attribute 'distance' gives way to the distance from the points."]


def _curvature(sources: Sources) -> Made:
    """Mean and Gauss curvature of the field's level sets through the vertices."""
    return (curvature_of(sources.mesh, sources.sdf) if sources.options.curvature else []), []


def curvature_of(mesh: Mesh, sdf: NeuralSDF) -> list[Attribute]:
    """Return mean and Gauss curvature of the field's level sets through a mesh's vertices."""
    mean, gauss = curvatures(sdf.gradient(mesh.vertices), sdf.hessian(mesh.vertices))
    origin = "of the field's level set, from its gradient and second derivatives; per"
    return [
        Attribute("mean_curvature", mean, f"mean curvature {origin} file unit"),
        Attribute("gauss_curvature", gauss, f"Gauss curvature {origin} squared file unit"),
    ]


def _sigma(sources: Sources) -> Made:
    """The standard deviation of each vertex's position along the normal, in file units."""
    if not sources.options.uncertainty:
        return [], []
    uncertainty = sources.uncertainty
    if uncertainty is None:
        return [], ["There is no sigma, because the data does not determine the field's parameters."]
    carried = "sigma" in wanted(sources.cloud, sources.options.attributes)
    remarks = ["The points' attribute 'sigma' gives way to the standard deviation of the surface."] * carried
    sigma = sparsely(uncertainty.sigma, sources.mesh)
    return [Attribute("sigma", sigma, f"Laplace approximation, {uncertainty.describe()}")], remarks


MAKERS: tuple[Callable[[Sources], Made], ...] = (_distance, _carried, _curvature, _sigma)
