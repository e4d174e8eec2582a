"""The files that a run reads and writes.

They are checked before the libraries of a fit are loaded, which takes ten times as long.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gnrecon.io.named_files import all_input_files
from gnrecon.io.write import check_writable
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.files import require_files


@dataclass(frozen=True)
class Files:
    """The files that a run reads and writes; `config` is written, `settings` is the configuration that was read."""

    scans: tuple[Path, ...]
    output: Path
    reference: Path | None = None
    report: Path | None = None
    preview: Path | None = None
    model: Path | None = None
    html: Path | None = None
    overwrite: bool = False
    format: str | None = None
    thumbnail: Path | None = None
    config: Path | None = None
    settings: Path | None = None

    def check(self) -> None:
        """Refuse, before any work, what would fail after it.

        Raises
        ------
        UsageError
            When an extension is unknown, or two files are the same.
        InputError
            When an input is missing.
        OutputError
            When a target exists and may not be overwritten, or its folder is missing.
        """
        check_writable(self.output)
        if self.preview is not None and self.preview.suffix.lower() != ".png":
            raise UsageError(f"The preview is a PNG picture, so it cannot be called {self.preview}.")
        if self.model is not None and self.model.suffix.lower() != ".gnr":
            raise UsageError(f"A fitted field is saved as a .gnr file, so it cannot be called {self.model}.")
        if self.report is not None and self.report.suffix.lower() in (".html", ".htm"):
            raise UsageError(f"The report is JSON, so it cannot be called {self.report}; --html writes a page.")
        if self.html is not None and self.html.suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"The page is an HTML file, so it cannot be called {self.html}.")
        inputs, targets = self.inputs_and_targets()
        if any(target == Path("-") for target in targets):
            raise UsageError("Results are written to files, so none of them can be called -.")
        require_files(inputs, targets, self.overwrite)

    @property
    def named(self) -> list[Path]:
        """All files that are read or written; a log must be none of them."""
        inputs, targets = self.inputs_and_targets()
        return [*inputs, *targets]

    def inputs_and_targets(self) -> tuple[list[Path], list[Path]]:
        """Return the files that are read, with those that scans name, and the files that are written."""
        targets = (self.output, self.report, self.preview, self.model, self.html, self.thumbnail, self.config)
        inputs = [path for path in (self.reference, self.settings) if path is not None]
        return [*all_input_files(self.scans, self.format), *all_input_files(inputs)], [
            path for path in targets if path is not None
        ]
