"""Every linear solver on one frozen linearisation, at two dampings.

The reference is the dense step in float64; `difference` is |s - s_dense| / |s_dense|. Setting up counts what is done
once for a linearisation, a solve what is done for each damping. A solver whose matrix would take more than half of the
memory is passed over, and says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import psutil
import torch
from torch import Tensor

from benchmarks.engine.clock import timed
from benchmarks.engine.loss import posed
from benchmarks.engine.step import Frozen
from gnrecon.field import Siren
from gnrecon.least_squares import SOLVERS, Cholesky, Jacobian, layer_scaled

DAMPINGS = (1e-2, 1e-5)
HELD = {"row-space": 3}
"""Solvers with an M by M matrix, and how many of them they hold at once."""


def dense_steps(frozen: Frozen, dampings: Sequence[float] = DAMPINGS) -> list[Tensor]:
    """Return the exact steps, each of shape (p,)."""
    system = Cholesky().linearise(*_linearised(frozen), layer_scaled)
    return [system.solve(damping).direction for damping in dampings]


def measure_solvers(
    frozen: Frozen,
    reference: Sequence[Tensor],
    dampings: Sequence[float] = DAMPINGS,
    device: str = "cpu",
    names: Sequence[str] = tuple(SOLVERS),
) -> dict[str, Any]:
    """Return for each solver its seconds, and for each damping its iterations and difference to the reference."""
    jacobian, residual = _linearised(frozen.to(device))
    return {
        "rows": jacobian.rows,
        "parameters": jacobian.columns,
        "dampings": list(dampings),
        "solvers": {name: _measure(name, jacobian, residual, reference, dampings, device) for name in names},
    }


def _linearised(frozen: Frozen) -> tuple[Jacobian, Tensor]:
    return posed(Siren(frozen.widths), frozen.theta, frozen.sample).linearise(frozen.theta)


def _measure(
    name: str,
    jacobian: Jacobian,
    residual: Tensor,
    reference: Sequence[Tensor],
    dampings: Sequence[float],
    device: str,
) -> dict[str, Any]:
    needed = HELD.get(name, 0) * 8 * jacobian.rows**2
    if needed > _memory(device) / 2:
        return {"error": f"It would take {needed / 1e9:.1f} GB."}
    solver = SOLVERS[name]()
    set_up, system = timed(lambda: solver.linearise(jacobian, residual, layer_scaled), device)
    solves = []
    for damping, exact in zip(dampings, reference, strict=True):
        seconds, step = timed(partial(system.solve, damping), device)
        difference = float((step.direction.cpu() - exact).norm() / exact.norm())
        solves.append(
            {"seconds": seconds, "iterations": step.iterations, "difference": difference, "failure": step.failure}
        )
    return {"set_up_seconds": set_up, "describe": solver.describe(), "solves": solves}


def _memory(device: str) -> int:
    if device == "cuda":
        return int(torch.cuda.mem_get_info()[0])
    return int(psutil.virtual_memory().available)
