"""Measures how a package is laid out: files a folder, sizes, module constants, comments, and names that occur twice.

Run it as ``python scripts/measure_house.py``, or with the folders of other packages to compare with. The test
`tests/test_house.py` holds the limits.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import statistics
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "gnrecon"


@dataclass(frozen=True)
class House:
    """The Python files below a folder.

    Parameters
    ----------
    folder : of a package
    """

    folder: Path

    @cached_property
    def sources(self) -> dict[Path, str]:
        """The text of each file, by its path relative to the folder."""
        found = sorted(path for path in self.folder.rglob("*.py") if "__pycache__" not in path.parts)
        return {path.relative_to(self.folder): path.read_text(encoding="utf-8") for path in found}

    @cached_property
    def lines(self) -> dict[Path, int]:
        """The number of lines of each file."""
        return {path: text.count("\n") for path, text in self.sources.items()}

    @property
    def total_lines(self) -> int:
        """The number of lines of all files."""
        return sum(self.lines.values())

    @cached_property
    def files_in_folders(self) -> Counter[Path]:
        """How many files each folder holds."""
        return Counter(path.parent for path in self.sources)

    @property
    def root_modules(self) -> int:
        """How many modules lie in the package's own folder."""
        return self.files_in_folders[Path()]

    @property
    def rooms(self) -> int:
        """How many folders and modules the package's own folder holds."""
        return len({path.parts[0] for path in self.sources})

    @cached_property
    def constants(self) -> list[tuple[Path, str]]:
        """Upper-case names that modules assign to, private ones and those of tuples included."""
        return [(path, name) for path, text in self.sources.items() for name in _constants(ast.parse(text))]

    @property
    def constants_per_thousand(self) -> float:
        """Module constants for each 1,000 lines."""
        return 1000 * len(self.constants) / max(self.total_lines, 1)

    @cached_property
    def comment_share(self) -> float:
        """Share of the lines that hold a comment, docstrings not counted."""
        return sum(map(_comment_lines, self.sources.values())) / max(self.total_lines, 1)

    @property
    def repeated_files(self) -> list[str]:
        """Names that several files have, but for ``__init__.py``."""
        return _repeated(path.name for path in self.sources if path.name != "__init__.py")

    @cached_property
    def repeated_classes(self) -> list[str]:
        """Names that classes of several modules have."""
        trees = map(ast.parse, self.sources.values())
        return _repeated(node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef))

    @cached_property
    def array_aliases(self) -> dict[Path, list[str]]:
        """Names that modules give to the arrays of float64, of integers and of bool."""
        pattern = re.compile(
            r"^(\w+) = npt\.NDArray\[np\.(?:float64|bool_?|int64|intp|integer)(?:\[\w+\])?\]", re.MULTILINE
        )
        found = {path: pattern.findall(text) for path, text in self.sources.items()}
        return {path: names for path, names in found.items() if names}


def _constants(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in targets:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name.id):
                    yield name.id


def _comment_lines(text: str) -> int:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return len({token.start[0] for token in tokens if token.type == tokenize.COMMENT})


def _repeated(names: Iterator[str]) -> list[str]:
    return sorted(name for name, count in Counter(names).items() if count > 1)


def rows(houses: dict[str, House]) -> Iterator[tuple[str, list[str]]]:
    """Yield what each row of the table is about, and a cell for each house."""
    each = list(houses.values())
    yield "files, lines", [f"{len(house.sources)}, {house.total_lines:,}" for house in each]
    yield "rooms", [f"{house.rooms}" for house in each]
    yield (
        "most files in a folder / at the root",
        [f"{max(house.files_in_folders.values())} / {house.root_modules}" for house in each],
    )
    yield "lines of a file, median / 90 %", [_sizes(house) for house in each]
    yield "longest file", [f"{max(house.lines.values())}" for house in each]
    yield "UPPERCASE constants per 1,000 lines", [f"{house.constants_per_thousand:.1f}" for house in each]
    yield "lines of comments", [f"{100 * house.comment_share:.1f} %" for house in each]
    yield "file names that occur twice", [f"{len(house.repeated_files)}" for house in each]
    yield "class names that occur twice", [f"{len(house.repeated_classes)}" for house in each]


def _sizes(house: House) -> str:
    # Files without a line of code, such as most __init__.py, say nothing about sizes.
    sizes = [lines for path, lines in house.lines.items() if path.name != "__init__.py"] or [0]
    nine_tenths = statistics.quantiles(sizes, n=10)[-1] if len(sizes) > 1 else sizes[0]
    return f"{statistics.median(sizes):.0f} / {nine_tenths:.0f}"


def table(houses: dict[str, House]) -> str:
    """Return a Markdown table with a column for each house."""
    lines = [f"| | {' | '.join(houses)} |", f"|---|{'---|' * len(houses)}"]
    lines += [f"| {label} | {' | '.join(cells)} |" for label, cells in rows(houses)]
    return "\n".join(lines)


def main(words: list[str]) -> int:
    """Print the table for gnrecon, or for the packages that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("packages", nargs="*", type=Path, help="folders of packages; by default gnrecon's")
    folders = parser.parse_args(words).packages or [PACKAGE]
    print(table({folder.resolve().name: House(folder) for folder in folders}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
