"""The Chamfer divergence: nothing on the truth itself, the offset of parallel surfaces, and what is far or missing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from implicit_shapes import cube, level_set
from torch import Tensor

from gnrecon.level_set import LevelSet, ParametricSurface, catenoid, chamfer_divergence, cone, enneper
from gnrecon.level_set.known_surfaces import distances_to
from gnrecon.level_set.sampling import sample_surface

KNOWN: dict[str, Callable[[], ParametricSurface]] = {"catenoid": catenoid, "enneper": enneper, "cone": cone}
IMPLICIT: dict[str, Callable[[Tensor], Tensor]] = {
    "catenoid": lambda x: x[:, 0] ** 2 + x[:, 1] ** 2 - torch.cosh(x[:, 2]) ** 2,
    "cone": lambda x: torch.hypot(x[:, 0], x[:, 1]) - 1 + 0.6 * x[:, 2],
}


@pytest.fixture(params=KNOWN)
def known(request: pytest.FixtureRequest) -> ParametricSurface:
    return KNOWN[request.param]()


def signed_distance(known: ParametricSurface, offset: float = 0.0) -> LevelSet:
    """The distance from a known surface, by projection in its parameters, less an offset."""

    def value_and_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
        u = known._starts(x)
        for _ in range(60):
            u = u + known._step(u, x - known.position(u), torch.zeros(len(u), dtype=x.dtype))
        t = known.tangents(u)
        normal = torch.nn.functional.normalize(torch.linalg.cross(t[:, :, 0], t[:, :, 1]), dim=1)
        return ((x - known.position(u)) * normal).sum(1) - offset, normal

    return LevelSet(lambda x: value_and_gradient(x)[0], value_and_gradient, cube(2.0))


@pytest.mark.parametrize("name", IMPLICIT)
def test_the_truth_is_at_no_distance_from_itself(name: str, rng: np.random.Generator) -> None:
    divergence = chamfer_divergence(level_set(IMPLICIT[name], cube(2.0)), KNOWN[name](), rng)
    assert divergence.from_known < 1e-12
    assert divergence.to_known < 1e-12


@pytest.mark.parametrize("offset", [0.0, 1e-7, -3e-3, 0.1])
def test_parallel_surfaces_are_apart_by_their_offset(offset: float, rng: np.random.Generator) -> None:
    # Of all that is written here only this knows Enneper's surface by anything but its chart.
    known = enneper()
    points = known.sample(300)[0]
    shifted = signed_distance(known, offset)
    sample = sample_surface(shifted, 400, rng, nodes=2000)
    distances = distances_to(shifted, points, sample)
    torch.testing.assert_close(distances, torch.full_like(distances, abs(offset)), atol=1e-12, rtol=0)


def test_a_shifted_cone(rng: np.random.Generator) -> None:
    # Raised by h, the mantle moves by h times the sine of its half angle, tan = 0.6, along its normal.
    raised = level_set(lambda x: torch.hypot(x[:, 0], x[:, 1]) - 1 + 0.6 * (x[:, 2] - 1e-5), cube(2.0))
    divergence = chamfer_divergence(raised, cone(), rng)
    assert divergence.from_known == pytest.approx(1e-5 * 0.6 / np.hypot(1, 0.6), rel=1e-9)
    assert divergence.to_known == pytest.approx(1e-5 * 0.6 / np.hypot(1, 0.6), rel=1e-9)


def test_a_surface_far_away_is_found(rng: np.random.Generator) -> None:
    # A sphere of radius 1.9 about the origin: its nearest point lies on the ray, 1.9 - |x| away.
    sphere = level_set(lambda x: (x**2).sum(1) - 1.9**2, cube(2.0))
    points, shares = enneper().sample(4000)
    expected = (shares * (1.9 - points.norm(dim=1)) ** 2).sum().sqrt()
    # Points near the centre are near none of it, and get the distance of a sample.
    assert chamfer_divergence(sphere, enneper(), rng).from_known == pytest.approx(float(expected), rel=1e-4)


def test_a_ghost_sheet_shows_in_one_direction_alone(rng: np.random.Generator) -> None:
    def with_ghost(x: Tensor) -> Tensor:
        return IMPLICIT["catenoid"](x) * ((x**2).sum(1) - 0.3**2)

    divergence = chamfer_divergence(level_set(with_ghost, cube(2.0)), catenoid(), rng)
    assert divergence.from_known < 1e-12
    assert divergence.to_known > 0.05


def test_an_empty_level_set_is_infinitely_far(rng: np.random.Generator) -> None:
    empty = level_set(lambda x: 1 + (x**2).sum(1), cube(2.0))
    divergence = chamfer_divergence(empty, catenoid(), rng)
    assert (divergence.from_known, divergence.to_known) == (np.inf, np.inf)


def test_shares_are_those_of_the_area(known: ParametricSurface) -> None:
    def integral(count: int) -> Tensor:
        points, shares = known.sample(count)
        assert float(shares.sum()) == pytest.approx(1)
        return (shares[:, None] * points.square()).sum(0)

    torch.testing.assert_close(integral(4000), integral(400_000), atol=2e-3, rtol=2e-3)


def test_the_area_of_the_catenoid_is_in_its_shares() -> None:
    # The mean of z^2 over the catenoid: the integral of z^2 cosh^2 z over that of cosh^2 z, by a fine sum.
    z = torch.linspace(-1, 1, 200_001, dtype=torch.float64)
    points, shares = catenoid().sample(20_000)
    expected = (z**2 * z.cosh() ** 2).sum() / (z.cosh() ** 2).sum()
    assert float((shares * points[:, 2] ** 2).sum()) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.seed(3358385388)
def test_nearest_points_beat_all_samples(known: ParametricSurface, rng: np.random.Generator) -> None:
    queries = torch.as_tensor(rng.uniform(-1, 1, (60, 3)))
    feet, inside = known.nearest(queries)
    found = (feet - queries).norm(dim=1)
    dense = torch.cdist(queries, known.sample(200_000)[0], compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    # A foot in the patch is the nearest of its points; the surface beyond the patch may be nearer still.
    assert (found <= dense + 1e-12).all()
    assert (dense - found)[inside].max() < 1e-3
    assert int(inside.sum()) > 5


def test_tangents_are_derivatives(known: ParametricSurface, rng: np.random.Generator) -> None:
    parameters = known.parameters(torch.as_tensor(rng.uniform(size=(50, 2))))
    assert known.inside(parameters).all()
    jacobian = torch.func.vmap(torch.func.jacrev(lambda u: known.position(u[None])[0]))(parameters)
    torch.testing.assert_close(known.tangents(parameters), jacobian)


@pytest.mark.parametrize("make", [catenoid, enneper])
def test_the_minimal_surfaces_have_no_mean_curvature(
    make: Callable[[], ParametricSurface], rng: np.random.Generator
) -> None:
    known = make()
    parameters = known.parameters(torch.as_tensor(rng.uniform(size=(50, 2))))
    t = known.tangents(parameters)
    normal = torch.nn.functional.normalize(torch.linalg.cross(t[:, :, 0], t[:, :, 1]), dim=1)
    second = torch.func.vmap(torch.func.jacrev(lambda u: known.tangents(u[None])[0]))(parameters)
    form = torch.einsum("ni,nijk->njk", normal, second)
    mean = torch.linalg.solve(t.mT @ t, form).diagonal(dim1=1, dim2=2).sum(1)
    torch.testing.assert_close(mean, torch.zeros_like(mean), atol=1e-12, rtol=0)
