"""The benchmark's picture: processor time and memory against points, beside lines of slope one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gnrecon.runtime.files import atomic_write

SIZE = (10.4, 4.2)
"""In inches."""


def draw(runs: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG file with a panel of seconds and one of memory; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout="constrained")
    time, memory = figure.subplots(1, 2)
    points = [run["points"] for run in runs]
    stages = {"whole run": [run["cpu_seconds"] for run in runs]}
    for name in ("ingest", "extract", "project"):
        stages[name] = [run["stage_cpu_seconds"][name] for run in runs]
    for name, seconds in stages.items():
        time.loglog(points, seconds, marker="o", label=name)
    first = stages["whole run"][0] / points[0]
    time.loglog(points, [first * count for count in points], "k:", label="in proportion to the points")
    time.set(xlabel="points", ylabel="seconds of processor time, all processes")
    for name, label in (("together", "all processes"), ("own", "main process"), ("worker", "largest other process")):
        memory.semilogx(points, [run["memory_mb"][name] / 1000 for run in runs], marker="o", label=label)
    memory.axhline(8.0, color="k", linestyle=":", label="8 GB")
    memory.set(xlabel="points", ylabel="peak memory, GB", ylim=(0, None))
    for axes in (time, memory):
        axes.legend()
        axes.grid(alpha=0.3)
    with atomic_write(path, overwrite=True) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
