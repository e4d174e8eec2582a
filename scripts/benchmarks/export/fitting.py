"""Fitting the scan whose field is extracted, in a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gnrecon.fit import fit
from gnrecon.ingest import prepare
from gnrecon.io import read_cloud


def measure(folder: str, scan: str, model: str) -> dict[str, Any]:
    """Fit a scan by default options and save the field."""
    del folder
    samples, _ = prepare(read_cloud(Path(scan)))
    sdf, solution = fit(samples)
    sdf.save(model)
    return {"points": len(samples), "status": solution.status}
