"""What a child process does for one scan: the same as ``gnrecon SCAN -o MESH``, with all files in a folder of its own.

Only when everything was written and verified there do the files receive their names, from the process that waits.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from gnrecon.batch.job import FAILURE, PROGRESS
from gnrecon.optim import Record
from gnrecon.pipeline import Progress
from gnrecon.runtime.errors import ExitCode, failure

_SELDOM = 0.5


def prepare() -> None:
    """Import what a run needs, before any child is forked."""
    import gnrecon.run  # noqa: F401 - what is imported here, no child has to import
    from gnrecon.runtime.preload import preload

    preload()


def work(argument: dict[str, Any]) -> int:
    """Reconstruct a scan and return the exit code; a failure's sentence is left in the attempt's folder.

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
        (folder / FAILURE).write_text(sentence, encoding="utf-8")
        return code


def _reconstruct(argument: dict[str, Any], folder: Path) -> ExitCode:
    from gnrecon.run import Files, run

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
    told = Told(argument["name"], folder / PROGRESS)
    return ExitCode(run(files, argument["options"], command=argument["command"], watcher=told))


class Told(Progress):
    """Tells the stage of a run, and how much of it is done, by a small file that is written anew now and then."""

    def __init__(self, name: str, path: Path) -> None:
        self._name, self._path, self._begun = name, path, time.time()
        self._stage, self._share, self._told = "start", 0.0, 0.0
        self._write()

    def stage(self, name: str) -> None:
        """Tell a new stage at once."""
        self._stage, self._share = name, 0.0
        self._write()

    def advance(self, share: float) -> None:
        """Tell the share, but not too often."""
        self._share = share
        if time.monotonic() - self._told > _SELDOM:
            self._write()

    def step(self, record: Record, total: int) -> None:
        """Take a step as its share of all."""
        self.advance(record.step / max(total, 1))

    def remark(self, sentence: str) -> None:
        """Put a sentence into the log."""
        print(sentence, file=sys.stderr, flush=True)

    def _write(self) -> None:
        self._told = time.monotonic()
        state = {
            "name": self._name,
            "pid": os.getpid(),
            "begun": self._begun,
            "stage": self._stage,
            "share": round(self._share, 3),
        }
        self._path.write_text(json.dumps(state), encoding="utf-8")
