"""Runs every method on every scan of a case, and sums the trials up.

Poisson is run at several octree depths, each as a method of its own, and the depth with the smallest median of the
symmetric mean distance stands for it: the best that a user who knew the truth could choose.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.cases import CASES, draw, load
from benchmarks.table import FIGURES
from benchmarks.trial import Job, run_trial, save_mesh, save_scan


@dataclass(frozen=True)
class Protocol:
    """What holds for all trials.

    Parameters
    ----------
    threads : processors and threads of a trial
    samples : samples on each surface for measuring
    depths : octree depths of Poisson
    options : options of `gnrecon.reconstruct`, by default none
    """

    threads: int = 2
    samples: int = 100_000
    depths: tuple[int, ...] = (7, 8, 9, 10)
    options: dict[str, Any] = field(default_factory=dict)

    def contestants(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the methods with their settings."""
        poisson = [("Poisson", {"depth": depth, "n_threads": self.threads}) for depth in self.depths]
        return [("gnrecon", self.options), *poisson]


def run_case(name: str, data: Path, seeds: Sequence[int], protocol: Protocol, folder: Path) -> list[dict[str, Any]]:
    """Run all trials of a case, leaving their files in `folder`; return one record a trial.

    A record holds case, method, settings, seed, number of points, the trial's folder, and its figures or its error.

    Raises
    ------
    InputError
        When the shape's file is missing or cannot be read.
    """
    case = CASES[name]
    truth = load(case.shape, data)
    folder.mkdir()
    save_mesh(truth, folder / "truth.npz")
    records = []
    for seed in seeds:
        points, normals = draw(truth, case.fraction, seed)
        save_scan(points, normals, folder / f"scan-{seed}.npz")
        for number, (method, settings) in enumerate(protocol.contestants()):
            print(f"bench: {name}, seed {seed}, {method} {settings or ''}", file=sys.stderr)
            files = str(folder / f"scan-{seed}.npz"), str(folder / "truth.npz")
            job = Job(method, *files, threads=protocol.threads, samples=protocol.samples, settings=settings)
            place = folder / f"{seed}-{number}"
            record = {"case": name, "method": method, "settings": settings, "seed": seed, "points": len(points)}
            records.append(record | {"folder": str(place)} | run_trial(job, place))
    return records


def summarise(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians over seeds of each method's figures for one case, and the ratios gnrecon / Poisson.

    A method whose every setting failed for some seed is given by its error.
    """
    methods = {name: _best([r for r in records if r["method"] == name]) for name in ("gnrecon", "Poisson")}
    ours, theirs = methods.values()
    failed = "error" in ours or "error" in theirs
    # Poisson can be exact where the truth is flat, and nothing is a multiple of zero.
    ratio = {} if failed else {f.key: ours[f.key] / theirs[f.key] for f in FIGURES if f.ratio and theirs[f.key]}
    return {"case": records[0]["case"], "points": records[0]["points"], **methods, "ratio": ratio}


def _best(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians of the setting with the least symmetric mean among those that never failed."""
    by_settings: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        by_settings.setdefault(str(record["settings"]), []).append(record)
    sound = [group for group in by_settings.values() if not any("error" in record for record in group)]
    if not sound:
        return {"error": next(record["error"] for record in records if "error" in record)}
    summaries = [
        {"settings": group[0]["settings"], "folder": group[0]["folder"]}
        | {figure.key: median(record[figure.key] for record in group) for figure in FIGURES}
        for group in sound
    ]
    return min(summaries, key=lambda summary: summary["chamfer_mean"])
