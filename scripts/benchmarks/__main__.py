"""Starts a benchmark by its name; without a name, lists them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from gnrecon.runtime.errors import ExitCode, GnreconError


@dataclass(frozen=True)
class Benchmark:
    """A module with a function ``main(arguments) -> exit code``, and what it measures, in a line."""

    module: str
    description: str


BENCHMARKS = {
    "paper": Benchmark("benchmarks.paper", "the paper's two shapes, gnrecon beside screened Poisson"),
    "accuracy": Benchmark("benchmarks.accuracy.main", "gnrecon beside its peers on clean, noisy and sparse scans"),
    "uncertainty": Benchmark("benchmarks.uncertainty.main", "sigma beside the true error, on known shapes"),
    "engine": Benchmark("benchmarks.engine.main", "Gauss-Newton beside the paper's algorithm written plainly"),
    "learn": Benchmark("benchmarks.learn.main", "shape learning by three optimisers, and one step's time"),
    "transport": Benchmark("benchmarks.transport", "what the paper's neglected terms of moving surfaces change"),
    "blocks": Benchmark(
        "benchmarks.blocks.main", "scans of up to two million points, fitted by blocks: cost and seams"
    ),
    "ingest": Benchmark("benchmarks.ingest.main", "reading of 20 million points, in every format that is streamed"),
    "orient": Benchmark("benchmarks.orient.main", "estimated normals, and their meshes, beside open3d's"),
    "refine": Benchmark("benchmarks.refine.main", "remeshing and fewer faces, beside the libraries' own"),
    "batch": Benchmark("benchmarks.batch.main", "many scans, some broken, killed and continued; and throughput"),
    "export": Benchmark("benchmarks.export.main", "extraction at growing resolutions, beside the whole grid"),
}


def listing() -> str:
    """Return the benchmarks, one a line."""
    width = max(len(name) for name in BENCHMARKS)
    lines = [f"  {name:{width}}  {benchmark.description}" for name, benchmark in BENCHMARKS.items()]
    return "\n".join(["usage: bench NAME [options]     (bench NAME --help shows the options)", "", *lines])


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark that the first argument names with the other arguments; return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listing())
        return ExitCode.OK
    name, *rest = arguments
    if name not in BENCHMARKS:
        print(f"bench: there is no benchmark {name!r}; expected one of {', '.join(BENCHMARKS)}.", file=sys.stderr)
        return ExitCode.USAGE
    try:
        return int(import_module(BENCHMARKS[name].module).main(rest))
    except GnreconError as error:
        print(f"bench: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
