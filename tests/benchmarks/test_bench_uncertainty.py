"""The benchmark of sigma: its scans lie on the shapes, have holes, and a small run fills every figure."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.uncertainty import CASES, COLUMNS, Case, ColorScale, draw, errors, main
from PIL import Image

from gnrecon.geometry.point_cloud import Frame

SMALL = Case("knot", 250, 0.0, 2, 0.3)


def test_scans_without_noise_lie_on_the_shape_and_repeat() -> None:
    scan = draw(SMALL, seed=3)
    assert len(scan) == 250
    assert errors(SMALL, scan.points).max() < 1e-3
    assert np.allclose(np.linalg.norm(scan.normals, axis=1), 1)
    assert np.array_equal(scan.points, draw(SMALL, seed=3).points)
    assert not np.array_equal(scan.points, draw(SMALL, seed=4).points)


def test_noise_is_as_large_as_asked_for() -> None:
    noisy = draw(replace(SMALL, holes=0, noise=0.01), seed=3)
    # Of three coordinates, the one along the normal is seen.
    seen = np.sqrt(np.mean(errors(SMALL, noisy.points) ** 2)) / Frame.of(noisy.points).scale
    assert seen == pytest.approx(0.01, rel=0.2)


def test_holes_are_empty() -> None:
    whole, holed = (draw(case, seed=3) for case in (replace(SMALL, points=2000, holes=0), replace(SMALL, points=1000)))
    radius = Frame.of(whole.points).scale
    away = np.linalg.norm(whole.points[:, None] - holed.points, axis=2).min(axis=1)
    assert away.max() > 0.2 * radius
    assert np.median(away) < 0.05 * radius


def test_errors_are_distances_along_the_normal() -> None:
    scan = draw(SMALL, seed=0)
    shifted = scan.points + 0.4 * scan.normals
    # Normals carry noise, by which the shift is a little shorter.
    assert np.median(errors(SMALL, shifted)) == pytest.approx(0.4, rel=0.03)


def test_colours_run_from_dark_to_bright_and_stop_at_the_ends() -> None:
    scale = ColorScale()
    low, high = scale.lowest, scale.highest
    shown = scale.colors(np.array([0.0, low, np.sqrt(low * high), high, 1.0])).astype(int).sum(axis=1)
    assert shown[0] == shown[1] < shown[2] < shown[3] == shown[4]


def test_a_small_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures, picture = tmp_path / "figures.json", tmp_path / "sigma.png"
    options = {"resolution": 40, "widths": (700,), "steps": 0}
    words = ["--json", str(figures), "--picture", str(picture), "--pictured", "small"]
    assert main(words, {"small": replace(SMALL, points=500)}, options) == 0
    report = json.loads(figures.read_text(encoding="utf-8"))
    assert report["command"].startswith("./scripts/bench uncertainty --json")
    (trial,) = report["trials"]
    assert trial["points"] == 500
    assert 0.7 <= trial["within"] <= 1
    assert trial["rank"] > 0.2
    assert 0 < trial["far"] < 1
    assert trial["within"] == pytest.approx(
        trial["far"] * trial["within_far"] + (1 - trial["far"]) * trial["within_near"]
    )
    shown = capsys.readouterr().out
    for column in COLUMNS:
        if column.key in ("rank", "median_sigma"):
            assert column.cell(trial) in shown
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    first, *coloured = np.split(pixels[40:430], 3, axis=1)
    saturation = [np.ptp(panel, axis=2).max(axis=None) for panel in coloured]
    assert min(saturation) > 80
    assert (first.sum(axis=2) < 600).mean() > 0.01


def test_a_picture_without_a_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    from benchmarks.__main__ import main as bench

    assert bench(["uncertainty", "--picture", str(tmp_path / "nowhere" / "a.png")]) == 6
    assert set(CASES) >= {"bracket, holed"}
