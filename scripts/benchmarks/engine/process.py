"""A measurement in a Python process of its own, so that its peak memory is its own too.

The two sides meet in a folder: the function's name and arguments go in, what it returns and the peak memory come out.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from benchmarks.alone import run_program
from gnrecon.runtime.memory import process_peak_mb


def run_alone(module: str, function: str, folder: Path, **arguments: Any) -> dict[str, Any]:
    """Call a function with plain arguments, and `folder` as a string, in a new process; return its plain figures.

    Added to them are peak memory, `peak_memory_mb`, and what of it the libraries took, `libraries_memory_mb`. A failure
    is a result too: the sentence under ``"error"`` then takes the figures' place.
    """
    job = {"module": module, "function": function, "arguments": arguments}
    return run_program("benchmarks.engine.process", job, torch.get_num_threads(), folder)


def main(folder: Path) -> None:
    """Do the job in `folder`, leaving figures.json there."""
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    call = getattr(import_module(job["module"]), job["function"])
    before = process_peak_mb()
    figures = call(folder=str(folder), **job["arguments"])
    memory = {"peak_memory_mb": process_peak_mb(), "libraries_memory_mb": before}
    if torch.cuda.is_available():
        memory["peak_device_memory_mb"] = torch.cuda.max_memory_allocated() / 1e6
    (folder / "figures.json").write_text(json.dumps(figures | memory), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
