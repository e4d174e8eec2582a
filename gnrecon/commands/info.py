"""``gnrecon info SCAN``: what is in a scan and what would trouble a fit; and what a run would do, without doing it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gnrecon.cloud import PointCloud
from gnrecon.errors import ExitCode, InputError
from gnrecon.ingest import prepare
from gnrecon.ingest.survey import Survey, survey
from gnrecon.io import Reading
from gnrecon.options import Options
from gnrecon.pipeline import read_source


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
    cloud, reading = read_source(list(scans), None, format, chosen.read_points, chosen.region())
    facts = survey(cloud)
    if facts is None:
        raise InputError("The scan holds fewer than 25 finite and distinct points, so that nothing can be told of it.")
    plan = _plan(cloud, reading, chosen)
    if as_json:
        attributes = {name: list(values.shape[1:]) for name, values in cloud.attributes.items()}
        found = {"reading": reading.as_dict(), **facts.as_dict(), "attributes": attributes, "plan": plan}
        print(json.dumps(found, indent=2))
    else:
        print("\n".join([*_describe(facts, cloud), *_sentences(plan)]))
    return ExitCode.OK


def _plan(cloud: PointCloud, reading: Reading, options: Options) -> dict[str, Any]:
    """What a run would do, as plain values."""
    samples, counts = prepare(cloud, **options.ingest())
    fit = options.fit()
    return {
        "points": len(samples),
        "widths": None if fit.adaptive else list(fit.widths_for(len(samples))),
        "steps": fit.steps_for(len(samples)),
        "detail_features": fit.features if fit.adaptive else None,
        "remarks": [*reading.remarks(), *counts.remarks()],
    }


def _describe(facts: Survey, cloud: PointCloud) -> list[str]:
    size = " x ".join(f"{high - low:.6g}" for low, high in zip(facts.lower, facts.upper, strict=True))
    border = f"{'open' if facts.open else 'closed'}: {facts.border_share:.1%} of the points lie at a border"
    lines = {
        "points": f"{facts.points:,}, {facts.non_finite} not finite, {facts.duplicates} duplicates",
        "size": f"{size} file units",
        "spacing": f"{facts.spacing:.4g} in the median, {facts.spacing_p5:.4g} to {facts.spacing_p95:.4g} for 90 %",
        "noise": f"{facts.noise:.3g}",
        "normals": facts.normals,
        "outliers": f"{facts.outliers} of up to 10,000 points",
        "surface": border,
        "attributes": ", ".join(cloud.attributes) or "none",
        "scanner": f"{facts.origins} known positions" if facts.origins else "positions not known",
    }
    return [f"{name + ':':12} {text}" for name, text in lines.items()]


def _sentences(plan: dict[str, Any]) -> list[str]:
    if plan["widths"] is None:
        network = f"a smooth global field and local detail of {plan['detail_features']:,} sines a cube"
    else:
        network = f"layers of {', '.join(map(str, plan['widths']))} sines, in {plan['steps']} steps"
    sentence = f"A run would fit {plan['points']:,} points with {network}."
    return [*plan["remarks"], sentence]
