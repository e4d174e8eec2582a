"""Charts as inline SVG: histograms, convergence of a fit, and the shape of a mesh's triangles.

Colours are classes of the page's style sheet, so that charts follow its light and dark themes.
"""

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
from gnrecon.report.html.scales import figure, share, typographic
from gnrecon.report.report_parameters import ChartLayout


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
    layout: ChartLayout = ChartLayout(),
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
    layout : ChartLayout
    mark : float, optional
        Value at which a vertical line is drawn.
    """
    left, right, top = layout.left, layout.width - layout.right, layout.top
    floor = layout.height - layout.bottom - (layout.strip_height if strip else 0)
    width = right - left
    parts = _bar_parts(histogram, left, width, top, floor)
    step = width / max(1, len(strip))
    for index, color in enumerate(strip):
        # A little wider than its share, so that no seam shows.
        parts.append(
            f'<rect x="{left + index * step:.2f}" y="{floor + 2}" width="{step + 0.4:.2f}" '
            f'height="{layout.strip_height - 2}" fill="{color}" shape-rendering="crispEdges"/>'
        )
    marks = ticks.linear(histogram.low, histogram.high, max(3, layout.width // 90))
    places = [left + width * (place - histogram.low) / (histogram.high - histogram.low) for place in marks]
    parts += _x_axis(places, ticks.labels(marks), layout.height - layout.bottom, label, left, right)
    if mark is not None:
        x = left + width * (mark - histogram.low) / (histogram.high - histogram.low)
        parts.append(f'<line class="mark" x1="{x:.2f}" x2="{x:.2f}" y1="{top}" y2="{floor}"/>')
    for beyond, x, anchor in ((histogram.below, left, "start"), (histogram.above, right, "end")):
        if beyond > 0:
            text = f"{share(beyond, histogram.total)} beyond"
            parts.append(f'<text class="note" x="{x}" y="{top - 2}" text-anchor="{anchor}">{text}</text>')
    return _svg(parts, layout, label)


def _bar_parts(histogram: Histogram, left: float, width: float, top: float, floor: float) -> list[str]:
    most = max(histogram.counts, default=0) or 1
    step = width / len(histogram.counts)
    parts = []
    for index, (weight, low, high) in enumerate(
        zip(histogram.counts, histogram.edges, histogram.edges[1:], strict=False)
    ):
        tall = (floor - top) * weight / most
        hint = f"{figure(low)} to {figure(high)}: {share(weight, histogram.total)}"
        parts.append(
            f'<rect class="bar" x="{left + index * step:.2f}" y="{floor - tall:.2f}" width="{max(step - 1, 0.5):.2f}" '
            f'height="{tall:.2f}"><title>{hint}</title></rect>'
        )
    return parts


def curves(
    lines: Sequence[Curve], label: str, *, whole: bool = False, layout: ChartLayout = ChartLayout(left=52)
) -> Markup:
    """Draw lines over a linear axis, against a logarithmic one; y must be positive.

    Parameters
    ----------
    lines : sequence of Curve
        At least one, each with at least one point.
    label : str
        Name or unit of x.
    whole : bool
        Whether x counts something, so that only whole numbers are marked.
    layout : ChartLayout
        With space for the numbers of y on the left.
    """
    left, right, top, floor = layout.left, layout.width - layout.right, layout.top, layout.height - layout.bottom
    xs, ys = [x for line in lines for x in line.x], [y for line in lines for y in line.y]
    x0, x1 = min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1
    # At least half a decade, so that a curve that hardly falls is not drawn as if it did.
    middle = (math.log10(min(ys)) + math.log10(max(ys))) / 2
    half = max(0.25, (math.log10(max(ys)) - math.log10(min(ys))) / 2) * 1.06
    y0, y1 = middle - half, middle + half

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            left + (right - left) * (x - x0) / (x1 - x0),
            floor - (floor - top) * (math.log10(y) - y0) / (y1 - y0),
        )

    parts = []
    for value, text in _log_marks(10**y0, 10**y1):
        level = place(x0, value)[1]
        parts.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{level:.2f}" y2="{level:.2f}"/>')
        parts.append(f'<text x="{left - 8}" y="{level + 4:.2f}" text-anchor="end">{text}</text>')
    marks = [mark for mark in ticks.linear(x0, x1, 6) if not whole or mark == round(mark)]
    parts += _x_axis([place(x, 10**y0)[0] for x in marks], ticks.labels(marks), floor, label, left, right)
    for line in lines:
        parts += _line_parts(line, [place(x, y) for x, y in zip(line.x, line.y, strict=True)])
    return _svg(parts, layout, f"{', '.join(line.name for line in lines)} over {label}")


def _line_parts(line: Curve, points: Sequence[tuple[float, float]]) -> list[str]:
    path = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    parts = [f'<polyline class="line {line.style}" points="{path}"/>']
    # Dots that touch each other would hide the line.
    radius = 3.2 if len(points) <= 24 else 1.4
    for (x, y), across, value in zip(points, line.x, line.y, strict=True):
        hint = f"{line.name} at {figure(across, 4)}: {figure(value, 4)}"
        dot = f'<circle class="dot {line.style}" cx="{x:.2f}" cy="{y:.2f}" r="{radius}">'
        parts.append(f"{dot}<title>{hint}</title></circle>")
    return parts


def _log_marks(low: float, high: float) -> list[tuple[float, str]]:
    """Marks with their labels: powers of ten where at least two fit, else round numbers."""
    powers = ticks.decades(low, high)
    if len(powers) >= 2:
        raised = '10<tspan class="raised" dy="-5">{}</tspan>'
        return [(10.0**power, raised.format(typographic(str(power)))) for power in powers]
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


def _svg(parts: Sequence[str], layout: ChartLayout, label: str) -> Markup:
    size = f"{layout.width} {layout.height}"
    head = f'<svg class="chart" viewBox="0 0 {size}" role="img" aria-label="{Markup.escape(label)}">'
    return Markup(head + "".join(parts) + "</svg>")


Records = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Convergence:
    """Charts of the loss or the damping over steps and over seconds, and the names and classes of the curves."""

    by_step: Markup
    by_time: Markup
    key: tuple[tuple[str, str], ...]


def convergence(history: Records) -> list[Convergence]:
    """Return charts of the loss, and of the damping where there is one; nothing for a fit without steps."""
    charts = []
    # The loss before the first step is that of the start.
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
    return curves(drawn, ("step", "seconds")[over], whole=over == 0, layout=ChartLayout(left=52, height=140))


@dataclass(frozen=True)
class Quality:
    """Histograms of the angles (degrees) and of the edge lengths (file units), with figures of each."""

    angles: Histogram
    angle_figures: tuple[Fact, ...]
    edges: Histogram
    edge_figures: tuple[Fact, ...]


def quality(mesh: Mesh, *, needle_degrees: float = 10.0) -> Quality:
    """Measure every angle and every edge of a mesh with at least one face.

    Parameters
    ----------
    mesh : Mesh
    needle_degrees : float
        Triangles with a smaller angle are counted as needles, which make finite elements ill-conditioned.
    """
    angles, lengths = corner_angles(mesh), edge_lengths(mesh)
    least = angles.min(axis=1)
    longest = float(np.percentile(lengths, 99.9)) or 1.0
    return Quality(
        Histogram.of(angles.reshape(-1), 0.0, 180.0, 60),
        (
            Fact("smallest", f"{figure(float(least.min()))}°"),
            Fact("mean smallest", f"{figure(float(least.mean()))}°", "of each triangle"),
            Fact("needles", share(float((least < needle_degrees).sum()), len(least)), f"below {needle_degrees:.0f}°"),
        ),
        Histogram.of(lengths, 0.0, longest, 56),
        (
            Fact("shortest", figure(float(lengths.min()))),
            Fact("mean", figure(float(lengths.mean()))),
            Fact("longest", figure(float(lengths.max()))),
        ),
    )
