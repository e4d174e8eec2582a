"""The numbers that say how far two surfaces lie apart, each with its definition.

The definitions are printed with the numbers, because the literature calls several of them "Chamfer": the mean or the
root mean square, one way or both, squared or not.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Metrics:
    """Distances between a mesh and its reference, in file units unless said otherwise.

    Parameters
    ----------
    reference_to_mesh_mean, mesh_to_reference_mean : float
        Mean distance of the samples of one surface to the other surface.
    chamfer_mean : float
        Half the sum of the two means.
    reference_to_mesh_rms, mesh_to_reference_rms : float
        Root mean square distances.
    chamfer_rms_paper : float
        CD_1 of the paper's appendix "Chamfer Divergence": the root mean square distance from the reference to the mesh.
    hausdorff : float
        Largest distance of any sample to the other surface, both ways.
    normal_consistency : float or None
        Mean absolute cosine between a sample's normal and that of the nearest face, mean of both ways; None where the
        reference has neither faces nor normals.
    precision, recall, f_score : float
        Share of the mesh's samples within `threshold` of the reference, of the reference's within it of the mesh, and
        their harmonic mean.
    threshold : float
        Of the F-score.
    radius : float
        Largest distance of the reference's vertices from their mean, or the scale that was given instead.
    samples : int
        Samples on each surface that has faces.
    reference_is_cloud : bool
        Whether the reference has no faces, so that it is represented by its points.
    """

    reference_to_mesh_mean: float
    mesh_to_reference_mean: float
    chamfer_mean: float
    reference_to_mesh_rms: float
    mesh_to_reference_rms: float
    chamfer_rms_paper: float
    hausdorff: float
    normal_consistency: float | None
    precision: float
    recall: float
    f_score: float
    threshold: float
    radius: float
    samples: int
    reference_is_cloud: bool

    def as_dict(self) -> dict[str, object]:
        """All numbers by name, with the distances relative to the radius under ``relative``; ready for JSON."""
        return {**asdict(self), "relative": {name: getattr(self, name) / self.radius for name in DISTANCES}}

    def describe(self) -> list[str]:
        """One line a number: its value, the value relative to the radius, and its definition."""
        target = "nearest point" if self.reference_is_cloud else "surface"
        lines = [
            f"{name:24}{getattr(self, name):12.6g}{getattr(self, name) / self.radius:12.4e} of the radius  "
            f"{meaning.format(target=target)}"
            for name, meaning in DISTANCES.items()
        ]
        if self.normal_consistency is not None:
            meaning = "mean |cosine| of a sample's normal and the nearest one's, mean of both ways"
            lines.append(f"{'normal_consistency':24}{self.normal_consistency:12.6g}{'':26}{meaning}")
        meaning = f"harmonic mean of precision {self.precision:.4g} and recall {self.recall:.4g}"
        lines.append(f"{'f_score':24}{self.f_score:12.6g}{'':26}{meaning} within {self.threshold:.4g}")
        lines.append(f"{'radius':24}{self.radius:12.6g}{'':26}largest distance of a reference vertex from their mean")
        return lines


DISTANCES = {
    "reference_to_mesh_mean": "mean distance of the reference's samples to the mesh",
    "mesh_to_reference_mean": "mean distance of the mesh's samples to the reference's {target}",
    "chamfer_mean": "half the sum of the two means",
    "reference_to_mesh_rms": "root mean square distance of the reference's samples to the mesh",
    "mesh_to_reference_rms": "root mean square distance of the mesh's samples to the reference's {target}",
    "chamfer_rms_paper": "the paper's Chamfer divergence CD_1: the reference's root mean square distance to the mesh",
    "hausdorff": "largest of all distances, both ways",
}
