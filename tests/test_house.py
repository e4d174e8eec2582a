"""The layout keeps its limits: few files a folder, files of one to a few pages, few constants, plain words."""

from __future__ import annotations

import re
from pathlib import Path

import measure_house
import pytest
from measure_house import House, table

HOUSE = House(measure_house.PACKAGE)
REPOSITORY = measure_house.PACKAGE.parent


def test_folders_are_small() -> None:
    assert {folder: count for folder, count in HOUSE.files_in_folders.items() if count > 20} == {}
    assert HOUSE.root_modules <= 12
    assert HOUSE.rooms <= 27


def test_files_are_of_one_size() -> None:
    assert {path: lines for path, lines in HOUSE.lines.items() if lines > 400} == {}
    sizes = sorted(lines for path, lines in HOUSE.lines.items() if path.name != "__init__.py")
    assert sizes[len(sizes) // 2] >= 100


def test_names_occur_once() -> None:
    assert HOUSE.repeated_files == []
    assert HOUSE.repeated_classes == []
    assert HOUSE.array_aliases == {Path("geometry/arrays.py"): ["Float", "Int", "Mask"]}


def test_numbers_stand_in_signatures_and_parameters() -> None:
    assert HOUSE.constants_per_thousand < 3.0


# In these words the house once said what has usual words: reported, ignored, snapped, again, without normals, ...
# Quoted, they are names that files of earlier versions hold.
WORDS = "told|unheard|anew|heed(s|ed|ing)?|laid|wish(es|ed)?|beyond doubt|put up with|fledgling|beside|bare"
DIALECT = re.compile(rf"(?<![\"'])\b({WORDS})\b", re.I)


@pytest.mark.parametrize("folder", ["gnrecon", "docs", "README.md", "CHANGELOG.md"])
def test_words_are_the_usual_ones(folder: str) -> None:
    top = REPOSITORY / folder
    paths = (
        [top] if top.is_file() else [path for path in sorted(top.rglob("*")) if path.suffix in (".py", ".md", ".json")]
    )
    found = [
        f"{path.relative_to(REPOSITORY)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if DIALECT.search(line)
    ]
    assert found == []


def test_a_house_is_measured(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "__init__.py").write_text('"""Nothing."""\n')
    (tmp_path / "a.py").write_text(
        "import numpy as np\n# why\nA, _B = 1, 2\nC: int = 3\nlower = 4\n\nclass One:\n    D = 5\n"
    )
    (tmp_path / "room" / "a.py").write_text('X = "# no comment"  # but this\nclass One:\n    """A # too."""\n')
    house = House(tmp_path)
    assert [name for _, name in house.constants] == ["A", "_B", "C", "X"]
    assert house.total_lines == 12
    assert house.comment_share == pytest.approx(2 / 12)
    assert house.repeated_files == ["a.py"]
    assert house.repeated_classes == ["One"]
    assert (house.root_modules, house.rooms) == (2, 3)
    (tmp_path / "b.py").write_text("import numpy.typing as npt\n\nRows = npt.NDArray[np.intp]\n")
    assert House(tmp_path).array_aliases == {Path("b.py"): ["Rows"]}
    text = table({"one": house})
    assert "| UPPERCASE constants per 1,000 lines | 333.3 |" in text
    assert "| most files in a folder / at the root | 2 / 2 |" in text
