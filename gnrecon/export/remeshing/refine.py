"""Adapting a mesh to its use: sharp edges, isotropic faces, fewer faces, in that order.

Each step starts from a sound mesh. What comes out of it is repaired and verified, and must hang together as before: as
many components, as many handles. A step that fails is tried again more gently, and given up with a sentence when that
fails too; the sound mesh before it then stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gnrecon.export.project import SignedDistance, project
from gnrecon.export.remeshing.decimate import FEWEST, decimate, simplify
from gnrecon.export.remeshing.remesh import remesh
from gnrecon.export.remeshing.sharpen import sharpen
from gnrecon.export.repair import repair
from gnrecon.export.verify import verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

GENTLER = (1.0, 0.5, 0.25)
"""Factors by which a step's strength is lowered before it is given up."""


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
        When a value is out of its range, or lengths are to adapt without one being given.
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
        if self.faces is not None and self.faces < FEWEST:
            raise UsageError(f"The number of faces must be at least {FEWEST}, not {self.faces}.")
        if not 5 <= self.feature_angle <= 90:
            raise UsageError(f"The feature angle must be from 5 to 90 degrees, not {self.feature_angle}.")
        if self.adaptive and self.remesh is None:
            raise UsageError("Adaptive edge lengths need a longest one; add --remesh LENGTH.")

    @property
    def anything(self) -> bool:
        """Whether the mesh is to be changed at all."""
        return any(value is not None for value in (self.remesh, self.simplify, self.faces))


def refine(
    mesh: Mesh, field: SignedDistance, options: RefineOptions, *, advance: ProgressCallback = ignore_progress
) -> tuple[Mesh, list[str]]:
    """Adapt a mesh to the options; where they ask for nothing, it comes back as it is.

    Parameters
    ----------
    mesh : Mesh
        As `project` returns it, in file units.
    field : SignedDistance
        The field that it was extracted from.
    options : RefineOptions
    advance : callable
        Told of the share that is done after each step.

    Returns
    -------
    Mesh, list of str
        A sound mesh on the zero level with the field's normals, and a sentence for each thing that was done.

    Raises
    ------
    MeshError
        When the given mesh is not sound and cannot be repaired.
    """
    if not options.anything:
        return mesh, []
    mesh, actions = repair(mesh)
    steps = _steps(field, options)
    for number, step in enumerate(steps, start=1):
        mesh, sentences = _apply_step(step, mesh)
        actions += sentences
        advance(number / len(steps))
    return mesh, actions


@dataclass(frozen=True)
class _Step:
    """A change of a mesh, by a strength from 1 downwards, and what it is called when it is done."""

    done: str
    change: Callable[[Mesh, float], Mesh]
    strengths: tuple[float, ...] = GENTLER


def _steps(field: SignedDistance, options: RefineOptions) -> list[_Step]:
    angle, adaptive = options.feature_angle, options.adaptive
    length, tolerance, faces = options.remesh, options.simplify, options.faces
    steps = [_Step("Sharpened edges", lambda mesh, _: _sharpened(mesh, field, angle), (1.0,))]
    if length is not None:
        done = f"Remeshed to edges of {'at most ' if adaptive else ''}{length:g}"
        steps.append(_Step(done, lambda mesh, s: remesh(mesh, field, s * length, adaptive=adaptive, angle=angle)))
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
    """The mesh after a step, or as it was where no strength gives a sound mesh of the same topology."""
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
        gentler = (
            "" if strength == 1 else f", at {strength:g} of the strength because more would have failed ({failure})"
        )
        return result, [f"{step.done}{gentler}: {len(mesh.faces)} faces became {len(result.faces)}.", *repaired]
    return mesh, [f"Not {step.done[0].lower()}{step.done[1:]}, because that failed: {failure}"]


def _require_topology_of(mesh: Mesh, result: Mesh) -> None:
    """Raise MeshError where a mesh does not hang together as another one does."""
    before, after = verify(mesh), verify(result)
    if (before.components, before.genus) != (after.components, after.genus):
        raise MeshError(
            f"Components and genus would have changed from {before.components} and {before.genus} to "
            f"{after.components} and {after.genus}."
        )
