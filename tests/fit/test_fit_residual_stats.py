"""Residuals at the points, of a field that is known in closed form and of a fitted one."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from gnrecon.fit import FitOptions, Misfit, fit
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.statistics import Histogram

FRAME = Frame(np.array([100.0, -20.0, 5.0]), 4.0)


class Plane:
    """The signed distance z - 5 in file units."""

    def sdf_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points[:, 2] - 5.0, np.broadcast_to([0.0, 0.0, 1.0], points.shape)


def samples(heights: np.ndarray, degrees: np.ndarray) -> Samples:
    """Points at heights above the plane, in file units, with normals tilted by angles."""
    places = np.column_stack([np.arange(len(heights)), np.zeros(len(heights)), 5.0 + heights])
    tilt = np.radians(degrees)
    return Samples(FRAME.to_unit(places), np.column_stack([np.sin(tilt), 0 * tilt, np.cos(tilt)]), FRAME)


def test_distances_and_angles_are_in_file_units_and_degrees() -> None:
    heights, degrees = np.array([0.0, 0.5, -1.0, 0.25]), np.array([0.0, 90.0, 180.0, 30.0])
    found = Misfit.of(Plane(), samples(heights, degrees))  # type: ignore[arg-type]
    assert np.allclose(found.distances, heights, atol=1e-12)
    assert np.allclose(found.angles, degrees)
    values = found.as_dict()
    assert values["points"] == 4
    assert values["distance"]["mean"] == pytest.approx(np.abs(heights).mean())
    assert values["distance"]["rms"] == pytest.approx(np.sqrt(np.mean(heights**2)))
    assert values["distance"]["max"] == pytest.approx(1.0)
    assert values["angle"]["median"] == pytest.approx(60.0)


def test_histograms_have_all_points_and_the_sign(rng: np.random.Generator) -> None:
    found = Misfit.of(Plane(), samples(rng.normal(0.1, 0.02, 500), rng.uniform(0, 9, 500)))  # type: ignore[arg-type]
    for name in ("distance", "angle"):
        assert Histogram(**found.as_dict()[name]["histogram"]).total == 500
    shown = Histogram(**found.as_dict()["distance"]["histogram"])
    assert shown.low == -shown.high
    assert sum(shown.counts[: len(shown.counts) // 2]) < 5, "points outside lie on the right"


@pytest.mark.parametrize("height", [0.0, np.nan])
def test_values_that_are_all_zero_or_not_finite_still_make_a_report(height: float) -> None:
    found = Misfit.of(Plane(), samples(np.full(3, height), np.zeros(3)))  # type: ignore[arg-type]
    assert json.dumps(found.as_dict())


def test_many_points_are_asked_evenly() -> None:
    found = Misfit.of(Plane(), samples(np.arange(95.0), np.zeros(95)), most_points=10)  # type: ignore[arg-type]
    assert np.allclose(found.distances, np.arange(0, 95, 10))


def test_a_fitted_field_explains_its_points_in_any_units(rng: np.random.Generator) -> None:
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found: list[dict[str, Any]] = []
    for frame in (Frame(np.zeros(3), 1.0), FRAME):
        sdf, _ = fit(Samples(normals, normals, frame), FitOptions(widths=(1000,), steps=0))
        found.append(Misfit.of(sdf, Samples(normals, normals, frame)).as_dict())
    assert 0 < found[0]["distance"]["max"] < 0.05
    assert found[0]["angle"]["max"] < 20
    assert found[1]["distance"]["rms"] == pytest.approx(FRAME.scale * found[0]["distance"]["rms"], rel=1e-6)
    assert found[1]["angle"]["rms"] == pytest.approx(found[0]["angle"]["rms"], rel=1e-6)
