"""Whether points are averaged, and how: by the shape's edges, and by what left-out points say of it."""

from __future__ import annotations

from dataclasses import replace

import made_shapes
import numpy as np
import pytest

from gnrecon.fit import FitOptions, NeuralSDF, fit
from gnrecon.fit import denoising as averaged
from gnrecon.fit.denoising import LocalData, _best, _candidates, choose_local_data, has_edges
from gnrecon.fit.local_solve import Hyperparameters
from gnrecon.fit.model_selection import CrossValidation, FieldResiduals, SelectedModel
from gnrecon.fit.parameters import DenoisingParameters
from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.geometry.point_cloud import Frame, Samples

FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)


def cube(count: int, noise: float, rng: np.random.Generator) -> Samples:
    return Samples(*made_shapes.cube(count, 0.8, rng, noise), FRAME)


def ball(count: int, noise: float, rng: np.random.Generator) -> Samples:
    return Samples(*made_shapes.sphere(count, rng, 0.8, noise), FRAME)


def off_cube(x: np.ndarray) -> np.ndarray:
    return made_shapes.off_cube(x, 0.8)


def test_a_noisy_cube_is_averaged_and_its_fit_says_so() -> None:
    """The whole of it: the fit of a noisy cube is nearer to the cube than any mean without regard to edges is."""
    samples = cube(1200, 0.015, np.random.default_rng(5))
    sdf, solution = fit(samples, FitOptions(quality="draft"))
    assert "Averaged noisy points" in solution.status
    exact = cube(2000, 0.0, np.random.default_rng(6))
    errors = np.abs(sdf.sdf(FRAME.to_world(exact.points))) / FRAME.scale
    assert errors.mean() < 0.4 * off_cube(samples.points).mean()


def test_faces_that_meet_are_told_from_bends() -> None:
    def edges(samples: Samples) -> bool:
        return has_edges(*_candidates(DenoisingParameters())[0].apply(samples.points, samples.normals))

    rng = np.random.default_rng(2)
    assert edges(cube(1500, 0.0, rng))
    assert edges(cube(1500, 0.01, rng))
    assert not edges(ball(1500, 0.01, rng))
    # So few that neighbours' normals differ as if there were edges between them.
    assert not edges(ball(60, 0.0, rng))
    # The two sides of a thin sheet are no edge.
    side = rng.choice([-1.0, 1.0], 1000)
    x = np.stack([*rng.uniform(-1, 1, (2, 1000)), 0.002 * side], axis=1)
    assert not edges(Samples(x, np.stack([0 * side, 0 * side, side], axis=1), FRAME))


def chosen(gains: dict[BilateralFilter, float], edges: bool) -> BilateralFilter | None:
    """Return the averaging whose left-out points are told better, by gains of a scatter of one hundredth."""
    scatter = 0.01 * np.tile([1.0, -1.0], 50)[:, None]
    hyperparameters = Hyperparameters(0.1, 0.01, 0.1)

    class Scores:
        def __init__(self, gain: float) -> None:
            self.gain = gain

        def scores(self, length: float) -> np.ndarray:
            assert length == hyperparameters.length
            return np.full((100, 3), 0.5) - self.gain - scatter

    choice = SelectedModel(hyperparameters, np.full((100, 3), 0.5))
    found = _best(choice, lambda one: Scores(gains.get(one, -1.0)), lambda: edges)  # type: ignore[arg-type,return-value]
    return None if found is None else found[0]


def test_edges_decide_what_scatter_hides() -> None:
    # The doubt about a mean of a hundred is a thousandth.
    first, wider, widest = _candidates(DenoisingParameters())
    for gain, without, with_edges in ((0.003, first, first), (0.0015, None, first), (-0.0005, None, first)):
        assert chosen({first: gain}, edges=False) == without
        assert chosen({first: gain}, edges=True) == with_edges
    assert chosen({first: -0.002}, edges=True) is None
    assert chosen({first: 0.003, wider: 0.005, widest: 0.004}, edges=False) == wider


def test_clean_points_and_estimated_normals_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = ball(300, 0.0, np.random.default_rng(4))
    residuals = FieldResiduals(samples.points, samples.normals, np.zeros(300), samples.normals)

    def result(position: float, estimated: bool) -> LocalData | None:
        """What is told of a noise, in radii of a point's disk; None where averaging was tried."""
        choice = SelectedModel(Hyperparameters(0.1, position * residuals.density.radius, 0.1), np.zeros((2, 2)))

        class Canned:
            def clean(self) -> None:
                return None

            def select(self) -> SelectedModel:
                return choice

        monkeypatch.setattr(averaged.CrossValidation, "draw", lambda *_: Canned())
        monkeypatch.setattr(averaged.FieldResiduals, "of", lambda *_: residuals)
        monkeypatch.setattr(averaged, "_best", lambda *_: tried.append(True))
        tried: list[bool] = []
        field: NeuralSDF = None  # type: ignore[assignment]
        given = replace(samples, estimated=estimated)
        found = choose_local_data(field, given, np.zeros(300, dtype=bool), 300, np.random.default_rng(0), "cpu")
        assert found.samples is given
        assert found.hyperparameters is choice.hyperparameters
        assert found.averaging is None
        return None if tried else found

    assert result(DenoisingParameters.least_noise_disk_radii, estimated=False) is not None
    assert result(1.1 * DenoisingParameters.least_noise_disk_radii, estimated=True) is not None
    assert result(1.1 * DenoisingParameters.least_noise_disk_radii, estimated=False) is None


def test_the_noise_of_estimated_normals_is_about_that_of_the_points() -> None:
    points = made_shapes.sphere(500, np.random.default_rng(0))[0]
    residuals = FieldResiduals(points, points, np.full(500, 0.05), points, estimated=True, noise=0.03)
    held_out = np.arange(500) % 8 == 0
    for known, least, most in ((0.03, 0.015, 0.06), (None, 0.0, 0.051)):
        of_points = replace(residuals, noise=known)
        validation = CrossValidation.draw(of_points, held_out, 0.1, np.random.default_rng(0), "cpu")
        positions = [position for position, _ in validation.noises(0.4)]
        assert least <= min(positions)
        assert max(positions) <= most
    assert min(positions) < 0.015
