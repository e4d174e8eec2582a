"""Guesses of a scan's unit, each with its reason."""

from __future__ import annotations

import pytest

from gnrecon.ingest import guess_units


@pytest.mark.parametrize(
    ("lower", "upper", "files", "unit", "reason"),
    [
        ((0, 0, 0), (120, 70, 90), ("part.ply",), "mm", "longest side would be 120 mm"),
        ((-0.1, 0, 0), (0.1, 0.1, 0.1), (), "m", "would be 200 mm"),
        ((431234, 5412345, 310), (431300, 5412400, 330), ("a.xyz",), "m", "projected"),
        ((0, 0, 0), (40, 70, 9), ("hall.e57", "hall2.E57"), "m", "E57 files are by definition in metres"),
        ((0, 0, 0), (40, 70, 9), ("hall.laz",), "m", "LAZ files are usually in metres"),
        ((0, 0, 0), (40, 70, 9), ("hall.ptx.gz",), "m", "PTX files are by definition in metres"),
        ((0, 0, 0), (40, 70, 9), ("hall.e57", "part.ply"), "mm", "longest side"),
        ((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2), (), None, "scaled to a unit box"),
        ((0, 0, 0), (1, 0.3, 0.2), (), None, "scaled to a unit box"),
        ((-1, -1, -0.3), (1, 0.98, 0.3), (), None, "scaled to a unit box"),
        ((0, 0, 0), (9000, 10, 10), (), None, "is unusual in mm and in m"),
        ((0, 0, 0), (1e-4, 1e-4, 1e-4), (), None, "is unusual in mm and in m"),
    ],
)
def test_guesses(
    lower: tuple[float, ...], upper: tuple[float, ...], files: tuple[str, ...], unit: str | None, reason: str
) -> None:
    guess = guess_units(lower, upper, files)
    assert guess.unit == unit
    assert reason in guess.reason
    assert set(guess.as_dict()) == {"unit", "reason"}
