"""Small analytic scans, as arrays and as files, options that reconstruct them fast, and the command line as a process.

Every process is a fresh interpreter, because exit codes, streams and signals are what the tests are about. A process
may be told to run a line of Python before the command line begins, to stop at a known moment or to break one stage.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import made_shapes
import numpy as np

from gnrecon.geometry.arrays import Float

TUBE = 0.3
TORUS_VOLUME = 2 * np.pi**2 * TUBE**2
FAST = {"widths": (300,), "steps": 1, "resolution": 48}
FAST_WORDS = ("--widths", "300", "--steps", "1", "--resolution", "48")

# Where the tests themselves run in the background, SIGINT arrives ignored, and children would inherit that.
_LAUNCH = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
{before}
from gnrecon.cli.app import main
main()
"""


def torus(count: int, rng: np.random.Generator) -> tuple[Float, Float]:
    """Points and normals on a torus around z, of radius 1 and tube `TUBE`."""
    return made_shapes.torus(count, rng, 1.0, TUBE)


def write_scan(path: Path, points: Float, normals: Float) -> Path:
    """Write a binary PLY of doubles."""
    rows = np.hstack([points, normals])
    properties = "".join(f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.astype("<f8").tobytes())
    return path


def gnrecon(*words: object) -> subprocess.CompletedProcess[str]:
    """Run ``python -m gnrecon`` to its end."""
    command = [sys.executable, "-m", "gnrecon", *map(str, words)]
    return subprocess.run(command, env=_environment(), capture_output=True, text=True, check=False, timeout=120)


def start(*words: object, before: str = "") -> subprocess.Popen[str]:
    """Start the command line in a process that takes SIGINT, after the code `before`."""
    command = [sys.executable, "-c", _LAUNCH.format(before=before), *map(str, words)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=_environment(), stdout=pipe, stderr=pipe, text=True)


def wait_for(process: subprocess.Popen[str], word: str) -> None:
    """Read the process's stderr up to a line that begins with `word`."""
    assert process.stderr is not None
    seen = []
    for line in process.stderr:
        seen.append(line)
        if line.startswith(word):
            return
    raise AssertionError(f"the process ended without saying {word!r}: {''.join(seen)}")


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1]), "OMP_WAIT_POLICY": "PASSIVE"}
