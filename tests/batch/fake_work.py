"""Fake work for child processes: does what the text of a scan's file says instead of reconstructing it."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from gnrecon.batch.job import Job, Limits, failure_file

WORK = "fake_work"

PNG = b"no picture"
REPORT = {
    "mesh": {
        "vertices": 4,
        "faces": 4,
        "components": 1,
        "genus": 0,
        "closed": True,
        "area": 1.0,
        "volume": 0.1,
        "invented_area_share": 0.0,
    },
    "ingest": {"kept": 100},
    "metrics": None,
}


def work(argument: dict[str, Any]) -> int:
    """Do what the first word of the scan says, and log its start and end in the folder of the scan."""
    scan, folder = Path(argument["scan"]), Path(argument["folder"])
    words = scan.read_text().split()
    _note(scan, "began")
    print(f"words of {scan.name}")
    code = _DEEDS[words[0]](*words[1:])
    if code:
        failure_file(folder).write_text(f"{scan.name} ends with {code}.")
        return code
    for kind, name in argument["files"].items():
        (folder / name).write_bytes(_content(kind, scan, argument["options"]))
    _note(scan, "ended")
    return 0


def _content(kind: str, scan: Path, options: dict[str, Any]) -> bytes:
    if kind == "report":
        return json.dumps(REPORT).encode()
    return hashlib.sha256(kind.encode() + scan.read_bytes() + json.dumps(options).encode()).digest()


def _good(seconds: str = "0", *ignored: str) -> int:
    del ignored
    time.sleep(float(seconds))
    return 0


def _sleep() -> int:
    subprocess.run(["sleep", "60"], check=True)
    return 0


def _hog() -> int:
    hoard = [b"x" * 50_000_000 for _ in range(20)]
    time.sleep(60)
    return len(hoard)


def _signal(name: str, once: str | None = None) -> int:
    """Kill this process, unless a file shows that it was killed before."""
    if once is not None and Path(once).exists():
        return 0
    if once is not None:
        Path(once).touch()
    os.kill(os.getpid(), signal.Signals[name])
    return 0


def _native(*words: str) -> int:
    """End as native code does that finds no memory: by words on standard error, and outside of Python."""
    os.write(2, " ".join(words).encode() + b"\n")
    os.abort()


def _litter() -> int:
    Path(os.environ["TMPDIR"], "left").touch()
    return 1


_DEEDS = {
    "good": _good,
    "sleep": _sleep,
    "hog": _hog,
    "signal": _signal,
    "exit": int,
    "litter": _litter,
    "native": _native,
}


def _note(scan: Path, word: str) -> None:
    with (scan.parent / "notes.log").open("a") as notes:
        notes.write(f"{scan.stem} {word}\n")


def notes(folder: Path, word: str) -> list[str]:
    """Names of the scans of a folder with such an entry in the log, in order."""
    path = folder / "notes.log"
    lines = [line.split() for line in path.read_text().splitlines()] if path.exists() else []
    return [name for name, entry in lines if entry == word]


def job(folder: Path, name: str, text: str, limits: Limits | None = None, **more: Any) -> Job:
    """A job for a new scan with this text; outputs go into a folder next to that of the scans."""
    scans = folder / "scans"
    scans.mkdir(exist_ok=True)
    scan = scans / f"{Path(name).name}.ply"
    if not scan.exists() or scan.read_text() != text:
        scan.write_text(text)
    output = folder / "meshes"
    output.mkdir(exist_ok=True)
    return Job(
        name, scan, output, {"threads": 1, "device": "cpu"} | more.pop("options", {}), limits=limits or Limits(), **more
    )
