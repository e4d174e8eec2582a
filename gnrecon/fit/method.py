"""From the options' names to an optimiser."""

from __future__ import annotations

from gnrecon.fit.options import FitOptions
from gnrecon.least_squares import SOLVERS, layer_scaled
from gnrecon.optim import LBFGS, Adam, GainRatioDamping, GaussNewton, LogLineSearch, Optimiser, Search

ENERGY = 0.3
"""Error at which conjugate gradients stop: steps that the search shortens or bends anyway need no better ones."""


def optimiser_for(options: FitOptions, auto: Search) -> Optimiser:
    """Return the optimiser that the options name; `auto` is the search that suits the network's start."""
    if options.optimiser == "adam":
        return Adam()
    if options.optimiser == "lbfgs":
        return LBFGS()
    searches: dict[str, Search] = {
        "auto": auto,
        "damping": GainRatioDamping(initial_damping=auto.initial_damping, metric=auto.metric),
        "geodesic": GainRatioDamping(initial_damping=1e-2, metric=layer_scaled, geodesic=True),
        "line": LogLineSearch(),
    }
    return GaussNewton(searches[options.search], SOLVERS[options.solver](ENERGY))
