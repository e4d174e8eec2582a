"""Numbers, marks, colour ramps, charts and the shape of triangles."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pages import torus

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import Histogram
from gnrecon.report.html import scales as ticks
from gnrecon.report.html.charts import Curve, bars, convergence, corner_angles, curves, edge_lengths, quality
from gnrecon.report.html.scales import STOPS, count, css, figure, memory, ramp, seconds, share


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0"),
        (1.23456, "1.23"),
        (-0.0123456, "−0.0123"),
        (9.999, "10.0"),
        (999.9, "1,000"),
        (216503.4, "216,503"),
        (0.00004567, "4.57 × 10⁻⁵"),
        (0.00009999, "0.000100"),
        (-3.2e12, "−3.20 × 10¹²"),
        (math.nan, "not finite"),
    ],
)
def test_figures(number: float, text: str) -> None:
    assert figure(number) == text


@given(st.floats(1e-30, 1e30))
def test_figures_keep_three_digits(number: float) -> None:
    raised = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
    text = figure(number).replace(",", "").replace(" × 10", "e").translate(raised)
    assert float(text) == pytest.approx(number, rel=0.005)


def test_counts_times_shares_and_memory() -> None:
    assert (count(1234567), count(-10)) == ("1,234,567", "−10")
    assert (seconds(0.04), seconds(59.94), seconds(61), seconds(3600)) == ("0.0 s", "59.9 s", "1 min 1 s", "60 min 0 s")
    assert (share(1, 3), share(0, 3), share(1, 10_000), share(9_999, 10_000), share(3, 3), share(0, 0)) == (
        "33.3 %", "0.0 %", "< 0.1 %", "> 99.9 %", "100.0 %", "0.0 %",
    )  # fmt: skip
    assert (memory(273.6), memory(2044.4)) == ("274 MB", "2.04 GB")


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e6), st.integers(2, 8))
def test_marks_are_round_few_and_within(low: float, width: float, most: int) -> None:
    high = low + width
    places = ticks.linear(low, high, most)
    assert len(places) <= most
    slack = 1e-6 * width
    assert all(low - slack <= place <= high + slack for place in places)
    if most >= 4:
        assert places
    if len(places) > 1:
        mantissa = f"{places[1] - places[0]:.3e}"[:5]
        assert mantissa in ("1.000", "2.000", "5.000"), mantissa


def test_labels_have_the_decimals_of_their_step() -> None:
    assert ticks.labels([-0.5, 0.0, 0.5]) == ["−0.5", "0.0", "0.5"]
    assert ticks.labels([0.0, 20.0, 40.0]) == ["0", "20", "40"]
    assert ticks.labels([]) == []
    assert ticks.labels([0.0, 1e-8]) == ["0.0e+00", "1.0e−08"]
    assert ticks.decades(1e-3, 20.0) == [-3, -2, -1, 0, 1]
    assert len(ticks.decades(1e-12, 1e12)) <= 6


def test_bars_are_as_tall_as_their_counts() -> None:
    histogram = Histogram(0.0, 4.0, (1.0, 4.0, 2.0, 0.0), above=1.0)
    text = bars(histogram, "a < b")
    heights = [float(height) for height in re.findall(r'class="bar"[^>]*height="([\d.]+)"', text)]
    assert np.allclose(np.array(heights) / heights[1], [0.25, 1, 0.5, 0], atol=0.01)
    assert "1.00 to 2.00: 50.0 %" in text
    assert "12.5 % beyond" in text
    assert "a &lt; b" in text
    assert '<line class="mark"' not in text
    assert 'class="mark"' in bars(histogram, "x", mark=1.0)


def test_curves_pass_through_their_points() -> None:
    text = curves([Curve("loss", "first", [0, 1, 2], [1.0, 0.1, 0.01])], "step", whole=True)
    found = re.search(r'<polyline class="line first" points="([^"]*)"', text)
    assert found
    places = np.array([[float(x) for x in pair.split(",")] for pair in found[1].split()])
    assert np.ptp(np.diff(places, axis=0), axis=0) == pytest.approx([0, 0], abs=0.02), "straight on a logarithmic axis"
    assert places[0, 1] < places[2, 1]
    assert "loss at 1.000: 0.1000" in text
    assert [mark for mark in re.findall(r">([\d.]+)</text>", text) if "." in mark] == []
    assert curves([Curve("one", "first", [3], [2.0])], "step")


def test_a_fit_without_steps_has_no_charts_and_odd_numbers_are_left_out() -> None:
    assert convergence([]) == []
    record = {"step": 1, "before": None, "loss": None, "damping": 0.0, "seconds": 1.0}
    assert convergence([record]) == []
    adam = [{"step": i, "before": 1.0, "loss": 1.0 / i, "damping": 0.0, "seconds": float(i)} for i in (1, 2)]
    (only,) = convergence(adam)
    assert [name for name, _ in only.key] == ["Loss"]


@pytest.mark.parametrize("name", STOPS)
def test_ramps_pass_their_stops_and_have_no_jumps(name: str) -> None:
    colors = ramp(name)
    assert colors.shape == (256, 3)
    assert css(colors[0]) == STOPS[name][0]
    assert css(colors[-1]) == STOPS[name][-1]
    assert np.abs(np.diff(colors.astype(int), axis=0)).max() <= 6
    light = colors @ np.array([0.2126, 0.7152, 0.0722])
    if name in ("diverging", "curvature"):
        assert abs(int(light.argmax()) - 127.5) < 3
    else:
        assert abs(np.diff(light).sum()) == pytest.approx(np.abs(np.diff(light)).sum(), rel=0.02), (
            "one way in lightness"
        )


def test_angles_and_edges_of_known_triangles() -> None:
    right = Mesh(np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    assert np.allclose(corner_angles(right), [[90, 53.13010235, 36.86989765]])
    assert sorted(edge_lengths(right)) == [3, 4, 5]
    needle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]]), np.array([[0, 1, 2]]))
    assert np.allclose(corner_angles(needle), [[2e-9 * 180 / np.pi, 2e-9 * 180 / np.pi, 180]], atol=1e-9)
    assert quality(needle).angle_figures[2].value == "100.0 %"


def test_every_angle_and_every_edge_is_counted_once() -> None:
    mesh = torus()
    assert np.allclose(corner_angles(mesh).sum(axis=1), 180)
    assert len(edge_lengths(mesh)) == len(mesh.faces) * 3 // 2
    found = quality(mesh)
    assert found.angles.total == 3 * len(mesh.faces)
    assert found.edges.total == len(mesh.faces) * 3 // 2
