"""Parameters of the report: frozen, used, and the defaults of what takes them."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from parameter_checks import assert_frozen, read_attributes

import gnrecon.report
from gnrecon.geometry.statistics import Histogram
from gnrecon.options import Options
from gnrecon.report.estimate import estimate
from gnrecon.report.html.charts import Curve, bars, curves
from gnrecon.report.report_parameters import ChartLayout, CostModel


@pytest.mark.parametrize("parameters", [ChartLayout(), CostModel()])
def test_parameters_are_frozen_and_used(parameters: Any) -> None:
    used = read_attributes(gnrecon.report, "report_parameters.py")
    for one in fields(parameters):
        assert one.name in used, one.name
    assert_frozen(parameters)


@pytest.mark.parametrize(
    "name", ["start_seconds", "fit_seconds", "mesh_seconds", "two_core_share", "fit_point_seconds"]
)
def test_the_cost_model_makes_the_estimate(name: str) -> None:
    box, options, model = np.array([[0.0, 0, 0], [1, 1, 1]]), Options(resolution=200), CostModel()
    usual = estimate(2000, 2000, box, options)
    assert usual is not None
    assert usual == estimate(2000, 2000, box, options, model=model)
    doubled = estimate(2000, 2000, box, options, model=replace(model, **{name: 2 * getattr(model, name)}))
    assert doubled is not None
    assert doubled.seconds > usual.seconds


def test_the_layout_makes_the_charts() -> None:
    histogram = Histogram.of(np.array([1.0, 2.0, 3.0]), 0.0, 4.0, 4)
    assert bars(histogram, "x") == bars(histogram, "x", layout=ChartLayout())
    assert 'viewBox="0 0 440 210"' in bars(histogram, "x")
    assert 'viewBox="0 0 300 140"' in bars(histogram, "x", layout=ChartLayout(width=300, height=140))
    line = Curve("loss", "first", [0, 1], [1.0, 0.1])
    assert curves([line], "step") == curves([line], "step", layout=ChartLayout(left=52))
