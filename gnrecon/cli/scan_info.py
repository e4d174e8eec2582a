"""``gnrecon info SCAN``: what a scan holds, what could trouble a fit, and what a run would do by default."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gnrecon.fit import bounds_of
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import Layers, layers_of, prepare, sheet_thickness, survey
from gnrecon.ingest.ingest_parameters import SurveyParameters
from gnrecon.io import Reading
from gnrecon.options import Options
from gnrecon.pipeline import read_source
from gnrecon.report.estimate import estimate
from gnrecon.report.run_report import scan_facts
from gnrecon.runtime.errors import ExitCode, InputError


def info(scans: Sequence[Path], options: dict[str, Any], format: str | None = None, *, as_json: bool = False) -> int:
    """Print the facts of a scan and what a run with these options would do, and return the exit code 0.

    Raises
    ------
    UsageError
        When an option is out of its range.
    InputError
        When the scan cannot be read, or no surface can be fitted to it.
    """
    chosen = Options.of(**options)
    cloud, reading = read_source(list(scans), None, format, chosen.read_points, chosen.region(), chosen.column_names())
    plan, layers = _plan(cloud, reading, chosen)
    facts = scan_facts(survey(cloud), layers, reading)
    if facts is None:
        raise InputError("The scan holds fewer than 25 finite and distinct points, too few to describe it.")
    if as_json:
        attributes = {name: list(values.shape[1:]) for name, values in cloud.attributes.items()}
        print(json.dumps({"reading": reading.as_dict(), **facts, "attributes": attributes, "plan": plan}, indent=2))
    else:
        print("\n".join([*_describe(facts, cloud, chosen.units), *_sentences(plan, layers)]))
    return ExitCode.OK


def _plan(cloud: PointCloud, reading: Reading, options: Options) -> tuple[dict[str, Any], Layers | None]:
    """What a run would do, as plain values, and the layers that it would find."""
    samples, counts = prepare(cloud, **options.ingest())
    fit, bounds = options.fit(), bounds_of(samples)
    points = samples.frame.to_world(samples.points)
    noise = (samples.noise or 0.0) * samples.frame.scale
    options = options.for_scan(points, bounds, sheet_thickness(points, samples.normals, noise))
    expected = estimate(reading.points, len(samples), bounds, options)
    plan = {
        "points": len(samples),
        "widths": None if fit.adaptive else list(fit.widths_for(len(samples))),
        "steps": fit.steps_for(len(samples)),
        "detail_features": fit.features if fit.adaptive else None,
        "remarks": [*reading.remarks(), *counts.remarks()],
        "seconds": None if expected is None else expected.seconds,
        "memory_mb": None if expected is None else expected.memory_mb,
        "estimate": "No estimate of time and memory: no such run was measured."
        if expected is None
        else expected.describe(),
    }
    return plan, layers_of(samples, counts.normals)


def _describe(facts: Mapping[str, Any], cloud: PointCloud, units: str | None) -> list[str]:
    size = " x ".join(f"{high - low:.6g}" for low, high in zip(facts["lower"], facts["upper"], strict=True))
    counts = {
        "not finite": facts["non_finite"],
        "duplicates": facts["duplicates"],
        "copies": facts["repeated"],
        "in isolated clusters": facts["clusters"],
    }
    thick = f"{facts['spacing_p5']:.4g} to {facts['spacing_p95']:.4g} for 90 %"
    lines = {
        "points": ", ".join([f"{facts['points']:,}", *(f"{count:,} {what}" for what, count in counts.items())]),
        "size": f"{size} file units",
        "unit": _unit(facts, units),
        "spacing": f"{facts['spacing']:.4g} in the median, {thick}",
        "density": f"varies by a factor of {facts['density_variation']:.3g}",
        "noise": _noise(facts),
        "normals": _normals(facts["normals"]),
        "outliers": f"{facts['outliers']} of up to 10,000 points",
        "surface": _surface(facts),
        "layers": "one" if facts["layers"] is None else f"two, about {facts['layers']['offset']:.3g} apart",
        "attributes": ", ".join(cloud.attributes) or "none",
        "scanner": f"{facts['origins']} known positions" if facts["origins"] else "positions not known",
    }
    return [f"{name + ':':12} {text}" for name, text in lines.items()]


def _normals(quality: str) -> str:
    return {
        "missing": "missing; they will be estimated",
        "zero": "zero for most points; they will be estimated",
        "unnormalised": "good, but not of length one",
        "inconsistent": "inconsistent: neighbours often face opposite ways",
        "inward": "consistent, but inward; they will be flipped",
        "good": "good",
    }[quality]


def _unit(facts: Mapping[str, Any], units: str | None) -> str:
    if units is not None:
        return f"{units}, as given"
    if facts["units_guess"] is None:
        return f"unknown: {facts['units_reason']}"
    return f"perhaps {facts['units_guess']}, a guess: {facts['units_reason']}"


def _surface(facts: Mapping[str, Any]) -> str:
    if facts["noise"] is None and facts["points"] < SurveyParameters.border_points:
        return "too few points to find borders"
    if not facts["open"]:
        return "closed"
    return f"open, or with holes: {facts['border_share']:.1%} of the points lie at a border"


def _noise(facts: Mapping[str, Any]) -> str:
    """The noise along the normal, or its upper limit where it cannot be separated from the surface's curvature."""
    if facts["noise"] is None:
        return f"not separable from the curvature of the surface, at most {facts['noise_limit']:.3g}"
    if facts["noise"] == 0:
        return f"none beyond the curvature of the surface, at most {facts['noise_limit']:.2g}"
    return f"{facts['noise']:.3g} along the normal, {facts['noise'] / facts['spacing']:.2g} of the spacing"


def _sentences(plan: Mapping[str, Any], layers: Layers | None) -> list[str]:
    if plan["widths"] is None:
        network = f"a smooth global field and local detail of {plan['detail_features']:,} sines per cube"
    else:
        network = f"layers of {', '.join(map(str, plan['widths']))} sines, in {plan['steps']} steps"
    sentence = f"A run would fit {plan['points']:,} points with {network}."
    return [*plan["remarks"], *([] if layers is None else [layers.describe()]), sentence, plan["estimate"]]
