"""Work folders: resumed by the same work only, in whatever state a kill has left them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnrecon.fit.blocks.store import WorkFolder, require_work_folder
from gnrecon.runtime.errors import InputError, UsageError

ARRAYS = {"points": np.arange(12.0).reshape(4, 3), "cells": np.arange(3, dtype=np.uint64)}
FACTS = {"seed": 0, "length": 0.1}


def test_work_is_saved_and_resumed(tmp_path: Path) -> None:
    work = WorkFolder.open(tmp_path / "work", ARRAYS, FACTS)
    assert work.facts == FACTS
    assert work.array("points").tolist() == ARRAYS["points"].tolist()
    assert not work.is_solved(7)
    work.save(7, {"lengths": np.ones(2)})
    again = WorkFolder.open(tmp_path / "work", ARRAYS, FACTS)
    assert again.is_solved(7)
    assert again.load(7)["lengths"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("arrays", "facts"),
    [
        (ARRAYS, FACTS | {"seed": 1}),
        (ARRAYS | {"points": ARRAYS["points"] + 1e-12}, FACTS),
        (ARRAYS | {"cells": np.arange(3, dtype=np.int64)}, FACTS),
    ],
)
def test_other_work_is_refused(tmp_path: Path, arrays: dict[str, np.ndarray], facts: dict[str, float]) -> None:
    WorkFolder.open(tmp_path, ARRAYS, FACTS)
    with pytest.raises(UsageError, match="belongs to another run"):
        WorkFolder.open(tmp_path, arrays, facts)
    assert WorkFolder(tmp_path).array("points").tolist() == ARRAYS["points"].tolist()


def test_a_folder_of_anything_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("beach")
    with pytest.raises(UsageError, match=r"is not a work folder: it holds 'holiday\.jpg'"):
        WorkFolder.open(tmp_path, ARRAYS, FACTS)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]
    with pytest.raises(UsageError, match="is not a folder"):
        require_work_folder(tmp_path / "holiday.jpg")
    require_work_folder(tmp_path / "none")


def test_what_a_kill_left_half_written_is_written_again(tmp_path: Path) -> None:
    (tmp_path / "points.npy").write_bytes(b"half")
    (tmp_path / ".cells.0123.npy").write_bytes(b"")
    work = WorkFolder.open(tmp_path, ARRAYS, FACTS)
    assert work.array("points").shape == (4, 3)


def test_damage_is_an_error(tmp_path: Path) -> None:
    work = WorkFolder.open(tmp_path, ARRAYS, FACTS)
    work.save(0, {"lengths": np.ones(2)})
    (tmp_path / "block-000000.npz").write_bytes(b"PK rubbish")
    with pytest.raises(InputError, match="delete it to solve it again"):
        work.load(0)
    WorkFolder(tmp_path).manifest_path.write_text("{}")
    with pytest.raises(InputError, match="is not a manifest"):
        WorkFolder.open(tmp_path, ARRAYS, FACTS)
    with pytest.raises(InputError, match="cannot be read"):
        _ = WorkFolder(tmp_path / "none").manifest
