"""Sharpens, remeshes, simplifies and decimates a mesh, in that order, as `RefineOptions` say.

Each step starts from a sound mesh. Its result is repaired and verified, and must have the same number of components and
of handles. A step that fails is tried again with less strength, and skipped with a sentence when that fails too; the
sound mesh before it then stays. The entry is `refine`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gnrecon.export.export_parameters import ExportParameters, RemeshParameters
from gnrecon.export.project import SignedDistance, project
from gnrecon.export.remeshing.decimate import decimate, simplify
from gnrecon.export.remeshing.remesh import remesh
from gnrecon.export.remeshing.sharpen import sharpen
from gnrecon.export.repair import repair
from gnrecon.export.verify import verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class RefineOptions:
    """How the extracted mesh is adapted.

    Parameters
    ----------
    remesh : float, file units, optional
        Edge length of isotropic faces.
    adaptive : bool
        Whether remeshed edges become shorter, down to an eighth of `remesh`, where the surface bends.
    simplify : float, file units, optional
        Distance that the surface may move while vertices are removed.
    faces : int, optional
        Most faces of the mesh, reached by quadric edge collapse.
    feature_angle : float, degrees
        Turn of the field's normal between neighbouring faces from which on their edge is kept sharp.

    Raises
    ------
    UsageError
        When a value is out of its range, lengths are to adapt without one being given, or an angle has no use.
    """

    remesh: float | None = None
    adaptive: bool = False
    simplify: float | None = None
    faces: int | None = None
    feature_angle: float = 30.0

    def __post_init__(self) -> None:
        for name, length in (("edge length to remesh to", self.remesh), ("tolerance to simplify to", self.simplify)):
            if length is not None and not 0 < length < np.inf:
                raise UsageError(f"The {name} must be positive, not {length}.")
        # The smallest closed mesh is a tetrahedron.
        if self.faces is not None and self.faces < 4:
            raise UsageError(f"The number of faces must be at least 4, not {self.faces}.")
        if not 5 <= self.feature_angle <= 90:
            raise UsageError(f"The feature angle must be from 5 to 90 degrees, not {self.feature_angle}.")
        if self.adaptive and self.remesh is None:
            raise UsageError("Adaptive edge lengths need a longest one; add --remesh LENGTH.")
        if self.feature_angle != type(self).feature_angle and not self.anything:
            raise UsageError("A feature angle needs a step that keeps edges; add --remesh, --simplify or --faces.")

    @property
    def anything(self) -> bool:
        """Whether the mesh is to be changed at all."""
        return any(value is not None for value in (self.remesh, self.simplify, self.faces))


def refine(
    mesh: Mesh,
    field: SignedDistance,
    options: RefineOptions,
    *,
    advance: ProgressCallback = ignore_progress,
    parameters: RemeshParameters = ExportParameters.remesh,
) -> tuple[Mesh, list[str]]:
    """Sharpen, remesh, simplify and decimate a mesh as the options ask.

    Parameters
    ----------
    mesh : Mesh
        As `project` returns it, in file units.
    field : SignedDistance
        The field that it was extracted from.
    options : RefineOptions
    advance : callable
        Receives the share that is done, after each step.
    parameters : RemeshParameters

    Returns
    -------
    Mesh, list of str
        A sound mesh on the zero level with the field's normals, and a sentence for each change.

    Raises
    ------
    MeshError
        When the given mesh is not sound and cannot be repaired.
    """
    if not options.anything:
        return mesh, []
    mesh, actions = repair(mesh)
    steps = _steps(field, options, parameters)
    for number, step in enumerate(steps, start=1):
        mesh, sentences = _apply_step(step, mesh)
        actions += sentences
        advance(number / len(steps))
    return mesh, actions


@dataclass(frozen=True)
class _Step:
    """A change of a mesh by a strength, the strengths that are tried in turn, and a phrase for the report."""

    done: str
    change: Callable[[Mesh, float], Mesh]
    strengths: tuple[float, ...] = (1.0, 0.5, 0.25)


def _steps(field: SignedDistance, options: RefineOptions, parameters: RemeshParameters) -> list[_Step]:
    angle, adaptive = options.feature_angle, options.adaptive
    length, tolerance, faces = options.remesh, options.simplify, options.faces
    # Sharpening comes first, because the later steps keep the edges that they find.
    steps = [_Step("Sharpened edges", lambda mesh, _: _sharpened(mesh, field, angle), (1.0,))]
    if length is not None:
        done = f"Remeshed to edges of {'at most ' if adaptive else ''}{length:g}"
        even = partial(remesh, adaptive=adaptive, angle=angle, parameters=parameters)
        steps.append(_Step(done, lambda mesh, s: even(mesh, field, s * length)))
    if tolerance is not None:
        steps.append(_Step(f"Simplified to within {tolerance:g}", lambda mesh, s: simplify(mesh, field, s * tolerance)))
    if faces is not None:
        steps.append(
            _Step(f"Decimated to {faces} faces", lambda mesh, s: decimate(mesh, field, round(faces / s), angle=angle))
        )
    return steps


def _sharpened(mesh: Mesh, field: SignedDistance, angle: float) -> Mesh:
    sharp = sharpen(mesh, field, angle=angle)
    return mesh if sharp is mesh else project(sharp, field)


def _apply_step(step: _Step, mesh: Mesh) -> tuple[Mesh, list[str]]:
    """The mesh after a step, or as before where no strength gives a sound mesh of the same topology."""
    failure = ""
    for strength in step.strengths:
        try:
            result, repaired = repair(step.change(mesh, strength))
            _require_topology_of(mesh, result)
        except MeshError as error:
            failure = str(error)
            continue
        if result is mesh:
            return mesh, []
        gentler = "" if strength == 1 else f", at {strength:g} of the strength because more failed ({failure})"
        return result, [f"{step.done}{gentler}: {len(mesh.faces)} faces became {len(result.faces)}.", *repaired]
    return mesh, [f"Not {step.done[0].lower()}{step.done[1:]}: {failure}"]


def _require_topology_of(mesh: Mesh, result: Mesh) -> None:
    """Raise MeshError where the numbers of components or of handles differ."""
    before, after = verify(mesh), verify(result)
    if (before.components, before.genus) != (after.components, after.genus):
        raise MeshError(
            f"Components and genus would have changed from {before.components} and {before.genus} to "
            f"{after.components} and {after.genus}."
        )
