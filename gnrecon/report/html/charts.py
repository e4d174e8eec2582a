"""Charts as inline SVG, in colours that the page's style sheet names, so that they follow light and dark."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from gnrecon.export.mesh_statistics import corner_angles, edge_lengths
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import Histogram
from gnrecon.report.html import scales as ticks
from gnrecon.report.html.facts import Fact
from gnrecon.report.html.scales import MINUS, figure, share

WIDTH, HEIGHT = 440, 210

LEFT, RIGHT, TOP, BOTTOM = 12, 12, 14, 40
"""Size of a chart and its margins, in units that are about a pixel."""

STRIP = 12
"""Height of a strip of colours."""


@dataclass(frozen=True)
class Curve:
    """A named line through points (x, y), y positive; `style` is its class in the style sheet."""

    name: str
    style: str
    x: Sequence[float]
    y: Sequence[float]


def bars(
    histogram: Histogram,
    label: str,
    *,
    strip: Sequence[str] = (),
    size: tuple[int, int] = (WIDTH, HEIGHT),
    mark: float | None = None,
) -> Markup:
    """Draw a histogram.

    Parameters
    ----------
    histogram : Histogram
    label : str
        Name and unit of the values, below the axis.
    strip : sequence of str
        Colours of a strip along the axis, from the lowest value to the highest.
    size : pair of int
        Width and height.
    mark : float, optional
        Where an upright line is drawn.
    """
    right, floor = size[0] - RIGHT, size[1] - BOTTOM - (STRIP if strip else 0)
    width = right - LEFT
    most = max(histogram.counts, default=0) or 1
    step = width / len(histogram.counts)
    parts = []
    for index, (weight, low, high) in enumerate(
        zip(histogram.counts, histogram.edges, histogram.edges[1:], strict=False)
    ):
        tall = (floor - TOP) * weight / most
        hint = f"{figure(low)} to {figure(high)}: {share(weight, histogram.total)}"
        parts.append(
            f'<rect class="bar" x="{LEFT + index * step:.2f}" y="{floor - tall:.2f}" width="{max(step - 1, 0.5):.2f}" '
            f'height="{tall:.2f}"><title>{hint}</title></rect>'
        )
    for index, color in enumerate(strip):
        step = width / len(strip)
        # A little wider than its share, so that no seam shows.
        parts.append(
            f'<rect x="{LEFT + index * step:.2f}" y="{floor + 2}" width="{step + 0.4:.2f}" height="{STRIP - 2}" '
            f'fill="{color}" shape-rendering="crispEdges"/>'
        )
    marks = ticks.linear(histogram.low, histogram.high, max(3, size[0] // 90))
    places = [LEFT + width * (place - histogram.low) / (histogram.high - histogram.low) for place in marks]
    parts += _x_axis(places, ticks.labels(marks), size[1] - BOTTOM, label, LEFT, right)
    if mark is not None:
        x = LEFT + width * (mark - histogram.low) / (histogram.high - histogram.low)
        parts.append(f'<line class="mark" x1="{x:.2f}" x2="{x:.2f}" y1="{TOP}" y2="{floor}"/>')
    for beyond, x, anchor in ((histogram.below, LEFT, "start"), (histogram.above, right, "end")):
        if beyond > 0:
            text = f"{share(beyond, histogram.total)} beyond"
            parts.append(f'<text class="note" x="{x}" y="{TOP - 2}" text-anchor="{anchor}">{text}</text>')
    return _svg(parts, size, label)


def curves(lines: Sequence[Curve], label: str, *, whole: bool = False, height: int = HEIGHT) -> Markup:
    """Draw lines over a linear axis, against a logarithmic one; y must be positive.

    Parameters
    ----------
    lines : sequence of Curve
        At least one, each with at least one point.
    label : str
        Name or unit of x.
    whole : bool
        Whether x counts something, so that only whole numbers are marked.
    height : int
    """
    left, floor = 52, height - BOTTOM
    xs, ys = [x for line in lines for x in line.x], [y for line in lines for y in line.y]
    x0, x1 = min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1
    # At least half a decade, so that a curve which hardly falls is not drawn as if it did.
    middle = (math.log10(min(ys)) + math.log10(max(ys))) / 2
    half = max(0.25, (math.log10(max(ys)) - math.log10(min(ys))) / 2) * 1.06
    y0, y1 = middle - half, middle + half

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            left + (WIDTH - RIGHT - left) * (x - x0) / (x1 - x0),
            floor - (floor - TOP) * (math.log10(y) - y0) / (y1 - y0),
        )

    parts = []
    for value, text in _log_marks(10**y0, 10**y1):
        level = place(x0, value)[1]
        parts.append(f'<line class="grid" x1="{left}" x2="{WIDTH - RIGHT}" y1="{level:.2f}" y2="{level:.2f}"/>')
        parts.append(f'<text x="{left - 8}" y="{level + 4:.2f}" text-anchor="end">{text}</text>')
    marks = [mark for mark in ticks.linear(x0, x1, 6) if not whole or mark == round(mark)]
    parts += _x_axis([place(x, 10**y0)[0] for x in marks], ticks.labels(marks), floor, label, left, WIDTH - RIGHT)
    for line in lines:
        points = [place(x, y) for x, y in zip(line.x, line.y, strict=True)]
        path = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
        parts.append(f'<polyline class="line {line.style}" points="{path}"/>')
        # Dots that touch each other would hide the line.
        radius = 3.2 if len(points) <= 24 else 1.4
        for (x, y), across, value in zip(points, line.x, line.y, strict=True):
            hint = f"{line.name} at {figure(across, 4)}: {figure(value, 4)}"
            dot = f'<circle class="dot {line.style}" cx="{x:.2f}" cy="{y:.2f}" r="{radius}">'
            parts.append(f"{dot}<title>{hint}</title></circle>")
    return _svg(parts, (WIDTH, height), f"{', '.join(line.name for line in lines)} over {label}")


def _log_marks(low: float, high: float) -> list[tuple[float, str]]:
    """Marks with their labels: powers of ten where at least two fit, else round numbers."""
    powers = ticks.decades(low, high)
    if len(powers) >= 2:
        raised = '10<tspan class="raised" dy="-5">{}</tspan>'
        return [(10.0**power, raised.format(str(power).replace("-", MINUS))) for power in powers]
    places = [place for place in ticks.linear(low, high, 4) if place > 0]
    return [(place, figure(place, 2)) for place in places]


def _x_axis(
    places: Sequence[float], labels: Sequence[str], floor: float, label: str, left: float, right: float
) -> list[str]:
    parts = [f'<line class="axis" x1="{left}" x2="{right}" y1="{floor}" y2="{floor}"/>']
    for x, text in zip(places, labels, strict=True):
        # A mark at the very end keeps its number within the picture.
        inner = min(max(x, left + 4 * len(text)), right - 4 * len(text))
        parts.append(f'<line class="axis" x1="{x:.2f}" x2="{x:.2f}" y1="{floor}" y2="{floor + 4}"/>')
        parts.append(f'<text x="{inner:.2f}" y="{floor + 17}" text-anchor="middle">{text}</text>')
    middle = (left + right) / 2
    parts.append(f'<text class="name" x="{middle}" y="{floor + 34}" text-anchor="middle">{Markup.escape(label)}</text>')
    return parts


def _svg(parts: Sequence[str], size: tuple[int, int], label: str) -> Markup:
    head = f'<svg class="chart" viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{Markup.escape(label)}">'
    return Markup(head + "".join(parts) + "</svg>")


CONVERGENCE_HEIGHT = 140

Records = Sequence[Mapping[str, Any]]


# How a fit went: loss and damping, step by step and over time.


@dataclass(frozen=True)
class Convergence:
    """A quantity's charts over the steps and over the seconds, and the names and classes of its curves."""

    by_step: Markup
    by_time: Markup
    key: tuple[tuple[str, str], ...]


def convergence(history: Records) -> list[Convergence]:
    """Return charts of the loss, and of the damping where there is one; nothing for a fit without steps."""
    charts = []
    # A loss before the first step is where the start had led.
    start = [(0, 0.0, history[0]["before"])] if history and history[0]["before"] else []
    loss = [*start, *_points(history, "loss")]
    losses = [("Loss", "first", loss), ("Held-out residuals", "second", _points(history, "held_out"))]
    for shown in (losses, [("Damping", "third", _points(history, "damping"))]):
        drawn = [(name, style, [point for point in points if point[2] > 0]) for name, style, points in shown]
        drawn = [line for line in drawn if line[2]]
        if drawn:
            charts.append(Convergence(_chart(drawn, 0), _chart(drawn, 1), tuple(line[:2] for line in drawn)))
    return charts


def _points(history: Records, name: str) -> list[tuple[int, float, float]]:
    """Step, seconds and value of each record that has one."""
    return [(record["step"], record.get("seconds", 0.0), record[name]) for record in history if record.get(name)]


def _chart(lines: list[tuple[str, str, list[tuple[int, float, float]]]], over: int) -> Markup:
    drawn = [Curve(name, style, [p[over] for p in points], [p[2] for p in points]) for name, style, points in lines]
    return curves(drawn, ("step", "seconds")[over], whole=over == 0, height=CONVERGENCE_HEIGHT)


NEEDLE = 10.0
"""Degrees: a triangle with a smaller angle is a needle, which simulations dislike."""


# How well a mesh's triangles are shaped: their angles and the lengths of their edges.


@dataclass(frozen=True)
class Quality:
    """Histograms of the angles (degrees) and of the edge lengths (file units), with figures of each."""

    angles: Histogram
    angle_figures: tuple[Fact, ...]
    edges: Histogram
    edge_figures: tuple[Fact, ...]


def quality(mesh: Mesh) -> Quality:
    """Measure every angle and every edge of a mesh with at least one face."""
    angles, lengths = corner_angles(mesh), edge_lengths(mesh)
    least = angles.min(axis=1)
    longest = float(np.percentile(lengths, 99.9)) or 1.0
    return Quality(
        Histogram.of(angles.reshape(-1), 0.0, 180.0, 60),
        (
            Fact("smallest", f"{figure(float(least.min()))}°"),
            Fact("mean smallest", f"{figure(float(least.mean()))}°", "of each triangle"),
            Fact("needles", share(float((least < NEEDLE).sum()), len(least)), f"below {NEEDLE:.0f}°"),
        ),
        Histogram.of(lengths, 0.0, longest, 56),
        (
            Fact("shortest", figure(float(lengths.min()))),
            Fact("mean", figure(float(lengths.mean()))),
            Fact("longest", figure(float(lengths.max()))),
        ),
    )
