"""Watch a folder: each scan that was completely written there becomes a verified mesh, once.

    python examples/watch_folder.py incoming meshes --quality draft

A scan is complete when its size and time have not changed between two looks. The folder is polled, because network
shares, to which many scanners write, send no notifications. A finished scan moves to ``incoming/done``, and one that
fails to ``incoming/failed``, with a text file of the reason; the others are still to do, so no other state is kept.
Ctrl-C or SIGTERM ends the watch, even during a reconstruction: no partial file is left, and the scan stays in place.
"""

from __future__ import annotations

import argparse
import logging
import signal
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from threading import Event
from typing import Any

import gnrecon

Stamp = tuple[int, int]
"""A file's size, and when it was last written."""

_log = logging.getLogger("watch_folder")


class Stopper(gnrecon.Progress):
    """Ends a reconstruction when the watch ends."""

    def __init__(self, stop: Event) -> None:
        self._stop = stop

    def stage(self, name: str) -> None:
        """Check at each stage."""
        del name
        self._check()

    def advance(self, share: float) -> None:
        """Check within stages, too."""
        del share
        self._check()

    def _check(self) -> None:
        if self._stop.is_set():
            raise gnrecon.Cancelled


def watch(incoming: Path, meshes: Path, options: Mapping[str, Any], stop: Event, interval: float = 2.0) -> None:
    """Reconstruct the scans that arrive in a folder until `stop` is set; meshes are PLY files named after their scans.

    `interval` is the time between two looks, in seconds.
    """
    _log.info("Watching %s.", incoming)
    seen: dict[Path, Stamp] = {}
    while not stop.is_set():
        now = {path: _stamp(path) for path in _scans(incoming)}
        for path in sorted(path for path, stamp in now.items() if seen.get(path) == stamp and stamp[0]):
            if not stop.is_set():
                _one(path, meshes / f"{path.name}.ply", options, stop)
        seen = now
        stop.wait(interval)


def _one(scan: Path, mesh: Path, options: Mapping[str, Any], stop: Event) -> None:
    """Make the mesh of a scan and move the scan; if the watch ends, no mesh is made and the scan stays."""
    _log.info("%s", scan)
    try:
        result = gnrecon.reconstruct(scan, progress=Stopper(stop), **options)
        notes = result.save(mesh)
    except gnrecon.Cancelled:
        _log.info("%s stays for the next run.", scan)
        return
    except gnrecon.GnreconError as failure:
        aside = _moved(scan, "failed")
        aside.with_name(f"{aside.name}.reason.txt").write_text(f"{failure}\n", encoding="utf-8")
        _log.warning("%s", failure)
        return
    _moved(scan, "done")
    _log.info("%s: %d faces. %s", mesh, len(result.mesh.faces), " ".join(notes))


def _scans(folder: Path) -> list[Path]:
    """Return the files of a folder that gnrecon reads; hidden ones are still being written."""
    known = gnrecon.readable()
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return [path for path in files if Path(path.name.lower().removesuffix(".gz")).suffix in known]


def _stamp(path: Path) -> Stamp:
    try:
        found = path.stat()
    except FileNotFoundError:  # it was renamed since
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _moved(scan: Path, name: str) -> Path:
    """Move a scan into a subfolder under a free name, and return its new path."""
    folder = scan.parent / name
    folder.mkdir(exist_ok=True)
    names = chain([scan.name], (f"{scan.stem}.{number}{scan.suffix}" for number in count(2)))
    target = next(folder / one for one in names if not (folder / one).exists())
    return scan.rename(target)


def main(arguments: Sequence[str] | None = None) -> None:
    """Watch until Ctrl-C or SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("incoming", type=Path, help="folder where scans arrive")
    parser.add_argument("meshes", type=Path, help="folder for the meshes")
    parser.add_argument("--quality", default="normal", help="draft, normal or high")
    parser.add_argument("--resolution", type=int, help="cells along the longest side")
    parser.add_argument("--interval", type=float, default=2.0, help="seconds between two looks")
    chosen = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    options = {"quality": chosen.quality, "resolution": chosen.resolution}
    watch(chosen.incoming, chosen.meshes, options, stop, chosen.interval)


if __name__ == "__main__":
    main()
