"""What the trials of a case come to, and in how many of the hard cases gnrecon is ahead of its best peer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.accuracy.cases import HARD
from benchmarks.comparison import best_setting
from benchmarks.methods import PEERS
from benchmarks.problem import Problem
from gnrecon.geometry.point_cloud import PointCloud

LENGTHS = (
    "reference_to_mesh_mean",
    "mesh_to_reference_mean",
    "chamfer_mean",
    "rms",
    "hausdorff",
    "samples_chamfer",
    "samples_hausdorff",
)
OTHERS = ("normal_consistency", "f_score", "components", "genus", "boundary_edges", "seconds", "peak_memory_mb")
QUARTER = 0.75
"""What a quarter or more below the best peer is, as a ratio of mean distances."""


def summarise(records: Sequence[dict[str, Any]], problem: Problem) -> dict[str, Any]:
    """Return what is known of a case, and for each of its methods the medians over seeds at the best setting.

    Distances are in the truth's own unit; `factor` leads to the `unit` in which they are told.
    """
    found = [record | _derived(record) for record in records]
    names = dict.fromkeys(record["method"] for record in found)
    keys = (*LENGTHS, *OTHERS, "closed")
    return {
        "case": records[0]["case"],
        "points": records[0]["points"],
        "genus": problem.genus,
        "against_scan": isinstance(problem.truth, PointCloud),
        "unit": problem.unit,
        "factor": problem.factor,
        "methods": {name: best_setting([r for r in found if r["method"] == name], keys) for name in names},
    }


@dataclass(frozen=True)
class Standing:
    """In how many hard cases gnrecon's symmetric mean is below the best peer's, and by a quarter or more."""

    cases: int
    below: int
    quarter: int

    def describe(self) -> str:
        """Say it in a sentence."""
        return (
            f"Of {self.cases} noisy or sparse analytic cases, gnrecon's mean distance is below the best peer's in "
            f"{self.below}, by a quarter or more in {self.quarter}."
        )


def standing(summaries: Sequence[dict[str, Any]]) -> Standing | None:
    """Return how gnrecon stands in the hard cases among `summaries`; None where none of them sets it beside a peer.

    A method that failed is infinitely far from the truth.
    """
    ratios = [ratio for ratio in map(_ratio, (s for s in summaries if s["case"] in HARD)) if ratio is not None]
    if not ratios:
        return None
    return Standing(len(ratios), sum(ratio < 1 for ratio in ratios), sum(ratio <= QUARTER for ratio in ratios))


def best_peer(summary: dict[str, Any]) -> str | None:
    """Return the peer with the least symmetric mean; None where none was run."""
    peers = [name for name in summary["methods"] if name in PEERS]
    return min(peers, key=lambda name: _mean(summary, name), default=None)


def _ratio(summary: dict[str, Any]) -> float | None:
    peer = best_peer(summary)
    if peer is None or "gnrecon" not in summary["methods"]:
        return None
    ours, theirs = _mean(summary, "gnrecon"), _mean(summary, peer)
    if math.isinf(theirs):
        return math.inf if math.isinf(ours) else 0.0
    # Ball pivoting on a clean plane has no error at all, and nothing is a multiple of zero.
    return ours / theirs if theirs else math.inf


def _mean(summary: dict[str, Any], method: str) -> float:
    return float(summary["methods"][method].get("chamfer_mean", math.inf))


def _derived(record: dict[str, Any]) -> dict[str, Any]:
    """Return the root mean square of the samples of both surfaces together, where there are any."""
    if "error" in record:
        return {}
    there, back = record["reference_to_mesh_rms"], record["mesh_to_reference_rms"]
    return {"rms": math.sqrt((there**2 + back**2) / 2)}
