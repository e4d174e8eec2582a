"""A fitted field answers in the file's frame, and survives its file bit by bit."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from gnrecon.field import Siren
from gnrecon.fit import FitOptions, NeuralSDF, fit
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Box
from gnrecon.runtime.errors import InputError, OutputError

UNIT = Frame(np.zeros(3), 1.0)
UTM = Frame(np.array([431_234.567, 5_412_345.678, 312.1]), 23.7)
BOX = Box(np.array([-1.1, -1.2, -1.3]), np.array([1.2, 1.1, 1.1]))


def random_field(widths: tuple[int, ...] = (9, 7), frame: Frame = UTM, dtype: torch.dtype = torch.float64) -> NeuralSDF:
    field = Siren(widths)
    theta = torch.randn(field.layout.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return NeuralSDF(field, theta.to(dtype), frame, BOX, FitOptions(widths=widths, seed=5).as_dict())


def points(count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, (count, 3))


def test_answers_are_the_unit_fields_mapped() -> None:
    u = points(40)
    world, unit = random_field(), random_field(frame=UNIT)
    x = UTM.to_world(u)
    # A double holds UTM coordinates to a nanometre.
    assert np.allclose(world.sdf(x), UTM.scale * unit.sdf(u), rtol=0, atol=1e-7)
    assert np.allclose(world.gradient(x), unit.gradient(u), rtol=0, atol=1e-7)
    assert np.allclose(world.normals(x), unit.normals(u), rtol=0, atol=1e-7)
    value, gradient = unit.field.value_and_gradient(unit.theta, torch.as_tensor(u))
    assert np.allclose(unit.sdf(u), value.numpy(), rtol=0, atol=1e-14)
    assert np.allclose(unit.gradient(u), gradient.numpy(), rtol=0, atol=1e-14)
    assert np.array_equal(world.bounds, UTM.to_world(np.stack([BOX.lower, BOX.upper])))


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
def test_gradient_agrees_with_finite_differences(frame: Frame) -> None:
    sdf = random_field(frame=frame)
    x = frame.to_world(points(30))
    steps = 1e-4 * frame.scale * np.eye(3)
    slopes = np.stack([(sdf.sdf(x + step) - sdf.sdf(x - step)) / (2 * 1e-4 * frame.scale) for step in steps], axis=1)
    assert np.allclose(sdf.gradient(x), slopes, rtol=0, atol=1e-4)


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
@pytest.mark.parametrize("widths", [(11,), (9, 7)], ids=str)
def test_around_centres_it_answers_what_it_does_at_each_point(widths: tuple[int, ...], frame: Frame) -> None:
    sdf = random_field(widths, frame)
    centers, offsets = frame.to_world(points(30)), 0.3 * frame.scale * points(8)
    values = sdf.sdf_around(centers, offsets)
    expected = sdf.sdf((centers[:, None] + offsets).reshape(-1, 3)).reshape(30, 8)
    assert np.allclose(values, expected, rtol=0, atol=1e-7)
    assert np.ptp(expected) > 0.1 * frame.scale


@pytest.fixture(scope="module")
def ball() -> NeuralSDF:
    """A field of 150 points of a ball of radius 0.8, in radii of a world frame."""
    directions = np.random.default_rng(0).standard_normal((150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return fit(Samples(0.8 * directions, directions, UTM), FitOptions(quality="draft"))[0]


@pytest.mark.parametrize("farther", [1.2, 1.5, 2.0, 4.0, 30.0])
def test_far_outside_a_field_is_the_distance_to_the_box_and_on_to_the_surface(ball: NeuralSDF, farther: float) -> None:
    directions = np.random.default_rng(1).standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found, true = ball.sdf(UTM.to_world(farther * directions)) / UTM.scale, farther - 0.8
    assert (found > 0.6 * true).all()
    assert (found < true + 0.8).all()
    around = ball.sdf_around(UTM.to_world(farther * directions[:5]), UTM.scale * directions[5:8])
    expected = ball.sdf((UTM.to_world(farther * directions[:5])[:, None] + UTM.scale * directions[5:8]).reshape(-1, 3))
    assert np.allclose(around.ravel(), expected, rtol=0, atol=1e-6)


def test_gradients_agree_with_differences_outside_of_the_box_and_are_one_at_least_along_the_way() -> None:
    sdf, x = random_field(frame=UNIT), 2.5 * points(200)
    beyond = BOX.nearest(x)[1]
    x = x[(beyond > 0.01) & (np.abs(sdf.sdf(BOX.nearest(x)[0])) > 0.01)]
    slopes = np.stack([(sdf.sdf(x + step) - sdf.sdf(x - step)) / 2e-5 for step in 1e-5 * np.eye(3)], axis=1)
    value, gradient = sdf.sdf_and_gradient(x)
    assert len(x) > 50
    assert np.array_equal(value, sdf.sdf(x))
    smooth = (np.abs(x - BOX.lower) > 1e-4).all(axis=1) & (np.abs(x - BOX.upper) > 1e-4).all(axis=1)
    assert np.allclose(gradient[smooth], slopes[smooth], rtol=0, atol=1e-4)
    way = x - BOX.nearest(x)[0]
    assert np.allclose((gradient * way).sum(axis=1), np.linalg.norm(way, axis=1))


def test_places_that_are_no_numbers_have_no_distance_and_those_at_infinity_an_infinite_one(ball: NeuralSDF) -> None:
    x = np.array([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], UTM.center])
    values = ball.sdf(x)
    assert np.isnan(values[0])
    assert values[1] == np.inf
    assert values[2] < 0


def test_normals_are_unit_gradients_and_finite_where_the_gradient_vanishes() -> None:
    sdf = random_field()
    x = UTM.to_world(points(30))
    gradient, normals = sdf.gradient(x), sdf.normals(x)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.allclose(normals * np.linalg.norm(gradient, axis=1, keepdims=True), gradient)
    flat = NeuralSDF(sdf.field, torch.zeros_like(sdf.theta), UTM, BOX)
    assert np.array_equal(flat.normals(x), np.zeros((30, 3)))


def test_many_points_are_answered_in_batches() -> None:
    sdf = random_field((2000,), UNIT)
    u = points(1300)
    value, gradient = sdf.field.value_and_gradient(sdf.theta, torch.as_tensor(u))
    assert np.allclose(sdf.sdf(u), value.numpy(), rtol=0, atol=1e-10)
    assert np.allclose(sdf.gradient(u), gradient.numpy(), rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_answers_are_doubles_of_the_right_shape(dtype: torch.dtype) -> None:
    sdf = random_field(dtype=dtype)
    for count in (0, 1, 5):
        x = UTM.to_world(points(count))
        answers = {(): sdf.sdf(x), (3,): sdf.gradient(x)}
        for shape, answer in answers.items():
            assert answer.shape == (count, *shape)
            assert answer.dtype == np.float64
    assert sdf.sdf([[431_234.0, 5_412_345.0, 312.0]]).shape == (1,)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("widths", [(11,), (9, 7)], ids=str)
def test_a_file_brings_back_every_bit(tmp_path: Path, widths: tuple[int, ...], dtype: torch.dtype) -> None:
    sdf = random_field(widths, dtype=dtype)
    path = tmp_path / "model.gnr"
    sdf.save(path)
    loaded = NeuralSDF.load(path)
    assert loaded.field == sdf.field
    assert loaded.theta.dtype == dtype
    assert torch.equal(loaded.theta, sdf.theta)
    assert np.array_equal(loaded.frame.center, UTM.center)
    assert loaded.frame.center.dtype == np.float64
    assert loaded.frame.scale == UTM.scale
    assert np.array_equal(loaded.box.lower, BOX.lower)
    assert np.array_equal(loaded.box.upper, BOX.upper)
    # A file knows lists, not tuples.
    assert json.dumps(loaded.options) == json.dumps(sdf.options)
    x = UTM.to_world(points(20))
    assert np.array_equal(loaded.sdf(x), sdf.sdf(x))
    assert np.array_equal(loaded.gradient(x), sdf.gradient(x))
    again = tmp_path / "again.gnr"
    loaded.save(again)
    assert NeuralSDF.load(again).options == loaded.options


def with_support(count: int = 30) -> NeuralSDF:
    return replace(random_field(), support=points(count).astype(np.float32))


def test_the_data_stays_with_the_field(tmp_path: Path) -> None:
    sdf = with_support()
    sdf.save(tmp_path / "model.gnr")
    loaded = NeuralSDF.load(tmp_path / "model.gnr")
    assert loaded.support.dtype == np.float32
    assert np.array_equal(loaded.support, sdf.support)
    assert np.abs(loaded.data - UTM.to_world(points(30))).max() < 1e-7 * UTM.scale
    assert np.array_equal(loaded.single().data, loaded.data)


def test_files_of_earlier_versions_hold_no_data(tmp_path: Path) -> None:
    random_field().save(tmp_path / "model.gnr")
    loaded = NeuralSDF.load(tmp_path / "model.gnr")
    assert loaded.support is None
    assert loaded.data is None


def test_a_fit_keeps_at_most_20000_points_of_its_own() -> None:
    directions = np.random.default_rng(3).normal(size=(20_500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    samples = Samples(directions, directions, UNIT)
    sdf, _ = fit(samples, FitOptions(widths=(20,), steps=0))
    assert len(sdf.support) == 20_000
    order = {tuple(row): number for number, row in enumerate(directions.astype(np.float32).tolist())}
    rows = [order[tuple(row)] for row in sdf.support.tolist()]
    assert rows == sorted(set(rows))


@pytest.mark.parametrize(
    ("name", "values", "sentence"),
    [
        ("theta", float("nan"), "'theta' that are not finite"),
        ("support", float("inf"), "'support' that are not finite"),
        ("frame.scale", 0.0, "without extent"),
        ("box", 0.5, "without extent"),
        ("theta", 1e32, "no distances"),
        ("frame.scale", 1e-300, "out of range"),
        ("frame.center", 1e200, "out of range"),
    ],
)
def test_numbers_that_no_fit_makes(tmp_path: Path, name: str, values: float, sentence: str) -> None:
    path = tmp_path / "model.gnr"
    with_support().save(path)
    with safe_open(path, framework="pt") as file:
        tensors, metadata = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118
    tensors[name] = torch.full_like(tensors[name], values)
    save_file(tensors, path, metadata)
    with pytest.raises(InputError, match=sentence):
        NeuralSDF.load(path)
    for wrong in (torch.zeros(4), torch.zeros(2, 3, 4)):
        save_file({**tensors, name: wrong}, path, metadata)
        with pytest.raises(InputError, match=r"shape|parameters|numbers|extent"):
            NeuralSDF.load(path)


def test_the_same_field_makes_the_same_file(tmp_path: Path) -> None:
    # More than two files, because two may agree by luck.
    for copy in range(12):
        random_field().save(str(tmp_path / f"{copy}.gnr"))
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_saving_overwrites_only_when_told(tmp_path: Path) -> None:
    path = tmp_path / "model.gnr"
    path.write_bytes(b"somebody's work")
    with pytest.raises(OutputError, match="exists"):
        random_field().save(path)
    assert path.read_bytes() == b"somebody's work"
    random_field().save(path, overwrite=True)
    assert NeuralSDF.load(path).theta.shape == random_field().theta.shape
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.gnr"], "nothing temporary is left"
    with pytest.raises(OutputError, match="folder"):
        random_field().save(tmp_path / "missing" / "model.gnr")


def test_the_users_umask_decides_who_may_read_a_model(tmp_path: Path) -> None:
    path, plain = tmp_path / "model.gnr", tmp_path / "plain"
    old = os.umask(0o027)
    try:
        random_field().save(path)
        plain.touch()
    finally:
        os.umask(old)
    assert path.stat().st_mode == plain.stat().st_mode


def test_files_that_are_no_models(tmp_path: Path) -> None:
    random_field().save(tmp_path / "model.gnr")
    whole = (tmp_path / "model.gnr").read_bytes()
    contents = {
        "empty": b"",
        "garbage": bytes(range(256)) * 8,
        "text": b"ply\nformat ascii 1.0\nend_header\n",
        "cut off": whole[: len(whole) // 2],
        "cut off in the header": whole[:20],
    }
    for name, content in contents.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=name):
            NeuralSDF.load(path)
    theta = {"theta": torch.zeros(3)}
    for name, metadata in (("foreign", None), ("tagged", {"format": "pt"}), ("future", {"format": "gnrecon-sdf-99"})):
        save_file(theta, tmp_path / name, metadata)
        with pytest.raises(InputError, match=name):
            NeuralSDF.load(tmp_path / name)
    for path in (tmp_path / "nothing.gnr", tmp_path):
        with pytest.raises(InputError, match="no file"):
            NeuralSDF.load(path)


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
def test_second_derivatives_agree_with_differences_of_gradients(frame: Frame) -> None:
    sdf = random_field(frame=frame)
    x = frame.to_world(points(30))
    steps = 1e-4 * frame.scale * np.eye(3)
    bends = np.stack([(sdf.gradient(x + s) - sdf.gradient(x - s)) / (2e-4 * frame.scale) for s in steps], axis=2)
    assert np.allclose(sdf.hessian(x) * frame.scale, bends * frame.scale, rtol=0, atol=2e-3)
