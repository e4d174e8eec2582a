"""Numbers and sentences for the page, from a run's report; what the report lacks is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from gnrecon.export import DISTANCES
from gnrecon.ingest import Layers
from gnrecon.option_table import option_rows
from gnrecon.report.html.scales import count, figure, memory, seconds, share

Report = Mapping[str, Any]


@dataclass(frozen=True)
class Fact:
    """A number or a word with its label and a note."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Bar:
    """A fact with the share of the widest bar, from 0 to 1, that it fills; `kept` sets it apart from the others."""

    fact: Fact
    width: float
    kept: bool = False


def title(report: Report) -> str:
    """Name of the scan."""
    return PurePath(str(report.get("input") or "Reconstruction")).name


def verdict(report: Report) -> str:
    """What kind of surface it is, in a sentence."""
    mesh = report["mesh"]
    sound = mesh["closed"] and mesh["manifold"] and mesh["oriented"]
    parts = f"{count(mesh['components'])} component{'' if mesh['components'] == 1 else 's'}"
    if sound:
        return f"A closed, oriented 2-manifold of genus {mesh['genus']} in {parts}, verified."
    if mesh.get("guarantee"):
        article = "An" if mesh["guarantee"][0] in "aeiou" else "A"
        return f"{article} {mesh['guarantee']} in {parts}, verified."
    faults = [word for word, holds in (("open", not mesh["closed"]), ("not manifold", not mesh["manifold"])) if holds]
    faults += [] if mesh["oriented"] else ["not oriented"]
    return f"A surface in {parts}: {', '.join(faults)}."


def headlines(report: Report) -> list[Fact]:
    """The numbers at the top of the page."""
    mesh, metrics, resources = report["mesh"], report.get("metrics"), report.get("resources")
    facts = []
    if report.get("ingest"):
        facts.append(Fact("points", count(report["ingest"]["kept"]), f"of {count(report['ingest']['read'])} read"))
    facts.append(Fact("triangles", count(mesh["faces"]), f"on {count(mesh['vertices'])} vertices"))
    if mesh["closed"]:
        facts.append(Fact("volume", figure(mesh["volume"], 4), f"area {figure(mesh['area'], 4)}"))
    else:
        facts.append(Fact("area", figure(mesh["area"], 4)))
    if metrics:
        relative = figure(100 * metrics["chamfer_mean"] / metrics["radius"], 2)
        facts.append(Fact("mean error", figure(metrics["chamfer_mean"]), f"{relative} % of the radius"))
    if resources:
        facts.append(Fact("time", seconds(resources["seconds"]), f"{memory(resources['peak_memory_mb'])} at most"))
    return facts


def ingest(report: Report) -> list[Bar]:
    """What became of the points, as bars."""
    words = {
        "read": "read",
        "non_finite": "without finite coordinates",
        "zero_normals": "without a direction",
        "duplicates": "at the position of another",
        "repeated": "in a repeated copy of the scan",
        "outliers": "scattered off the surface",
        "clusters": "in isolated clusters",
        "held_out": "held out for validation",
        "thinned": "thinned out",
        "kept": "fitted",
    }
    counts = report.get("ingest") or {}
    read = counts.get("read", 0)
    return [
        Bar(Fact(label, count(counts[name]), share(counts[name], read)), counts[name] / read, name in ("read", "kept"))
        for name, label in words.items()
        if read and (counts.get(name) or name in ("read", "kept"))
    ]


def remarks(report: Report) -> list[str]:
    """Sentences about the run: normals, how the fit ended, what was done to the mesh."""
    counts, fit = report.get("ingest") or {}, report.get("fit") or {}
    sentences = [f"Normals: {counts['normals']}."] if counts.get("normals") else []
    if counts.get("outliers_found"):
        sentences.append(f"Kept {counts['outliers_found']} points that look like outliers.")
    if counts.get("clusters_found"):
        sentences.append(f"Kept {counts['clusters_found']} points in isolated clusters.")
    if layers := (report.get("scan") or {}).get("layers"):
        sentences.append(Layers(**layers).describe())
    return [*sentences, *(fit[name] for name in ("method", "status") if fit.get(name)), *report.get("actions", [])]


def surface(report: Report) -> list[Fact]:
    """The mesh's counts and sizes."""
    mesh = report["mesh"]
    facts = [
        Fact("Vertices", count(mesh["vertices"])),
        Fact("Triangles", count(mesh["faces"])),
        Fact("Components", count(mesh["components"])),
        Fact("Euler characteristic", count(mesh["euler_characteristic"])),
    ]
    if mesh.get("genus") is not None:
        facts.append(Fact("Genus", count(mesh["genus"])))
    facts.append(Fact("Area", figure(mesh["area"], 6), "file units²"))
    if mesh["closed"]:
        facts.append(Fact("Volume", figure(mesh["volume"], 6), "file units³"))
    facts += [Fact(word.capitalize(), _yes_or_no(mesh[word])) for word in ("closed", "manifold", "oriented")]
    if (report.get("fineness") or {}).get("chord_error") is not None:
        fineness = report["fineness"]
        cells = f"from the fitted surface, with {count(fineness['resolution'])} cells"
        facts.append(Fact("Chord error", figure(fineness["chord_error"]), cells))
    if mesh.get("invented_area_share") is not None:
        facts.append(
            Fact("Without data", unsupported(report), f"beyond {figure(mesh['invented_beyond'])} of any point")
        )
    if report.get("trim"):
        trim = report["trim"]
        facts.append(Fact("Cut off", share(trim["area_share"], 1), f"beyond {figure(trim['distance'])} of any point"))
    return facts


def unsupported(report: Report) -> str:
    """Share of the surface that no data supports."""
    return share(report["mesh"]["invented_area_share"], 1)


def metrics(report: Report) -> list[tuple[Fact, str]]:
    """Distances to the reference, each with its definition, and with its share of the radius as a note."""
    values = report.get("metrics")
    if not values:
        return []
    target = "nearest point" if values["reference_is_cloud"] else "surface"
    rows = [
        (Fact(_words(name), figure(values[name], 4), f"{figure(100 * values[name] / values['radius'], 3)} %"), meaning)
        for name, meaning in DISTANCES.items()
    ]
    rows = [(fact, meaning.format(target=target)) for fact, meaning in rows]
    if values.get("normal_consistency") is not None:
        meaning = "mean |cosine| of a sample's normal and the nearest one's, mean of both directions"
        rows.append((Fact("Normal consistency", figure(values["normal_consistency"], 4)), meaning))
    meaning = (
        f"harmonic mean of precision {figure(values['precision'], 4)} and recall {figure(values['recall'], 4)} "
        f"within {figure(values['threshold'])}"
    )
    rows.append((Fact("F-score", figure(values["f_score"], 4)), meaning))
    return rows


def stages(report: Report) -> list[Bar]:
    """Times of the stages as bars, with their peak memory as notes."""
    done = report.get("stages") or []
    longest = max((stage["seconds"] for stage in done), default=0) or 1.0
    return [
        Bar(
            Fact(stage["name"], seconds(stage["seconds"]), memory(stage["peak_memory_mb"])),
            stage["seconds"] / longest,
        )
        for stage in done
    ]


def options(report: Report) -> list[Fact]:
    """Every option with its value."""
    rows = option_rows()
    return [
        Fact(rows[name].flag if name in rows else f"--{name.replace('_', '-')}", _value(value))
        for name, value in (report.get("options") or {}).items()
    ]


def versions(report: Report) -> list[Fact]:
    """What made the result, the device included."""
    facts = [Fact(name, version) for name, version in (report.get("versions") or {}).items()]
    resources = report.get("resources")
    if resources:
        threads = resources["threads"]
        device = resources["device_name"] or f"{resources['device']}, {threads} thread{'' if threads == 1 else 's'}"
        facts.append(Fact("device", device))
    return facts


def _value(value: Any) -> str:
    if value is None or value in ((), []):
        return "not given"
    if isinstance(value, bool):
        return _yes_or_no(value)
    if isinstance(value, int):
        return count(value)
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _yes_or_no(value: bool) -> str:
    return "yes" if value else "no"


def _words(name: str) -> str:
    return name.replace("_", " ").capitalize().replace("rms", "RMS")
