"""Cropped and hollowed solids: exact volumes, flat caps, and the old surface where it was."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UNIT, UTM, ball_mesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gnrecon.export import require_sound
from gnrecon.export.boolean import crop, subtract
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import MeshError

RADIUS = 0.8


def ball(frame: Frame = UNIT, radius: float = RADIUS) -> Mesh:
    return ball_mesh(radius, frame)


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
def test_half_a_ball(frame: Frame) -> None:
    whole = ball(frame)
    low, high = frame.to_world(np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]))
    half = crop(whole, np.stack([low, high]))
    facts = require_sound(half)
    assert (facts.components, facts.genus) == (1, 0)
    assert facts.volume == pytest.approx(whole.volume / 2, rel=1e-6)
    assert half.vertices[:, 2].min() == low[2], "the cap lies on the box exactly"
    cap = half.vertices[:, 2] == low[2]
    kept = half.vertices[~cap]
    assert np.allclose(np.linalg.norm(frame.to_unit(kept), axis=1), RADIUS, rtol=0, atol=1e-6)
    outward = np.einsum("ij,ij->i", half.normals[~cap], frame.to_unit(kept)) / RADIUS
    assert outward.min() > 0.999
    assert (half.normals[cap, 2] < 0.8).all()


def test_a_box_that_holds_everything_changes_nothing() -> None:
    whole = ball()
    assert crop(whole, np.array([[-1.0] * 3, [1.0] * 3])) is whole


def test_a_box_inside_of_the_solid_is_the_box() -> None:
    block = crop(ball(), np.array([[-0.2] * 3, [0.3] * 3]))
    facts = require_sound(block)
    assert facts.volume == pytest.approx(0.125, rel=1e-9)
    assert (facts.vertices, facts.faces) == (8, 12)


def test_a_box_beside_the_solid_is_refused() -> None:
    with pytest.raises(MeshError, match="Nothing of the shape lies in the crop box"):
        crop(ball(), np.array([[0.9] * 3, [1.0] * 3]))


@given(st.lists(st.floats(-0.7, 0.7), min_size=6, max_size=6))
@settings(max_examples=25)
@pytest.mark.seed(4283454098)
def test_any_box_leaves_a_solid_and_a_box_and_its_rest_make_the_whole(numbers: list[float]) -> None:
    corners = np.sort(np.reshape(numbers, (2, 3)), axis=0)
    box = np.stack([corners[0], corners[1] + 0.05])
    assume(np.linalg.norm(np.clip(0.0, *box)) < 0.78)  # a box beside the ball, whose radius is 0.8, holds nothing
    part = crop(BALL, box)
    facts = require_sound(part)
    assert (part.vertices >= box[0]).all()
    assert (part.vertices <= box[1]).all()
    rest = subtract(BALL, part)
    assert require_sound(rest).volume + facts.volume == pytest.approx(BALL.volume, rel=1e-9)


BALL = ball()


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
def test_a_hollow_ball(frame: Frame) -> None:
    outer, inner = ball(frame), ball(frame, 0.6)
    hollow = subtract(outer, inner)
    facts = require_sound(hollow)
    assert facts.components == 2
    assert facts.volume == pytest.approx(outer.volume - inner.volume, rel=1e-9)
    unit = frame.to_unit(hollow.vertices)
    radii = np.linalg.norm(unit, axis=1)
    along = np.einsum("ij,ij->i", hollow.normals, unit) / radii
    assert (along[radii > 0.7] > 0.99).all()
    assert (along[radii < 0.7] < -0.99).all(), "the cavity's normals look into it"


def test_nothing_is_left_when_all_is_taken_away() -> None:
    with pytest.raises(MeshError, match="Nothing is left"):
        subtract(ball(radius=0.5), ball(radius=0.6))
