"""How a fit went: loss and damping, step by step and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from gnrecon.page.charts import Curve, curves

HEIGHT = 140

Records = Sequence[Mapping[str, Any]]


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
    return curves(drawn, ("step", "seconds")[over], whole=over == 0, height=HEIGHT)
