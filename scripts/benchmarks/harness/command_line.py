"""What the benchmarks' commands share: options, checks before the work, provenance, and the JSON report."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil

from gnrecon.report.report import versions
from gnrecon.runtime.errors import OutputError, UsageError
from gnrecon.runtime.files import write_text

REPOSITORY = Path(__file__).resolve().parents[3]


def shared_data(folder: str = "") -> Path:
    """Return the default folder of data that is not part of the repository."""
    return REPOSITORY.parent / "shared" / "data" / folder


def benchmark_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of ``bench NAME``, so far without options."""
    return argparse.ArgumentParser(prog=f"bench {name}", description=description)


def add_outputs(parser: argparse.ArgumentParser, picture: str | None = None, option: str = "--picture") -> None:
    """Add --json, and the option of a PNG file where `picture` says what is drawn."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    if picture is not None:
        parser.add_argument(option, type=Path, metavar="FILE", help=f"{picture} (PNG); an older file is replaced")


def add_data(parser: argparse.ArgumentParser, contents: str, folder: str = "") -> None:
    """Add --data, a folder of `contents`, by default a folder of the shared data."""
    parser.add_argument("--data", type=Path, default=shared_data(folder), metavar="DIR", help=f"folder of {contents}")


def add_repeat(parser: argparse.ArgumentParser, what: str, default: int = 1) -> None:
    """Add --repeat, a positive number of `what`."""
    parser.add_argument("--repeat", type=positive, default=default, metavar="N", help=f"{what} (default: {default})")


def add_quality(parser: argparse.ArgumentParser) -> None:
    """Add --quality, the option of gnrecon."""
    parser.add_argument("--quality", metavar="NAME", help="gnrecon's trade-off between time and accuracy")


def positive(text: str) -> int:
    """Return the positive whole number in an argument; argparse reports one that is none."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a positive whole number was expected, not {text!r}")
    return int(text)


def require_folders(*files: Path | None) -> None:
    """Check before the work that files can be written after it.

    Raises
    ------
    OutputError
        When the folder of a file does not exist.
    """
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise OutputError(f"{file} cannot be written: its folder does not exist.")


def require_drawable(report: Path | None, picture: Path | None) -> None:
    """Check before the work that both files can be written after it, and the picture drawn, where they were named.

    Raises
    ------
    OutputError
        When the folder of a file does not exist.
    UsageError
        When there is no matplotlib for the picture.
    """
    require_folders(report, picture)
    if picture is not None:
        require_matplotlib()


def require_matplotlib() -> None:
    """Check that matplotlib is installed.

    Raises
    ------
    UsageError
        When it is not.
    """
    if find_spec("matplotlib") is None:
        raise UsageError("The plot needs matplotlib; install it with: pip install matplotlib")


def write_report(path: Path | None, report: Mapping[str, Any]) -> None:
    """Write a report as JSON where a file was named; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    if path is not None:
        write_text(path, json.dumps(report, indent=2) + "\n", overwrite=True)


def without_folders(value: Any) -> Any:
    """Return figures without the entries "folder" at any depth: they name temporary folders."""
    if isinstance(value, dict):
        return {key: without_folders(inner) for key, inner in value.items() if key != "folder"}
    return [without_folders(inner) for inner in value] if isinstance(value, list) else value


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a temporary folder for the time of a block."""
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        yield Path(temporary)


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
