"""The record of a finished scan: by it a batch that is started again knows what need not be done twice.

A record is written when a result was verified and hashed, and before its files receive their names. So at whatever
moment a batch is killed, what a record tells of is either in place, or in the attempt's folder, from where the next
start brings it; and a file that is there is either known to a record, as the result or as what it was about to replace,
or somebody else's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gnrecon.batch.identity import hash_if_there
from gnrecon.runtime.files import write_text


@dataclass(frozen=True)
class Record:
    """Finished work.

    Parameters
    ----------
    identity : what it depends on, as of `identity_of`
    outputs : hash of each file of the result, by its path relative to the output folder
    replaced : hash of each file that this result was to replace
    staged : folder that holds the files until they receive their names, relative to the output folder
    told : what is told of it beside its files, fields of `Outcome`
    """

    identity: Mapping[str, Any]
    outputs: Mapping[str, str]
    replaced: Mapping[str, str]
    staged: str
    told: Mapping[str, Any]

    def holds(self, identity: Mapping[str, Any], folder: Path) -> bool:
        """Whether the same work was asked for, and its files are there as they were written."""
        return identity == self.identity and all(
            hash_if_there(folder / name) == known for name, known in self.outputs.items()
        )

    def knows(self, name: str, found: str) -> bool:
        """Whether a file of this name and hash is one of the batch's own."""
        return found in (self.outputs.get(name), self.replaced.get(name))

    def place(self, folder: Path) -> None:
        """Let the files that still wait in the attempt's folder have their names."""
        for name, known in self.outputs.items():
            if hash_if_there(folder / self.staged / name) == known:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / self.staged / name).replace(folder / name)

    def write(self, path: Path) -> None:
        """Write the record atomically; an older one is replaced.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(asdict(self), indent=2) + "\n", overwrite=True)


def read_record(path: Path) -> Record | None:
    """Return the record in a file; None where there is none, or what is there is none."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def all_records(folder: Path) -> list[Record]:
    """Return the records below a folder; a hidden file is one that was not yet written to its end."""
    records = [read_record(path) for path in sorted(folder.rglob("*.json")) if not path.name.startswith(".")]
    return [record for record in records if record is not None]
