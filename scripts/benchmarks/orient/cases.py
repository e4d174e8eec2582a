"""The clouds whose normals are to be found: to add one, add a line."""

from __future__ import annotations

from benchmarks.accuracy.cases import SRB, VIPSS, Within
from benchmarks.accuracy.files import RangeScan
from benchmarks.accuracy.scans import AnalyticScan
from benchmarks.groups import cases_of
from benchmarks.problem import Case

FILES: dict[str, Case] = {
    **{name: Within("vipss500", case) for name, case in VIPSS.items()},
    "doghead": Within("real", RangeScan("doghead_unoriented.xyz")),
    **{name: Within("srb", SRB[name]) for name in ("anchor", "daratech", "gargoyle")},
}
ANALYTIC: dict[str, Case] = {
    "torus, 400 points": AnalyticScan("torus", 400),
    "plate, 500 points": AnalyticScan("plate", 500),
    "block, 600 points": AnalyticScan("block", 600),
    "gear, 1500 points": AnalyticScan("gear", 1500),
    "gyroid, 1500 points": AnalyticScan("gyroid", 1500),
    "plate, 4000 points": AnalyticScan("plate", 4000),
    "block, 6000 points": AnalyticScan("block", 6000),
    "gear, noise 0.5%": AnalyticScan("gear", 10_000, noise=0.005),
    "gyroid, noise 1%": AnalyticScan("gyroid", 10_000, noise=0.01),
    "torus, uneven": AnalyticScan("torus", 1000, uneven=30.0),
    "block, hole": AnalyticScan("block", 3000, hole=0.3),
}
GROUPS = {"files": FILES, "analytic": ANALYTIC}
CASES = cases_of(GROUPS)
"""Where a scan has normals, they are the truth and are thrown away."""
