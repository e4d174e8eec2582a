"""Starting a program of the benchmarks in a Python process of its own, which it meets in a folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gnrecon

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def run_program(
    module: str, job: dict[str, Any], threads: int, folder: Path, limit: float | None = None
) -> dict[str, Any]:
    """Run ``python -m module folder`` on a job.json in a new `folder`; return the figures.json that it leaves there.

    A failure is a result too, and so is not to end within `limit` seconds: the sentence under ``"error"`` then takes
    the figures' place.
    """
    folder.mkdir(parents=True)
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
    here = [Path(__file__).resolve().parents[1], Path(str(gnrecon.__file__)).parents[1]]
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(threads))
    # The new process is to measure this very gnrecon, wherever it was imported from.
    environment["PYTHONPATH"] = os.pathsep.join(map(str, here))
    command = [sys.executable, "-m", module, str(folder)]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=limit)
    except subprocess.TimeoutExpired:
        return {"error": f"It had not ended after {limit:g} seconds."}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:]
        # What was killed (for want of memory, say) has said nothing about it.
        said = last[0] if last and done.returncode > 0 else f"The process ended with status {done.returncode}."
        return {"error": said}
    figures: dict[str, Any] = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
    return figures
