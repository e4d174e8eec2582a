"""The benchmark's picture: cost against points and parameters with its exponents, and loss over time of both sides."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL = (5.2, 4.2)
"""Width and height of a panel, in inches."""

AXES = {"by_points": "points N", "by_parameters": "parameters p"}
LABELS = {"gram": "JᵀJ", "product": "Jᵀ(J v), no matrix", "kernel": "J Jᵀ"}


def require_matplotlib() -> None:
    """Refuse where there is no matplotlib.

    Raises
    ------
    UsageError
        When it is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise UsageError("--plot needs matplotlib; install it with: pip install matplotlib") from None


def draw(report: dict[str, Any], path: Path) -> None:
    """Write a PNG file with a panel for each growth and each scan of a report; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    panels: list[Callable[[Axes], None]] = []
    if "cost" in report:
        panels += [partial(_cost, report["cost"], key) for key in AXES]
    panels += [partial(_quality, name, quality) for name, quality in report.get("quality", {}).items()]
    if not panels:
        return
    figure = Figure(figsize=(PANEL[0] * len(panels), PANEL[1]), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        panel(axes)
    with atomic_write(path, overwrite=True) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def _cost(cost: dict[str, Any], key: str, axes: Axes) -> None:
    for name, growth in cost[key].items():
        if growth["measured"]:
            slope = "" if growth["exponent"] is None else f", exponent {growth['exponent']:.2f}"
            sizes, seconds = zip(*((entry["size"], entry["seconds"]) for entry in growth["measured"]), strict=True)
            axes.loglog(sizes, seconds, marker="o", label=f"{LABELS[name]}{slope}")
    _finish(axes, AXES[key], "seconds, linearisation included")


def _quality(name: str, quality: dict[str, Any], axes: Axes) -> None:
    for side, label in (("ours", "gnrecon"), ("baseline", "the paper's algorithm, plainly")):
        axes.loglog(quality[side]["seconds"], quality[side]["losses"], label=label)
    for loss in (quality["loss"], quality["final_loss"]):
        axes.axhline(loss, color="gray", linewidth=0.8, linestyle="--")
    axes.set_title(name)
    _finish(axes, "seconds", "data + normal loss")


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    axes.legend()
