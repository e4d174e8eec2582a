"""Fitting the scan whose field is extracted, in a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnrecon.fit import FitOptions, fit
from gnrecon.ingest import prepare
from gnrecon.io import read_cloud

STEPS = 4
"""Of one wide layer after its start."""


def measure(folder: str, scan: str, model: str) -> dict[str, Any]:
    """Fit a scan by one wide layer, all of whose features count everywhere, and save the field."""
    del folder
    samples, _ = prepare(read_cloud(Path(scan)))
    sdf, solution = fit(samples, FitOptions(steps=STEPS))
    sdf.save(model)
    return {"points": len(samples), "status": solution.status}
