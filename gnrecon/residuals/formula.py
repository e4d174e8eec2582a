"""A residual from its formula alone, for constraints that have no closed form here.

The formula is differentiated automatically by the 13 numbers f, grad f and Hess f at each point, never through the
network, so that it costs little; the network's part stays in closed form.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor
from torch.func import jacrev, vmap

from gnrecon.residuals.first_order import Linearised
from gnrecon.residuals.second_order import SecondOrder

Formula = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From one point's value (), gradient (3,) and Hessian (3, 3) to m residuals, of shape (m,)."""


def from_formula(name: str, formula: Formula, tangential: bool = False) -> SecondOrder:
    """Return the residual of a formula.

    Parameters
    ----------
    name : what the history calls it
    formula : from one point's value (), gradient (3,) and Hessian (3, 3) to residuals, of shape (m,), by torch
        functions that can be differentiated where they are evaluated
    tangential : whether it is the same whatever n . H n is, with n the normal g / |g|, as all curvatures of level sets
        are; two tangents then serve for three axes
    """

    def linearise(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
        del target
        residual = vmap(formula)(value, gradient, hessian)
        by_value, by_gradient, by_hessian = vmap(jacrev(formula, argnums=(0, 1, 2)))(value, gradient, hessian)
        return Linearised(residual, by_value, by_gradient, (by_hessian + by_hessian.mT) / 2)

    return SecondOrder(name, linearise, tangential)
