"""Reading one scan: the time and, by its process, the memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from gnrecon.io import read_scans


def measure(folder: str, scan: str, most: int) -> dict[str, Any]:
    """Read a scan, keep at most `most` of its points, and return the figures."""
    del folder
    start, cpu_start = time.perf_counter(), time.process_time()
    cloud, reading = read_scans([scan], most=most)
    end, cpu_end = time.perf_counter(), time.process_time()
    return {
        "points": reading.points,
        "kept": len(cloud),
        "side": reading.side,
        "bytes": Path(scan).stat().st_size,
        "seconds": end - start,
        "cpu_seconds": cpu_end - cpu_start,
        "points_per_second": reading.points / (end - start),
        "points_per_cpu_second": reading.points / (cpu_end - cpu_start),
    }
