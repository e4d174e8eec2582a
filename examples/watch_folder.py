"""Watch a folder: each scan that is completely written there becomes a verified mesh, once.

    python examples/watch_folder.py incoming meshes --quality draft

A scan counts as complete when its size and time have stayed the same from one look to the next. The folder is looked at
again and again rather than subscribed to, because network shares, on which scanners like to write, tell nobody of
changes. A scan then moves to ``incoming/done``, and one that fails to ``incoming/failed``, beside a text file with the
reason; what is in neither is still to be done, so that nothing else has to be remembered. Ctrl-C or a polite kill ends
the watch, in the middle of a reconstruction as well: nothing half-made is left, and its scan stays where it is.
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

INTERVAL = 2.0
"""Seconds between two looks."""

Stamp = tuple[int, int]
"""A file's size, and when it was last written."""

_log = logging.getLogger("watch_folder")


class Stopper(gnrecon.Progress):
    """Ends a reconstruction once the watch is to end."""

    def __init__(self, stop: Event) -> None:
        self._stop = stop

    def stage(self, name: str) -> None:
        """Look at each stage."""
        del name
        self._check()

    def advance(self, share: float) -> None:
        """Look within stages, too."""
        del share
        self._check()

    def _check(self) -> None:
        if self._stop.is_set():
            raise gnrecon.Cancelled


def watch(incoming: Path, meshes: Path, options: Mapping[str, Any], stop: Event, interval: float = INTERVAL) -> None:
    """Reconstruct what comes into a folder until `stop` is set; meshes are PLY files named for their scans."""
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
    """Make one scan's mesh and move the scan away; a watch that ends leaves both as they were."""
    _log.info("%s", scan)
    try:
        result = gnrecon.reconstruct(scan, progress=Stopper(stop), **options)
        notes = result.save(mesh)
    except gnrecon.Cancelled:
        _log.info("%s waits for the next time.", scan)
        return
    except gnrecon.GnreconError as failure:
        aside = _moved(scan, "failed")
        aside.with_name(f"{aside.name}.reason.txt").write_text(f"{failure}\n", encoding="utf-8")
        _log.warning("%s", failure)
        return
    _moved(scan, "done")
    _log.info("%s: %d faces. %s", mesh, len(result.mesh.faces), " ".join(notes))


def _scans(folder: Path) -> list[Path]:
    """The files of a folder that gnrecon reads; hidden ones are those that others are still writing."""
    known = gnrecon.readable()
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return [path for path in files if Path(path.name.lower().removesuffix(".gz")).suffix in known]


def _stamp(path: Path) -> Stamp:
    try:
        found = path.stat()
    except FileNotFoundError:  # whoever wrote it has renamed it meanwhile
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _moved(scan: Path, name: str) -> Path:
    """Move a scan into a folder beside it, under a name that nothing there has, and return where it is now."""
    folder = scan.parent / name
    folder.mkdir(exist_ok=True)
    names = chain([scan.name], (f"{scan.stem}.{number}{scan.suffix}" for number in count(2)))
    target = next(folder / one for one in names if not (folder / one).exists())
    return scan.rename(target)


def main(arguments: Sequence[str] | None = None) -> None:
    """Watch as the arguments say, until Ctrl-C or a polite kill."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("incoming", type=Path, help="folder where scans arrive")
    parser.add_argument("meshes", type=Path, help="folder for the meshes")
    parser.add_argument("--quality", default="normal", help="draft, normal or high")
    parser.add_argument("--resolution", type=int, help="cells along the longest side")
    parser.add_argument("--interval", type=float, default=INTERVAL, help="seconds between two looks")
    chosen = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    options = {"quality": chosen.quality, "resolution": chosen.resolution}
    watch(chosen.incoming, chosen.meshes, options, stop, chosen.interval)


if __name__ == "__main__":
    main()
