"""Components, the passes between them, and the values that join them: balls whose passes are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from implicit_shapes import cube, level_set
from scipy import ndimage

from gnrecon.level_set import GridRegion, LevelSet, joints, refined, separate_components


def balls(*centers: tuple[float, float, float], width: float = 0.25, level: float = 0.5) -> LevelSet:
    """Gaussian bumps cut at a level: smooth, with a minimum near each centre and passes between them."""
    spots = torch.tensor(centers, dtype=torch.float64)

    def function(x: torch.Tensor) -> torch.Tensor:
        squares = (x[:, None] - spots).square().sum(2)
        return level - torch.exp(-squares / (2 * width**2)).sum(1)

    return level_set(function, cube(1.0))


def test_two_balls_are_joined_halfway() -> None:
    pair = balls((-0.5, 0.0, 0.1), (0.5, 0.2, 0.1))
    found = joints(pair, GridRegion.within(pair.box, cells=24), margin=0.03)
    assert (found.components, found.islands) == (2, 0)
    torch.testing.assert_close(found.points, torch.tensor([[0.0, 0.1, 0.1]], dtype=torch.float64), atol=1e-7, rtol=0)
    assert found.targets.tolist() == [-0.03]


def test_three_balls_are_joined_by_two_passes() -> None:
    row = balls((-0.7, 0.0, 0.0), (0.0, 0.05, 0.0), (0.7, 0.0, 0.1), width=0.2)
    found = joints(row, GridRegion.within(row.box, cells=24), margin=0.02)
    assert found.components == 3
    # The passes lie between neighbours, never between the two that are farthest apart.
    assert sorted(found.points[:, 0].sign().tolist()) == [-1.0, 1.0]
    value, gradient = row.value_and_gradient(found.points)
    assert gradient.abs().max() < 1e-7
    assert (value > 0).all()


def test_a_field_that_meets_the_targets_is_connected() -> None:
    pair = balls((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    region = GridRegion.within(pair.box, cells=32)
    found = joints(pair, region, margin=0.1)
    deepened = found.targets[0] - pair.value(found.points)[0]

    def moved(x: torch.Tensor) -> torch.Tensor:
        return pair.value(x) + deepened * torch.exp(-((x - found.points[0]).square().sum(1)) / (2 * 0.25**2))

    assert joints(level_set(moved, pair.box), region, margin=0.1).components == 1


def test_one_piece_asks_for_nothing() -> None:
    ball = balls((0.0, 0.0, 0.0))
    found = joints(ball, GridRegion.within(ball.box, cells=16), margin=0.1)
    assert (found.components, found.points.shape, found.targets.shape) == (1, (0, 3), (0,))


def test_an_empty_solid_has_no_components() -> None:
    nothing = level_set(lambda x: 1 + x.square().sum(1), cube(1.0))
    found = joints(nothing, GridRegion.within(nothing.box, cells=8), margin=0.1)
    assert (found.components, found.islands, len(found.points)) == (0, 0, 0)


def test_no_way_leads_through_what_is_outside_of_the_region() -> None:
    # A wall with a gap at y = 0.75: the pass through it is no critical point of the field, and stays at its node.
    pair = balls((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))

    def with_gap(x: np.ndarray) -> np.ndarray:
        return (np.abs(x[:, 0]) > 0.1) | (x[:, 1] > 0.7)

    found = joints(pair, GridRegion.within(pair.box, with_gap, cells=32), margin=0.1)
    assert found.components == 2
    assert float(found.points[0, 1]) == pytest.approx(0.75, abs=0.0626)


def test_islands_that_nothing_can_join_are_counted() -> None:
    pair = balls((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    found = joints(pair, GridRegion.within(pair.box, lambda x: np.abs(x[:, 0]) > 0.1, cells=32), margin=0.1)
    assert (found.components, found.islands, len(found.points)) == (2, 1, 0)


def test_anchored_components_are_joined_and_small_others_removed() -> None:
    def function(x: torch.Tensor) -> torch.Tensor:
        large = balls((-0.6, 0.0, 0.0), (0.6, 0.0, 0.0)).value(x)
        return large - 0.55 * torch.exp(-(x - torch.tensor([0.0, 0.8, 0.0])).square().sum(1) / (2 * 0.1**2))

    crumbs = level_set(function, cube(1.0))
    region = GridRegion.within(crumbs.box, cells=32)
    anchors = np.array([[-0.6, 0.2, 0.0], [0.6, 0.0, 0.2]])
    found = joints(crumbs, region, 0.02, anchors)
    assert found.components == 3
    assert found.targets.tolist() == [-0.02, 0.02]
    assert crumbs.value_and_gradient(found.points)[1].abs().max() < 1e-6
    assert float(found.points[1, 1]) == pytest.approx(0.8, abs=0.02)
    # Without anchors all of them stay.
    assert joints(crumbs, region, 0.02).targets.tolist() == [-0.02, -0.02]
    # An anchor on the crumb itself keeps it.
    kept = joints(crumbs, region, 0.02, np.vstack([anchors, [[0.0, 0.8, 0.0]]]))
    assert kept.targets.tolist() == [-0.02, -0.02]


def slow_components(values: np.ndarray) -> list[tuple[float, float]]:
    """Births and deaths of the components of {f < 0}, by labelling every sublevel set anew."""
    alive: dict[float, float] = {}
    births: list[tuple[float, float]] = []
    for level in np.unique(values[np.isfinite(values)]):
        labels, count = ndimage.label(values <= level)
        minima = ndimage.minimum(values, labels, range(1, count + 1)) if count else []
        for birth in [b for b in alive if b not in minima]:
            births.append((birth, float(level)))
            del alive[birth]
        alive.update((float(m), np.inf) for m in minima)
    return [(b, d) for b, d in births if b < 0 < d]


@pytest.mark.parametrize("seed", range(8))
def test_pairs_agree_with_labelling_every_sublevel_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(6, 5, 7))
    values[rng.uniform(size=values.shape) < 0.3] = np.inf
    apart = separate_components(values)
    found = sorted((values[tuple(b)], values[tuple(d)]) for b, d in zip(apart.births, apart.deaths, strict=True))
    assert found == sorted(slow_components(values))
    assert apart.components == ndimage.label(values < 0)[1]


def test_critical_points_are_refined_only_to_their_own_kind() -> None:
    saddle = level_set(lambda x: 1 + x[:, 0] ** 2 + x[:, 1] ** 2 - (x[:, 2] - 0.03) ** 2, cube(1.0))
    node = torch.tensor([[0.05, -0.05, 0.0]], dtype=torch.float64)
    expected = torch.tensor([[0.0, 0.0, 0.03]], dtype=torch.float64)
    torch.testing.assert_close(refined(saddle, node, 0.1, negative=1), expected, atol=1e-9, rtol=0)
    assert torch.equal(refined(saddle, node, 0.1, negative=0), node)
    assert torch.equal(refined(saddle, node, 0.01, negative=1), node)
    flat = level_set(lambda x: 0 * x[:, 0], cube(1.0))
    assert torch.equal(refined(flat, node, 0.1, negative=1), node)
