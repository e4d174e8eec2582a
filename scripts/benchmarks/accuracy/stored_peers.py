"""Peers' figures that were measured before, read from a file, and how gnrecon stands against them.

The file has a line of JSON for each case and peer, with these keys: ``case``, ``peer``, ``setting``, ``points`` of the
scan, ``cd`` (half the sum of the two mean distances), ``acc`` (mean from mesh to truth), ``comp`` (mean from truth to
mesh), ``hd`` (largest distance, both ways), and ``cpu`` (processor seconds, or null). Distances are in 1e-3 of the
largest distance of the truth's vertices from their mean, or in the scan's own unit where the case's `StoredName` says
so.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.accuracy.problem import Problem
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class StoredName:
    """What a case is called in a file of stored figures.

    Parameters
    ----------
    name : under the key ``case``
    same_points : whether the peers had the same points as the case at seed 0; figures of other points of the same
        surface are shown, but not compared
    own_unit : whether distances are in the scan's own unit, not in 1e-3 of the truth's radius
    """

    name: str
    same_points: bool = True
    own_unit: bool = False


@dataclass(frozen=True)
class StoredFigures:
    """A line of the file; distances in the unit of the file.

    Parameters
    ----------
    peer, setting : the method, and its setting with the least mean
    points : of the scan
    mean : half the sum of the two means
    mesh_to_truth, truth_to_mesh : mean distances
    hausdorff : largest distance, both ways
    cpu_seconds : of processor time; None where it was not measured
    """

    peer: str
    setting: str
    points: int
    mean: float
    mesh_to_truth: float
    truth_to_mesh: float
    hausdorff: float
    cpu_seconds: float | None

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> StoredFigures:
        """Return the figures of a line.

        Raises
        ------
        KeyError, TypeError, ValueError
            When a key is missing or its value is of another kind.
        """
        mean, back, there, largest = (float(row[key]) for key in ("cd", "acc", "comp", "hd"))
        seconds = None if row["cpu"] is None else float(row["cpu"])
        return cls(str(row["peer"]), str(row["setting"]), int(row["points"]), mean, back, there, largest, seconds)

    def as_summary(self, factor: float, same_points: bool) -> dict[str, Any]:
        """Return the figures under the names of a trial's, distances divided by `factor`, which is `Problem.factor`."""
        return {
            "method": self.peer,
            "setting": self.setting,
            "same_points": same_points,
            "chamfer_mean": self.mean / factor,
            "mesh_to_reference_mean": self.mesh_to_truth / factor,
            "reference_to_mesh_mean": self.truth_to_mesh / factor,
            "hausdorff": self.hausdorff / factor,
            "cpu_seconds": self.cpu_seconds,
        }


def read_stored(path: Path) -> dict[str, list[StoredFigures]]:
    """Return the figures of a file by the names of the cases.

    Raises
    ------
    InputError
        When the file cannot be read, or a line is not as the module's description says.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The stored figures {path} cannot be read: {error}") from error
    stored: dict[str, list[StoredFigures]] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            stored.setdefault(row["case"], []).append(StoredFigures.of(row))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}, line {number}, is no line of stored figures: {error!r}") from error
    return stored


def best_stored(
    name: StoredName | None, problem: Problem, stored: Mapping[str, Sequence[StoredFigures]]
) -> list[dict[str, Any]]:
    """Return the stored peer with the least mean, and the one with the least Hausdorff distance if it is another.

    They come as `StoredFigures.as_summary` gives them; the list is empty where nothing is stored.

    Raises
    ------
    InputError
        When the stored figures are in another unit than the figures of `problem` or of another number of points.
    """
    found = [] if name is None else stored.get(name.name, [])
    if name is None or not found:
        return []
    _require_same_unit(name, problem)
    for figures in found:
        if name.same_points and figures.points != len(problem.scan):
            raise InputError(f"{name.name} has {len(problem.scan)} points, but {figures.peer} had {figures.points}.")
    chosen = dict.fromkeys([min(found, key=lambda f: f.mean), min(found, key=lambda f: f.hausdorff)])
    return [figures.as_summary(problem.factor, name.same_points) for figures in chosen]


def _require_same_unit(name: StoredName, problem: Problem, *, tolerance: float = 1e-6) -> None:
    """Raise InputError unless both units agree; `tolerance` is relative, of the radius."""
    if name.own_unit != (problem.radius is None):
        raise InputError(f"The stored figures of {name.name} are not in {problem.unit}.")
    if problem.radius is None:
        return
    truth = problem.truth.vertices if isinstance(problem.truth, Mesh) else problem.truth.points
    radius = Frame.of(truth).scale
    if not math.isclose(radius, problem.radius, rel_tol=tolerance):
        raise InputError(f"The stored figures of {name.name} are relative to {radius:g}, not to {problem.radius:g}.")


@dataclass(frozen=True)
class StoredStanding:
    """How gnrecon stands against the best stored peer of each case, which is the one with the least mean.

    Parameters
    ----------
    cases : number of cases in which gnrecon and stored peers had the same points
    below : in how many gnrecon's mean is less than the best peer's
    clearly : in how many it is less by `margin` or more
    near : in how many gnrecon's Hausdorff distance is at most `ratio` times the best peer's
    """

    cases: int
    below: int
    clearly: int
    near: int
    margin: float
    ratio: float

    def describe(self) -> str:
        """Return it as a sentence."""
        return (
            f"Of {self.cases} cases with stored peers, gnrecon's mean distance is below the best peer's in "
            f"{self.below}, by {100 * self.margin:g} % or more in {self.clearly}; its Hausdorff distance is at most "
            f"{self.ratio:g} times the best peer's in {self.near}."
        )


def stored_standing(
    summaries: Sequence[Mapping[str, Any]], *, margin: float = 0.15, ratio: float = 1.1
) -> StoredStanding | None:
    """Return how gnrecon stands; None where no summary compares it with a stored peer that had the same points.

    Where gnrecon failed, its distances are infinite.
    """
    pairs = [
        (summary["methods"]["gnrecon"], summary["stored"][0])
        for summary in summaries
        if "gnrecon" in summary["methods"] and summary["stored"] and summary["stored"][0]["same_points"]
    ]
    if not pairs:
        return None
    means, largest = (
        [(ours.get(key, math.inf), best[key]) for ours, best in pairs] for key in ("chamfer_mean", "hausdorff")
    )
    return StoredStanding(
        cases=len(pairs),
        below=sum(ours < best for ours, best in means),
        clearly=sum(ours <= (1 - margin) * best for ours, best in means),
        near=sum(ours <= ratio * best for ours, best in largest),
        margin=margin,
        ratio=ratio,
    )
