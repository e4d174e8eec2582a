"""The parameters of level sets: frozen, all of them used, and with effect."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import torch
from implicit_shapes import cube, sphere
from parameter_checks import assert_frozen, read_attributes

import gnrecon.level_set
from gnrecon.level_set import GridRegion, project, sample_surface
from gnrecon.level_set.level_set_parameters import LevelSetParameters

DEFAULT = LevelSetParameters()


def test_they_are_frozen() -> None:
    assert_frozen(DEFAULT)


def test_each_is_used() -> None:
    assert {field.name for field in fields(DEFAULT)} <= read_attributes(gnrecon.level_set)


def test_the_tolerance_ends_the_projection() -> None:
    level_set = sphere().level_set
    points = torch.tensor([[0.3, 0.2, 0.1]], dtype=torch.float64)
    found = project(level_set, points, 0.1)
    assert torch.equal(found.points, project(level_set, points, 0.1, parameters=DEFAULT).points)
    loose = project(level_set, points, 0.1, parameters=replace(DEFAULT, tolerance_diagonals=1e-3))
    assert not torch.equal(found.points, loose.points)
    assert bool(loose.converged.all())


def test_the_grid_and_the_cells_have_their_defaults() -> None:
    level_set = sphere().level_set

    def points(*nodes: int) -> torch.Tensor:
        return sample_surface(level_set, 50, np.random.default_rng(0), *nodes).points

    assert torch.equal(points(), points(DEFAULT.grid_nodes))
    assert not torch.equal(points(), points(8000))
    assert GridRegion.within(cube(1.0)).mask.shape == (DEFAULT.component_cells + 1,) * 3
