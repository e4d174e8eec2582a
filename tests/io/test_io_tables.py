"""Tables in text as programs write them, and normals stored as integers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnrecon.io import parse_columns, read_cloud, read_scans
from gnrecon.io.contents import decoded_normals
from gnrecon.runtime.errors import InputError, UsageError

POINTS = np.random.default_rng(0).normal(size=(20, 3)).round(4)


def lines(separator: str = ",", decimal: str = ".", before: str = "", after: str = "") -> str:
    cells = [[f"{value:.4f}".replace(".", decimal) for value in row] for row in POINTS]
    return "".join(before + separator.join(row) + after + "\n" for row in cells)


@pytest.mark.parametrize(
    "text",
    [
        lines("\t", ","),
        lines(" ", ","),
        lines(";", ","),
        "x [mm],y [mm],z [mm]\n" + lines(),
        "Easting,Northing,Height\n" + lines(),
        "Points:0,Points:1,Points:2\n" + lines(),
        "Scanner: ACME 3000\nUnit: mm\nX,Y,Z\n" + lines(),
        "x,y,z,class\n" + lines(after=",ground"),
        "x,y,z,i\n" + lines(after=","),
        lines().replace(",", '","').replace("\n", '"\n"').join(['"', ""])[:-1],
        lines(" ").replace(" ", "D+00 "),
        "//X Y Z Scalar field\n" + lines(" ", after=" 7"),
        lines().replace(",", "','").replace("\n", "'\n'").join(["'", ""])[:-1],
        lines(", ", before="(", after=")"),
        lines(" ") + "\x1a",
        "x,y,z\n" + lines(after=","),
        lines(before="[", after="],")[:-2],
        "x y z\n" + "".join(f"{number} {line}\n" for number, line in enumerate(lines(" ").splitlines(), 1)),
        lines().replace("-", "\u2212"),
        "Bounding box: -3.0 -3.0 -3.0 3.0 3.0 3.0\n" + lines(" "),
        'VARIABLES = "X", "Y", "Z"\nZONE I=20, F=POINT\n' + lines(" "),
        "Este;Norte;Cota\n" + lines(";", ","),
        "X_UTM,Y_UTM,Z_UTM\n" + lines(),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_dialects(tmp_path: Path, text: str, encoding: str) -> None:
    (tmp_path / "a.txt").write_bytes(text.encode(encoding))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.txt").points, POINTS)


def test_what_is_guessed_is_said_and_columns_decide(tmp_path: Path) -> None:
    rows = [f"{number},{line}" for number, line in enumerate(lines().splitlines(), 1)]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    cloud, reading = read_scans([tmp_path / "a.csv"])
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert "column 1 is taken for a running number" in reading.remarks()[0]
    cloud, reading = read_scans([tmp_path / "a.csv"], columns=parse_columns("-,z,y,x"))
    np.testing.assert_array_equal(cloud.points, POINTS[:, ::-1])
    assert reading.remarks() == []
    with pytest.raises(UsageError, match="x, y and z"):
        parse_columns("x,y,-")


def test_groups_of_digits_are_no_numbers_of_their_own(tmp_path: Path) -> None:
    points = POINTS + np.array([452000.0, 5411000, 1000])
    for mark in ("\xa0", "\u202f", "."):
        rows = [
            ";".join(f"{x:,.4f}".replace(".", "p").replace(",", mark).replace("p", ",") for x in row) for row in points
        ]
        (tmp_path / "a.csv").write_text("x;y;z\n" + "\n".join(rows), encoding="utf-8")
        np.testing.assert_allclose(read_cloud(tmp_path / "a.csv").points, points, atol=1e-4)


def test_columns_of_other_kinds_before_the_position(tmp_path: Path) -> None:
    normals = np.round(POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True), 4)
    for what, first in (("normals", normals), ("a running number", 10 * np.arange(1, 21)), ("", None)):
        rows = np.column_stack([POINTS, 3 * POINTS] if first is None else [first, POINTS])
        np.savetxt(tmp_path / "a.txt", rows, "%.4f")
        cloud, reading = read_scans([tmp_path / "a.txt"])
        np.testing.assert_array_equal(cloud.points, POINTS)
        said = f"taken for {what}" if what else "values without a name are in column 4, 5, 6"
        assert said in reading.remarks()[0]
    assert set(cloud.attributes) == {"column_4", "column_5", "column_6"}
    np.savetxt(tmp_path / "a.xyzn", np.hstack([POINTS, 0 * POINTS]))
    normals = read_cloud(tmp_path / "a.xyzn").normals
    assert normals is not None
    assert not normals.any()
    (tmp_path / "a.xyzn").rename(tmp_path / "a.xyz")
    assert "colors" not in read_cloud(tmp_path / "a.xyz").attributes  # black would be


def test_arrays_of_numpy(tmp_path: Path) -> None:
    records = np.zeros(20, [("xyz", "f8", 3), ("rgb", "u1", 3)])
    records["xyz"], records["rgb"] = POINTS, 7
    np.save(tmp_path / "a.npy", records)
    np.savez(tmp_path / "a.npz", pos=POINTS, norm=POINTS, rgb=records["rgb"], label="cup")
    for name in ("a.npy", "a.npz"):
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.points, POINTS)
        np.testing.assert_array_equal(cloud.attributes["colors"], records["rgb"])
    assert cloud.normals is not None
    np.savez(tmp_path / "b.npz", a=POINTS, b=POINTS)
    with pytest.raises(InputError, match="the arrays a, b, but none named points"):
        read_cloud(tmp_path / "b.npz")


def test_a_time_before_the_position_is_no_coordinate(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(400, 3))
    points = np.round(vectors / np.linalg.norm(vectors, axis=1, keepdims=True) * [30, 20, 10] + [100, 50, 5], 4)
    sweep = np.linspace(0, 2, 400)
    strip = np.column_stack([512000 + 30 * sweep, 60 * np.sin(40 * sweep), 100 + np.sin(4 * sweep)])
    time = np.cumsum(rng.uniform(0, 1, 400))
    shade = rng.integers(0, 256, 400)
    in_order = points[np.argsort(points[:, 0])]
    profiles = np.column_stack([np.repeat(np.arange(20), 20), points[:, 1:] - points[:, 1:].mean(axis=0)])
    for name, columns, formats, place in (
        ("time", [time, points], "%.4f", 1),
        ("time", [time, points, shade], "%.4f", 1),
        ("time", [1.7e9 + sweep, strip], "%.3f", 1),
        ("time", [sweep + 0.123456, strip], ["%.6f"] + 3 * ["%.3f"], 1),
        ("intensity", [shade, points], ["%d"] + 3 * ["%.4f"], 1),
        # Sorted along x, with a time last, in profiles along x, in a volume: x comes first.
        ("x, y, z", [in_order, shade], "%.4f", 0),
        ("x, y, z", [in_order, rng.uniform(0, 1, 400)], ["%.4f"] * 3 + ["%.6f"], 0),
        ("intensity", [points, time], "%.4f", 0),
        ("x, y, z", [profiles, rng.uniform(0, 1, 400)], ["%.1f"] + 3 * ["%.4f"], 0),
        ("intensity", [rng.uniform(0, 1, (400, 3)), shade % 3], "%.4f", 0),
        ("row", [np.arange(400) // 20, np.arange(400) % 20, points, shade], ["%d"] * 2 + ["%.4f"] * 4, 2),
    ):
        rows = np.column_stack(columns)
        np.savetxt(tmp_path / "a.txt", rows, formats)
        cloud, reading = read_scans([tmp_path / "a.txt"])
        np.testing.assert_allclose(cloud.points, rows[:, place : place + 3], atol=1e-3)
        assert f"taken for {name}" in reading.remarks()[0]
        assert (name == "time") == ("time" in cloud.attributes)


def test_of_four_columns_the_one_beyond_a_byte_is_the_intensity(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colors, intensity = rng.integers(0, 256, (20, 3)), rng.integers(0, 4096, (20, 1))
    for rest in ([intensity, colors], [colors, intensity]):
        for suffix in ("txt", "pts"):
            np.savetxt(tmp_path / f"a.{suffix}", np.hstack([POINTS, *rest]), "%.4f")
            found = read_cloud(tmp_path / f"a.{suffix}").attributes
            np.testing.assert_array_equal(found["colors"], colors)
            np.testing.assert_array_equal(found["intensity"], intensity[:, 0])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("lat,lon,h\n" + lines(), "angles"),
        ("x [m],y [m],z [mm]\n" + lines(), "differ in their units"),
        ("NCOLS 4\nNROWS 1\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 4\n", "grid of heights"),
        ("DSAA\n4 1\n0 3\n0 0\n1 4\n1 2 3 4\n", "grid of heights"),
        ("x,y,z,time\n" + lines(), "Name those to read with --columns"),
        ("Breite;Länge;Höhe\n" + lines(";"), "angles"),
        ("1,01,2,02,3,03\n4,05,5,06,6,07\n", "mark decimals as well"),
    ],
)
def test_what_cannot_be_read_rightly_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize(("kind", "top"), [("u1", 255), ("u2", 65535), ("i1", 127), ("i2", 32767)])
def test_normals_of_integers_are_decoded(kind: str, top: int) -> None:
    normals = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    shares = normals * top if kind[0] == "i" else (normals + 1) / 2 * top
    found, unread = decoded_normals(np.rint(shares).astype(kind))
    assert found is not None
    assert not unread
    np.testing.assert_allclose(found, normals, atol=1.5 / 127)
