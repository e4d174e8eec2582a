"""Work folders: taken up by the same work alone, whatever state a kill has left them in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnrecon.fit.blocks.store import MANIFEST, Work, require_work_folder
from gnrecon.runtime.errors import InputError, UsageError

ARRAYS = {"points": np.arange(12.0).reshape(4, 3), "cells": np.arange(3, dtype=np.uint64)}
FACTS = {"seed": 0, "length": 0.1}


def test_work_is_kept_and_taken_up(tmp_path: Path) -> None:
    work = Work.begin(tmp_path / "work", ARRAYS, FACTS)
    assert work.facts == FACTS
    assert work.array("points").tolist() == ARRAYS["points"].tolist()
    assert not work.done(7)
    work.keep(7, {"lengths": np.ones(2)})
    again = Work.begin(tmp_path / "work", ARRAYS, FACTS)
    assert again.done(7)
    assert again.solved(7)["lengths"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("arrays", "facts"),
    [
        (ARRAYS, FACTS | {"seed": 1}),
        (ARRAYS | {"points": ARRAYS["points"] + 1e-12}, FACTS),
        (ARRAYS | {"cells": np.arange(3, dtype=np.int64)}, FACTS),
    ],
)
def test_other_work_is_refused(tmp_path: Path, arrays: dict[str, np.ndarray], facts: dict[str, float]) -> None:
    Work.begin(tmp_path, ARRAYS, FACTS)
    with pytest.raises(UsageError, match="belongs to another run"):
        Work.begin(tmp_path, arrays, facts)
    assert Work(tmp_path).array("points").tolist() == ARRAYS["points"].tolist()


def test_a_folder_of_anything_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("beach")
    with pytest.raises(UsageError, match=r"is no work folder: it holds 'holiday\.jpg'"):
        Work.begin(tmp_path, ARRAYS, FACTS)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]
    with pytest.raises(UsageError, match="is no folder"):
        require_work_folder(tmp_path / "holiday.jpg")
    require_work_folder(tmp_path / "none")


def test_what_a_kill_left_half_written_is_written_anew(tmp_path: Path) -> None:
    (tmp_path / "points.npy").write_bytes(b"half")
    (tmp_path / ".cells.0123.npy").write_bytes(b"")
    work = Work.begin(tmp_path, ARRAYS, FACTS)
    assert work.array("points").shape == (4, 3)


def test_damage_is_told(tmp_path: Path) -> None:
    work = Work.begin(tmp_path, ARRAYS, FACTS)
    work.keep(0, {"lengths": np.ones(2)})
    (tmp_path / "block-000000.npz").write_bytes(b"PK rubbish")
    with pytest.raises(InputError, match="delete it to solve it again"):
        work.solved(0)
    (tmp_path / MANIFEST).write_text("{}")
    with pytest.raises(InputError, match="is not the manifest"):
        Work.begin(tmp_path, ARRAYS, FACTS)
    with pytest.raises(InputError, match="cannot be read"):
        _ = Work(tmp_path / "none").manifest
