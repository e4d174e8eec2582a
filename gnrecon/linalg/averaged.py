"""Normal equations whose matrix is averaged over steps: for points that are drawn afresh at each.

Where there are few more rows than parameters, J^T J of one draw tells nothing of some directions, and a step runs off
along them. From step to step the matrix of all rows changes little, so the mean over the last few steps, which costs
nothing more, stands for several times as many rows. The gradient is that of the step's own rows.

Source: the averaged curvature of stochastic natural-gradient methods, such as Martens and Grosse, Optimizing neural
networks with Kronecker-factored approximate curvature (2015), section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from gnrecon.linalg.cholesky import NormalSystem
from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.metric import Metric
from gnrecon.linalg.system import Equations


@dataclass
class Averaged:
    """Dense normal equations by Cholesky, the matrix averaged.

    Parameters
    ----------
    keep : share of the former mean in the new one, below 1; among the first steps each counts alike
    """

    keep: float = 0.8
    _mean: Tensor | None = field(default=None, init=False, repr=False)
    _steps: int = field(default=0, init=False, repr=False)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> NormalSystem:
        """Assemble J^T J, and take it into the mean."""
        product = jacobian.gram()
        if self._mean is None or self._mean.shape != product.shape:
            self._mean, self._steps = product, 0
        self._steps += 1
        self._mean = product.lerp(self._mean, min(self.keep, 1 - 1 / self._steps))
        return NormalSystem(Equations.of(jacobian, residual, metric), self._mean)

    def describe(self) -> str:
        """Name the solver."""
        return "Dense normal equations by Cholesky, averaged over steps."
