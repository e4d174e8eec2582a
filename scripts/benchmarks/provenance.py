"""Where figures come from: the machine, the versions, the commit and the command, as plain values."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil

from gnrecon.report.report import versions

REPOSITORY = Path(__file__).resolve().parents[2]


def provenance(benchmark: str, arguments: Sequence[str]) -> dict[str, Any]:
    """Return what is needed to make the figures of a benchmark again, ready for JSON."""
    return {
        "benchmark": benchmark,
        "command": shlex.join(["./scripts/bench", benchmark, *arguments]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "machine": {
            "cpu": _cpu(),
            "cores": os.cpu_count(),
            "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        },
        "versions": versions(),
    }


def _cpu() -> str:
    """The processor's name; Python knows no more than its architecture on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit, with ``-dirty`` where tracked files differ from it; None outside of a git repository."""
    if shutil.which("git") is None or not (REPOSITORY / ".git").exists():
        return None
    command = ["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return answer.stdout.strip() if answer.returncode == 0 else None
