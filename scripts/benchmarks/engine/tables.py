"""The benchmark's tables: ours and the baseline side by side, growth, and the solvers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.table import Table

Row = tuple[str, str, str, str, str]
"""Measurement, figure, ours, baseline, ratio."""


def tables(report: dict[str, Any]) -> Iterator[Table]:
    """Yield the tables of what a report holds, the GPU's after the processor's."""
    rows = [*side_by_side(report)]
    if rows:
        yield _table("On the processor", ("measurement", "figure", "ours", "baseline", "ratio"), rows)
    if "cost" in report:
        yield cost_table(report["cost"])
    if "solvers" in report:
        yield solver_table(report["solvers"], "Solvers on one linearisation")
    cuda = report.get("cuda", {})
    rows = [*side_by_side(cuda)]
    if rows:
        yield _table("On the GPU", ("measurement", "figure", "ours", "baseline", "ratio"), rows)
    if "solvers" in cuda:
        yield solver_table(cuda["solvers"], "Solvers on the GPU, compared with the processor's dense step")
    if "differences" in cuda:
        differences = [(name, f"{value:.1e}") for name, value in cuda["differences"].items()]
        yield _table("GPU and processor", ("result", "relative difference"), differences)


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
    return _table(title, ("operation", "size", "seconds", "share of that"), rows)


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
    return _table(title, headings, rows)


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


def _table(title: str, headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Table:
    table = Table(title=title)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table
