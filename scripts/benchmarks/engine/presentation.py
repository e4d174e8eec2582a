"""The engine benchmark's tables, gnrecon and baseline side by side, and its picture of growth and losses over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from benchmarks.harness.tables import row_table
from gnrecon.runtime.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = tuple[str, str, str, str, str]
"""Measurement, figure, gnrecon's, the baseline's, ratio."""


def tables(report: dict[str, Any]) -> Iterator[Table]:
    """Yield the tables of a report, the GPU's after the processor's."""
    rows = [*side_by_side(report)]
    if rows:
        yield _sides_table("On the processor", rows)
    if "cost" in report:
        yield cost_table(report["cost"])
    if "solvers" in report:
        yield solver_table(report["solvers"], "Solvers on one linearisation")
    cuda = report.get("cuda", {})
    rows = [*side_by_side(cuda)]
    if rows:
        yield _sides_table("On the GPU", rows)
    if "solvers" in cuda:
        yield solver_table(cuda["solvers"], "Solvers on the GPU, compared with the processor's dense step")
    if "differences" in cuda:
        differences = [(name, f"{value:.1e}") for name, value in cuda["differences"].items()]
        yield row_table(("result", "relative difference"), differences, title="GPU and processor")


def _sides_table(title: str, rows: Sequence[Row]) -> Table:
    return row_table(("measurement", "figure", "ours", "baseline", "ratio"), rows, title=title)


def side_by_side(report: dict[str, Any]) -> Iterator[Row]:
    """Yield the lines of steps, times to a loss, kernels and the large step."""
    for name, step in report.get("step", {}).items():
        yield from _step_rows(f"step, {name}", step)
    for name, quality in report.get("quality", {}).items():
        yield from _quality_rows(f"quality, {name}", quality)
    if "kernel" in report:
        yield from _kernel_rows(report["kernel"])
    if "million" in report:
        yield from _million_rows(report["million"])


def cost_table(cost: dict[str, Any]) -> Table:
    """Return seconds against N and p, with exponents and the share of the matrix-product rate."""
    rows = []
    for series, symbol in (("by_points", "N"), ("by_parameters", "p")):
        for name, growth in cost[series].items():
            slope = growth["exponent"]
            for number, entry in enumerate(growth["measured"]):
                share = entry.get("share_of_matmul")
                rows.append(
                    (
                        f"{name}, {symbol}^{slope:.2f}" if slope is not None and number == 0 else name * (number == 0),
                        f"{symbol} = {entry['size']:,}",
                        f"{entry['seconds']:.4f}",
                        "" if share is None else f"{share:.0%}",
                    )
                )
    title = f"Growth; a matrix product runs at {cost['matmul_gflops']:.0f} GFlop/s"
    return row_table(("operation", "size", "seconds", "share of that"), rows, title=title)


def solver_table(solvers: dict[str, Any], title: str) -> Table:
    """Return seconds, iterations and differences of every solver."""
    dampings = [f"damping {damping:.0e}" for damping in solvers["dampings"]]
    headings = ["solver", "set-up, s"]
    for damping in dampings:
        headings += [f"{damping}: s", "iterations", "difference"]
    rows = []
    for name, solver in solvers["solvers"].items():
        if "error" in solver:
            rows.append((name, solver["error"], *[""] * (len(headings) - 2)))
            continue
        cells = [name, f"{solver['set_up_seconds']:.2f}"]
        for solve in solver["solves"]:
            cells += [f"{solve['seconds']:.3f}", str(solve["iterations"]), f"{solve['difference']:.1e}"]
        rows.append(tuple(cells))
    return row_table(headings, rows, title=title)


def _step_rows(label: str, step: dict[str, Any]) -> Iterator[Row]:
    ours, plain, chunked = step["ours"], step["baseline"], step["baseline_chunked"]
    rows = " + ".join(f"{count:,}" for count in step["rows"])
    yield label, "seconds a step", f"{ours['seconds']:.3f}", f"{plain['seconds']:.2f}", f"{step['ratio']:.1f}"
    yield (
        f"{rows} rows",
        "baseline in chunks",
        f"{ours['seconds']:.3f}",
        f"{chunked['seconds']:.2f}",
        f"{step['ratio_chunked']:.1f}",
    )
    yield "", "loss falls, a step", f"{ours['decrease']:.1%}", f"{plain['decrease']:.1%}", ""


def _quality_rows(label: str, quality: dict[str, Any]) -> Iterator[Row]:
    bound = ">= " if quality["is_lower_bound"] else ""
    ratio = quality["ratio"]
    yield (
        label,
        f"seconds to {quality['loss']:.1e}",
        _seconds(quality["ours_seconds"]),
        _seconds(quality["baseline_seconds"]),
        "" if ratio is None else f"{bound}{ratio:.1f}",
    )
    yield "", f"seconds to {quality['final_loss']:.1e}", _seconds(quality["ours_seconds_to_final"]), "", ""
    yield "", "least loss", f"{quality['ours_best']:.2e}", f"{quality['baseline_best']:.2e}", ""
    ours, baseline = (quality[side]["eikonal_error"] for side in ("ours", "baseline"))
    if ours is not None and baseline is not None:
        yield "", "mean (|grad f| - 1)^2 at the end", f"{ours:.2e}", f"{baseline:.2e}", ""
    if "ours_at_full_eikonal_weight" in quality:
        constrained = quality["ours_at_full_eikonal_weight"]
        yield "", "least loss, full eikonal weight", f"{min(constrained['losses']):.2e}", "", ""
        yield "", "its mean (|grad f| - 1)^2", f"{constrained['eikonal_error']:.2e}", "", ""


def _kernel_rows(kernel: dict[str, Any]) -> Iterator[Row]:
    ours, explicit = kernel["ours"], kernel["explicit"]
    label = f"kernel, {kernel['parameters']:,} x {kernel['rows']:,}"
    if "ratio" not in kernel:
        yield label, "", ours.get("error", ""), explicit.get("error", ""), ""
        return
    yield label, "seconds", f"{ours['seconds']:.2f}", f"{explicit['seconds']:.2f}", f"{kernel['ratio']:.1f}"
    peaks = [form["peak_memory_mb"] for form in (ours, explicit)]
    own = [form["peak_memory_mb"] - form["libraries_memory_mb"] for form in (ours, explicit)]
    yield "", "peak memory, MB", f"{peaks[0]:,.0f}", f"{peaks[1]:,.0f}", f"{kernel['memory_ratio']:.1f}"
    yield "", "without libraries, MB", f"{own[0]:,.0f}", f"{own[1]:,.0f}", f"{kernel['working_memory_ratio']:.1f}"
    yield "", "difference of the steps", f"{kernel['difference']:.1e}", "", ""


def _million_rows(million: dict[str, Any]) -> Iterator[Row]:
    label = f"large step, {million['parameters']:,} x {million['rows']:,}"
    if "error" in million:
        yield label, "", million["error"], "", ""
        return
    yield label, f"seconds, {million['iterations']} iterations", f"{million['seconds']:.0f}", "", ""
    yield "", "peak memory, MB", f"{million['peak_memory_mb']:,.0f}", "", ""
    yield "", "loss after / before", f"{million['losses'][1] / million['losses'][0]:.3f}", "", ""


def _seconds(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.1f}"


AXES = {"by_points": "points N", "by_parameters": "parameters p"}
LABELS = {"gram": "JᵀJ", "product": "Jᵀ(J v), no matrix", "kernel": "J Jᵀ"}


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
    figure = Figure(figsize=(5.2 * len(panels), 4.2), layout="constrained")
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
    for side, label in (("ours", "gnrecon"), ("baseline", "the paper's algorithm, plain")):
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
