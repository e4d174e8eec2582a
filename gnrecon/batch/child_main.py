"""Entry point of a child process, which reconstructs one scan as ``gnrecon SCAN -o MESH`` does.

All files are written into a folder of the attempt. The waiting process moves them into place once everything was
written and verified. `work` is started by `gnrecon.batch.fork_server`.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from gnrecon.batch.job import failure_file, progress_file
from gnrecon.optim import Record
from gnrecon.pipeline import Progress
from gnrecon.runtime.errors import ExitCode, failure


def prepare() -> None:
    """Import everything that a run needs, before any child is forked."""
    import gnrecon.run  # noqa: F401 - imported once here, so that no child has to
    from gnrecon.runtime.preload import preload

    preload()


def work(argument: dict[str, Any]) -> int:
    """Reconstruct a scan and return the exit code; the sentence on a failure is written to the attempt's folder.

    Parameters
    ----------
    argument : plain values: ``name``, ``folder`` of the attempt, ``scan``, ``files`` (names by kind, and
        ``thumbnail``), ``options``, ``reference``, ``command``
    """
    folder = Path(argument["folder"])
    try:
        return _reconstruct(argument, folder)
    except BaseException as error:
        traceback.print_exc()
        sentence, code = failure(error)
        print(f"gnrecon: {sentence}", file=sys.stderr)
        failure_file(folder).write_text(sentence, encoding="utf-8", errors="backslashreplace")
        return code


def _reconstruct(argument: dict[str, Any], folder: Path) -> ExitCode:
    from gnrecon.io.run_files import Files
    from gnrecon.run import run

    paths = {kind: folder / name for kind, name in argument["files"].items()}
    reference = argument["reference"]
    files = Files(
        scans=(Path(argument["scan"]),),
        output=paths["mesh"],
        reference=None if reference is None else Path(reference),
        report=paths["report"],
        preview=paths.get("preview"),
        model=paths.get("model"),
        html=paths.get("page"),
        thumbnail=paths["thumbnail"],
    )
    files.check()
    progress = ProgressFile(argument["name"], progress_file(folder))
    return ExitCode(run(files, argument["options"], command=argument["command"], watcher=progress))


class ProgressFile(Progress):
    """Writes the stage of a run, and the share of it that is done, to a small JSON file.

    Parameters
    ----------
    name : of the scan's outputs
    path : file to write, replaced on each update
    interval_seconds : time between two updates within a stage; the live table is drawn twice a second
    """

    def __init__(self, name: str, path: Path, *, interval_seconds: float = 0.5) -> None:
        self._name, self._path, self._interval = name, path, interval_seconds
        self._start_time = time.time()
        self._stage, self._share, self._written_at = "start", 0.0, 0.0
        self._write()

    def stage(self, name: str) -> None:
        """Write a new stage immediately."""
        self._stage, self._share = name, 0.0
        self._write()

    def advance(self, share: float) -> None:
        """Write the share if the last update is old enough."""
        self._share = share
        if time.monotonic() - self._written_at > self._interval:
            self._write()

    def step(self, record: Record, total: int) -> None:
        """Count a step as its share of all steps."""
        self.advance(record.step / max(total, 1))

    def remark(self, sentence: str) -> None:
        """Print a sentence, which goes to the log."""
        print(sentence, file=sys.stderr, flush=True)

    def _write(self) -> None:
        self._written_at = time.monotonic()
        state = {
            "name": self._name,
            "pid": os.getpid(),
            "begun": self._start_time,
            "stage": self._stage,
            "share": round(self._share, 3),
        }
        self._path.write_text(json.dumps(state), encoding="utf-8")
