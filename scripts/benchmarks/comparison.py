"""Runs every method on every scan of a case, and sums the trials up.

A method with several settings, such as Poisson with its octree depths, is run with each of them, and the setting with
the smallest median of the symmetric mean distance stands for it: the best that a user who knew the truth could choose.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.arrays import save_scan, save_truth
from benchmarks.methods import OURS, PEERS
from benchmarks.problem import Case, Problem
from benchmarks.table import FIGURES
from benchmarks.trial import Job, run_trial
from gnrecon.options import Options

LAYERS = (32, 32, 32)
"""Of the paper's network. One wide layer starts at its linear fit's minimum, which Adam can only leave."""

FITS: dict[str, dict[str, Any]] = {
    "gnrecon": {},
    "Adam": {"optimiser": "adam", "widths": LAYERS},
    "L-BFGS": {"optimiser": "lbfgs", "widths": LAYERS},
}
"""Options of our own methods, beside those of the protocol."""


@dataclass(frozen=True)
class Protocol:
    """What holds for all trials.

    Parameters
    ----------
    threads : processors and threads of a trial
    samples : samples on each surface for measuring
    depths : octree depths of Poisson
    filter_scales : widths of the filters of RIMLS and APSS, in the points' own radii
    options : options of `gnrecon.reconstruct`, by default none
    limit : seconds after which a trial counts as failed, by default none
    """

    threads: int = 2
    samples: int = 100_000
    depths: tuple[int, ...] = (7, 8, 9, 10)
    filter_scales: tuple[float, ...] = (2.0, 4.0)
    options: dict[str, Any] = field(default_factory=dict)
    limit: float | None = None

    def at_quality(self, quality: str | None) -> Protocol:
        """Return the same with gnrecon's own dial between time and accuracy at a name; None leaves it where it is.

        Raises
        ------
        UsageError
            When gnrecon refuses the options, so that it is told before all trials and not by each of them.
        """
        options = self.options if quality is None else self.options | {"quality": quality}
        Options.of(**options)
        return replace(self, options=options)

    def contestants(self, methods: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
        """Return the methods with their settings, one pair a trial."""
        return [(method, settings) for method in methods for settings in self._settings(method)]

    def _settings(self, method: str) -> list[dict[str, Any]]:
        poisson = {"Poisson": "n_threads", "MeshLab Poisson": "threads"}
        if method in OURS:
            return [self.options | FITS[method]]
        if method in poisson:
            return [{"depth": depth, poisson[method]: self.threads} for depth in self.depths]
        if method in ("RIMLS", "APSS"):
            return [{"filterscale": scale} for scale in self.filter_scales]
        return [{}]


def run_case(
    name: str,
    problem_of: Callable[[int], Problem],
    seeds: Sequence[int],
    methods: Sequence[str],
    protocol: Protocol,
    folder: Path,
) -> list[dict[str, Any]]:
    """Run all trials of a case, leaving their files in a new `folder`; return one record a trial.

    A record holds case, method, settings, seed, number of points, the trial's folder, and its figures or its error. The
    problems of all seeds, which `problem_of` returns, have one truth.

    Raises
    ------
    InputError
        When the case's files are missing or cannot be read.
    """
    folder.mkdir()
    truth, records = folder / "truth.npz", []
    for seed in seeds:
        problem, scan = problem_of(seed), folder / f"scan-{seed}.npz"
        save_truth(problem.truth, truth)
        save_scan(problem.scan.points, problem.scan.normals, scan)
        for number, (method, settings) in enumerate(protocol.contestants(methods)):
            print(f"bench: {name}, seed {seed}, {method} {settings or ''}", file=sys.stderr)
            told = settings | ({"outliers": True} if problem.outliers and method in PEERS else {})
            files = str(scan), str(truth)
            job = Job(method, *files, protocol.threads, protocol.samples, told, problem.samples_apart)
            place = folder / f"{seed}-{number}"
            record = {"case": name, "method": method, "settings": told, "seed": seed, "points": len(problem.scan)}
            records.append(record | {"folder": str(place)} | run_trial(job, place, protocol.limit))
    return records


def problems_of(case: Case, data: Path) -> Callable[[int], Problem]:
    """Return the function from a seed to the problem of a case whose files lie in the folder `data`."""
    return lambda seed: case.problem(data, seed)


def summarise(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians over seeds of each method's figures for one case, and the ratios gnrecon / Poisson.

    A method whose every setting failed for some seed is given by its error.
    """
    keys = [figure.key for figure in FIGURES]
    methods = {name: best_setting([r for r in records if r["method"] == name], keys) for name in ("gnrecon", "Poisson")}
    ours, theirs = methods.values()
    failed = "error" in ours or "error" in theirs
    # Poisson can be exact where the truth is flat, and nothing is a multiple of zero.
    ratio = {} if failed else {f.key: ours[f.key] / theirs[f.key] for f in FIGURES if f.ratio and theirs[f.key]}
    return {"case": records[0]["case"], "points": records[0]["points"], **methods, "ratio": ratio}


def best_setting(records: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, Any]:
    """Return the medians of the setting with the least symmetric mean among those of a method that never failed.

    `keys` are the figures of the medians; one that a trial does not have, or has as None, is None. Where every setting
    failed, the first error is returned.
    """
    by_settings: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        by_settings.setdefault(str(record["settings"]), []).append(record)
    sound = [group for group in by_settings.values() if not any("error" in record for record in group)]
    if not sound:
        return {"error": next(record["error"] for record in records if "error" in record)}
    summaries = [
        {"settings": group[0]["settings"], "folder": group[0]["folder"]} | {key: _median(group, key) for key in keys}
        for group in sound
    ]
    return min(summaries, key=lambda summary: float(summary["chamfer_mean"]))


def _median(group: Sequence[dict[str, Any]], key: str) -> float | None:
    values = [record[key] for record in group if record.get(key) is not None]
    return median(values) if len(values) == len(group) else None
