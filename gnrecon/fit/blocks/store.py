"""The work folder of a large fit: the data of its blocks, and the blocks that have been solved.

Each array has its own file, so that every process maps it and reads only the rows that its blocks need. The manifest is
written last, with a fingerprint of everything that determines the result; a block's file gets its name only when it is
complete. So a run that was killed at any moment can be resumed by the same run, and by no other.
Entry: `WorkFolder.open`.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.runtime.errors import InputError, OutputError, UsageError
from gnrecon.runtime.files import atomic_write
from gnrecon.version import __version__

Arrays = Mapping[str, npt.NDArray[Any]]

FORMAT = "gnrecon-work-2"
"""Of the manifest; a change of the arrays or their meaning needs another."""


@dataclass(frozen=True)
class WorkFolder:
    """A folder with a manifest."""

    folder: Path

    @classmethod
    def open(cls, folder: str | Path, arrays: Arrays, facts: Mapping[str, Any]) -> WorkFolder:
        """Create a work folder, or open it again if it holds the same work already.

        Parameters
        ----------
        folder : created if it is missing
        arrays : by names, of letters and digits
        facts : plain values that determine the result, besides the arrays

        Raises
        ------
        UsageError
            When the folder holds the work of another run, or other files.
        OutputError
            When it cannot be written.
        """
        work, print_ = cls(Path(folder)), fingerprint(arrays, facts)
        try:
            work.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"The work folder {folder} cannot be created: {error.strerror or error}.") from error
        require_work_folder(folder)
        if work._belongs_to(print_):
            return work
        # Without a manifest, arrays of a killed run may be there, complete or not.
        for name, values in arrays.items():
            with atomic_write(work.folder / f"{name}.npy", overwrite=True) as temporary:
                np.save(temporary, values)
        with atomic_write(work.manifest_path) as temporary:
            manifest = {"format": FORMAT, "gnrecon": __version__, "fingerprint": print_, "facts": dict(facts)}
            temporary.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        return work

    @property
    def manifest_path(self) -> Path:
        """Where the manifest is."""
        return self.folder / "manifest.json"

    def _belongs_to(self, print_: str) -> bool:
        """Whether the folder holds the work of a fingerprint; False where it holds none yet.

        Raises
        ------
        UsageError
            Where it holds that of another fingerprint.
        """
        if not (self.manifest_path).exists():
            return False
        if self.manifest.get("fingerprint") != print_:
            raise UsageError(
                f"The work folder {self.folder} belongs to another run (its scan, options or version differ); "
                f"name a new or an empty folder."
            )
        return True

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The manifest.

        Raises
        ------
        InputError
            When there is none, or it is damaged.
        """
        path = self.manifest_path
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{path} cannot be read: {error}.") from error
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise InputError(f"{path} is not a manifest of the format {FORMAT!r}.")
        return found

    @property
    def facts(self) -> dict[str, Any]:
        """The plain values that the folder was created with."""
        facts: dict[str, Any] = self.manifest["facts"]
        return facts

    def array(self, name: str) -> npt.NDArray[Any]:
        """Return an array of the work, mapped from its file, so that only the rows in use are read."""
        return np.asarray(np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False))

    def is_solved(self, block: int) -> bool:
        """Whether a block has been solved."""
        return self._block(block).exists()

    def save(self, block: int, solved: Arrays) -> None:
        """Save the result of a block."""
        with atomic_write(self._block(block), overwrite=True) as temporary:
            np.savez(temporary, **solved)  # type: ignore[arg-type]  # its stubs take the arrays for `allow_pickle`

    def load(self, block: int) -> dict[str, npt.NDArray[Any]]:
        """Return the result of a block.

        Raises
        ------
        InputError
            When its file is damaged.
        """
        try:
            with np.load(self._block(block), allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{self._block(block)} cannot be read ({error}); delete it to solve it again.") from error

    def _block(self, block: int) -> Path:
        return self.folder / f"block-{block:06d}.npz"


def require_work_folder(folder: str | Path) -> None:
    """Refuse a folder that holds other files than those of a work folder; a missing one is accepted.

    Raises
    ------
    UsageError
        With the name of such a file.
    """
    if not Path(folder).exists():
        return
    if not Path(folder).is_dir():
        raise UsageError(f"{folder} is not a folder; name a new or an empty one.")
    # Hidden files are those that a killed run left half written.
    own = re.compile(r"(manifest\.json|\w+\.npy|block-\d+\.npz|\.[\w.-]+)")
    foreign = sorted(path.name for path in Path(folder).iterdir() if not own.fullmatch(path.name))
    if foreign:
        raise UsageError(f"{folder} is not a work folder: it holds {foreign[0]!r}; name a new or an empty folder.")


def fingerprint(arrays: Arrays, facts: Mapping[str, Any]) -> str:
    """Return a hash, in hexadecimal digits, of everything that determines the result."""
    # The version is part of it: other code may give other results.
    digest = hashlib.sha256(json.dumps([FORMAT, __version__, facts], sort_keys=True).encode())
    for name in sorted(arrays):
        # Type and shape as well, as equal bytes may mean other values.
        values = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(values.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
