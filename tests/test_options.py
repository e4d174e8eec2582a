"""Options are checked at the door, and the command line offers all of them with the same defaults."""

from __future__ import annotations

import inspect
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnrecon.cli.batch_command import batch_command
from gnrecon.cli.reconstruct_command import reconstruct_command
from gnrecon.config import typed
from gnrecon.export import RefineOptions
from gnrecon.fit import FitOptions
from gnrecon.ingest import prepare
from gnrecon.io.io_parameters import IOParameters
from gnrecon.option_table import option_rows
from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"resolution": 15}, "resolution must be at least 16 cells, not 15"),
        ({"threads": 0}, "threads must be positive, not 0"),
        ({"seed": -1}, "seed must not be negative, not -1"),
        ({"steps": -1}, "steps must not be negative, not -1"),
        ({"widths": ()}, "widths must be positive numbers"),
        ({"widths": (300, 0)}, r"widths must be positive numbers, not \(300, 0\)"),
        ({"normal_residual": "cross"}, "one of vector, projection, cosine, not 'cross'"),
        ({"search": "golden"}, "one of auto, damping, geodesic, line, not 'golden'"),
        ({"solver": "gauss"}, "solver must be one of auto, cholesky, qr, .*, not 'gauss'"),
        ({"optimiser": "sgd"}, "optimiser must be one of gn, adam, lbfgs, not 'sgd'"),
        ({"trim": "3m"}, "'3m' needs the file's own unit"),
        ({"trim": 1, "open": False}, "Give only one of --trim and --no-open"),
        ({"trim": 0}, "'0' is not a positive distance such as 2.5, 2mm or 3s .spacings."),
        ({"trim": "-1s"}, "unknown unit"),
        ({"trim": float("inf")}, "is not a length"),
        ({"trim": "1e999"}, "is not a length"),
        ({"trim": "1s", "units": "parsec"}, "scan's unit must be one of um, mm, .* not 'parsec'"),
        ({"read_points": 0}, "while reading must be positive, not 0"),
        ({"remesh": -2.0}, "edge length to remesh to must be positive, not -2"),
        ({"adaptive": True}, "add --remesh"),
        ({"simplify": 0.0}, "tolerance to simplify to must be positive, not 0"),
        ({"faces": 2}, "number of faces must be at least 4, not 2"),
        ({"feature_angle": 120.0}, "feature angle must be from 5 to 90 degrees, not 120"),
        ({"smooth": "strain"}, "option smooth takes strain=WEIGHT, such as strain=1e-4, not 'strain'"),
        ({"smooth": "strain=-1"}, "weight of smooth must be a positive number, as in strain=1e-4, not '-1'"),
        ({"smooth": "strain=much"}, "weight of smooth must be a positive number, as in strain=1e-4, not 'much'"),
        ({"fill": "maximal"}, "option fill takes minimal=WEIGHT or minimal alone, .* not 'maximal'"),
        ({"prior": "developable=inf"}, "weight of prior must be a positive number, .* not 'inf'"),
        ({"fill": "minimal", "widths": (100,)}, "smooth, fill and prior are for the default fit"),
        ({"resolution": "a"}, "resolution must be a whole number, not 'a'"),
        ({"resolution": 96.5}, "resolution must be a whole number, not 96.5"),
        ({"seed": None}, "seed must be a whole number, not None"),
        ({"threads": True}, "threads must be a whole number, not True"),
        ({"adaptive": 1}, "adaptive must be true or false, not 1"),
        ({"trim": [2]}, r"trim must be a number or text, not \[2\]"),
        ({"widths": 300}, "widths must be a list of whole numbers such as 2000 or 32,32,32, not 300"),
        ({"widths": (1.5,)}, "widths must be a list of whole numbers .*, not .1.5,"),
        ({"crop": 5}, "crop must be a list of texts, not 5"),
        ({"holdout": np.zeros(99)}, "holdout must be a number or text, not a value of type ndarray"),
        ({"quality": 3}, "quality must be text, not 3"),
        ({"detail": 3}, "no option 'detail'; the options are read_points, columns, crop, clip_plane, units, fraction"),
    ],
)
def test_values_out_of_range_and_unknown_names(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence) as caught:
        Options.of(**values)
    assert "\n" not in str(caught.value)


def test_the_least_values_are_allowed() -> None:
    options = Options.of(resolution=16, threads=1, seed=0, steps=0, widths=(1,))
    assert options.fit().steps_for(10_000) == 0
    assert options.fit().widths_for(10_000) == (1,)


def test_the_fit_receives_its_options() -> None:
    options = Options(
        widths=(7, 5),
        steps=3,
        quality="high",
        normal_residual="cosine",
        optimiser="adam",
        solver="qr",
        search="line",
        seed=11,
    )
    assert options.fit() == FitOptions((7, 5), 3, "high", "cosine", "adam", "qr", "line", 11, "cpu")
    assert Options().fit() == FitOptions()


def test_ingest_receives_its_options() -> None:
    chosen = {"outliers": "off", "fraction": 0.5, "max_points": 100, "subsample": "voxel", "seed": 4}
    chosen |= {"spacing": "2s", "holdout": 0.1, "units": "mm", "clusters": "on", "smooth_scan": "8s", "orient": "signs"}
    assert Options(**chosen).ingest() == chosen
    parameters = inspect.signature(prepare).parameters
    for name, value in Options().ingest().items():
        assert parameters[name].default == value, name


def test_meshes_are_open_on_demand_or_where_the_scan_is_a_sheet() -> None:
    assert Options().trim_at(spacing=0.2) is None
    assert Options().trim_at(spacing=0.2, sheet=True) == pytest.approx(0.4)
    assert Options(open=True).trim_at(spacing=0.2) == pytest.approx(0.4)
    assert Options(open=True, trim=3).trim_at(spacing=0.2) == 3
    assert Options(open=False).trim_at(spacing=0.2, sheet=True) is None


def test_trimming_is_in_file_units_or_spacings() -> None:
    reaches = {None: None, 2.5: 2.5, "2.5": 2.5, "3s": 0.6, " .5 S ": 0.1, 4: 4, "1e-1": 0.1}
    for given, expected in reaches.items():
        assert Options(trim=given).trim_at(spacing=0.2) == pytest.approx(expected)
    assert Options(trim="2mm", units="m").trim_at(spacing=0.2) == pytest.approx(0.002)


def test_the_refinement_receives_its_options() -> None:
    chosen = {"remesh": 2.0, "adaptive": True, "simplify": 0.1, "faces": 500, "feature_angle": 20.0}
    assert Options(**chosen).mesh().refine == RefineOptions(**chosen)
    assert Options().mesh().refine == RefineOptions()
    assert not Options().mesh().refine.anything


def test_options_are_plain_values() -> None:
    values = Options(widths=(7, 5)).as_dict()
    assert set(values) == {option.name for option in fields(Options)}
    assert json.loads(json.dumps(values))["widths"] == [7, 5]


@pytest.mark.parametrize("command", [reconstruct_command, batch_command])
def test_the_command_line_has_every_option_with_the_same_default(command: Any) -> None:
    parameters = inspect.signature(command).parameters
    for option in fields(Options):
        if option.name in ("work_dir", "block_scheduler") and command is batch_command:
            assert option.name not in parameters
            continue  # a folder for the work of one scan, and the cluster that shares it
        assert parameters[option.name].default == option.default, option.name


def test_defaults_of_the_table_are_those_of_the_stages() -> None:
    assert Options().read_points == IOParameters.most_points
    assert Options().feature_angle == RefineOptions.feature_angle
    fit = FitOptions()
    assert (Options().normal_residual, Options().quality, Options().seed) == (fit.normals, fit.quality, fit.seed)


def test_the_docstring_has_every_option() -> None:
    assert Options.__doc__ is not None
    for row in option_rows().values():
        assert f"{row.name} : " in Options.__doc__
        assert row.help in Options.__doc__


@pytest.mark.parametrize(
    ("value", "texts"),
    [
        ("0,0,0,1,1,1", ("0,0,0,1,1,1",)),
        ([0, 0, 0, 1, 1, 1.5], ("0.0,0.0,0.0,1.0,1.0,1.5",)),
        (np.arange(6), ("0,1,2,3,4,5",)),
        ([[0, 0, 0, 1, 1, 1], [2, 2, 2, 3, 3, 3]], ("0,0,0,1,1,1", "2,2,2,3,3,3")),
        (["0,0,0,1,1,1", "2,2,2,3,3,3"], ("0,0,0,1,1,1", "2,2,2,3,3,3")),
        ((), ()),
    ],
)
def test_boxes_may_be_numbers(value: Any, texts: tuple[str, ...]) -> None:
    options = Options.of(crop=value)
    assert options.crop == texts
    assert len(options.region().boxes) == len(texts)


def test_what_is_no_box_is_refused() -> None:
    assert Options.of(clip_plane=[0, 0, 1, -2.5]).clip_plane == ("0.0,0.0,1.0,-2.5",)
    wrong: list[tuple[Any, str]] = [
        ([0, 1, 2], "'0,1,2' is not a box: six numbers"),
        ([[0, 0, 0, 1, 1, 1], [2, 2]], "crop must be a list of texts"),
        ([True] * 6, "crop must be a list of texts"),
    ]
    for value, sentence in wrong:
        with pytest.raises(UsageError, match=sentence):
            Options.of(crop=value)


def test_widths_are_read_from_text() -> None:
    assert typed("widths", "2000") == (2000,)
    assert typed("widths", "32,32,32") == (32, 32, 32)


def test_numbers_of_numpy_and_paths_become_plain_values(tmp_path: Path) -> None:
    made = Options.of(
        resolution=np.int64(96), holdout=np.float32(0.5), keep_handles=np.True_, widths=np.array([3, 4]), trim=2
    )
    plain = (made.resolution, made.holdout, made.keep_handles, made.widths, made.trim)
    assert plain == (96, 0.5, True, (3, 4), 2)
    assert [type(value) for value in plain] == [int, float, bool, tuple, int]
    assert Options.of(work_dir=tmp_path).work_dir == str(tmp_path)


def test_options_of_a_fit_have_types_too() -> None:
    with pytest.raises(UsageError, match="widths must be a list of whole numbers such as 2000 or 32,32,32, not 'a'"):
        FitOptions(widths="a")  # type: ignore[arg-type]
    assert FitOptions(widths=[3, 4]).widths == (3, 4)  # type: ignore[arg-type]
