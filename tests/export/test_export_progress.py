"""Extraction, projection and measurement report their progress batch by batch, and can be cancelled."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import Field, torus

from gnrecon.export import extract, measure, project
from gnrecon.runtime.errors import Cancelled

BATCH = 1000


def test_shares_follow_the_work() -> None:
    shares: list[float] = []
    asked: list[int] = []
    field = Field(torus())

    def advance(share: float) -> None:
        shares.append(share)
        asked.append(field.asked)

    mesh = extract(field, resolution=96, batch=BATCH, advance=advance)
    evaluated = shares.index(max(share for share in shares if share <= 0.9 + 1e-9))
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    # Most calls come with the leaves' nodes, of which each batch takes an equal share.
    assert np.diff(asked[1:evaluated]).max() <= BATCH
    steps = np.diff(shares[2:evaluated])
    assert len(steps) > 50
    assert steps.max() < 1.1 * np.median(steps)
    projected: list[float] = []
    project(mesh, field, steps=1, batch=BATCH, advance=projected.append)
    assert projected == [min(end, len(mesh.vertices)) / len(mesh.vertices) for end in batches(len(mesh.vertices))]
    assert projected[-1] == 1.0


def batches(count: int) -> range:
    return range(BATCH, count + BATCH, BATCH)


def test_reporting_changes_nothing() -> None:
    shares: list[float] = []
    plain = extract(Field(torus()), resolution=32)
    watched = extract(Field(torus()), resolution=32, advance=shares.append)
    assert (plain.vertices == watched.vertices).all()
    assert (plain.faces == watched.faces).all()
    assert measure(plain, plain, 1000) == measure(plain, plain, 1000, advance=shares.append)
    assert shares[-2:] == [0.5, 1.0]


def test_extraction_can_be_cancelled() -> None:
    field = Field(torus())

    def advance(share: float) -> None:
        if share > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        extract(field, resolution=96, batch=BATCH, advance=advance)
    whole = Field(torus())
    extract(whole, resolution=96, batch=BATCH)
    assert field.asked < 0.5 * whole.asked
