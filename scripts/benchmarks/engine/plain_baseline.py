"""The baseline of the engine's benchmark: a plain implementation of the paper's algorithm with torch.func.

With residuals r_k of N_k points and weights w_k, a step assembles and solves, in float64,

    A = sum_k w_k / N_k J_k^T J_k + 1e-6 I,    b = sum_k w_k / N_k J_k^T r_k,    A d = b,

J_k by vmap(jacrev), d by torch.linalg.lstsq, and goes to the best of theta - eta d for eta = 1, 1/2, ..., 2^-14, or
stays: lengths evenly spaced in their logarithm, all from the same start. The network starts from weights uniform within
1/sqrt(fan-in), pretrained by Adam on the unit sphere's signed distance.
Source: the paper's section on Gauss-Newton for shape learning, and its appendix on experimental details."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from benchmarks.engine.paper_loss import PAPER_WEIGHTS, Sample

Residual = Callable[[Tensor, Tensor, Tensor], Tensor]
"""r of one point: of theta, the point and the normal there, both of shape (3,)."""


@dataclass(frozen=True)
class BaselineStep:
    """Parameters after a step, of shape (p,), its direction d, the loss there, and the length eta, zero for none."""

    theta: Tensor
    direction: Tensor
    loss: float
    length: float


@dataclass(frozen=True)
class Baseline:
    """The algorithm for one network and one sample.

    Parameters
    ----------
    widths : sizes of the hidden layers
    sample : the points of the loss
    chunk : points whose Jacobian is computed at a time, or None for all at once
    damping, trials : the paper's epsilon, and its number of step lengths
    """

    widths: tuple[int, ...]
    sample: Sample
    chunk: int | None = None
    damping: float = 1e-6
    trials: int = 15

    def value(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return f at one point, of shape (3,)."""
        return network(self.widths, theta, x)

    def data(self, theta: Tensor, x: Tensor, normal: Tensor) -> Tensor:
        """Return f at a point."""
        del normal
        return self.value(theta, x)

    def normal(self, theta: Tensor, x: Tensor, normal: Tensor) -> Tensor:
        """Return n . grad f - 1 at a point."""
        gradient: Tensor = grad(self.value, argnums=1)(theta, x)
        return gradient @ normal - 1.0

    def eikonal(self, theta: Tensor, x: Tensor, normal: Tensor) -> Tensor:
        """Return |grad f| - 1 at a point."""
        del normal
        length: Tensor = torch.linalg.vector_norm(grad(self.value, argnums=1)(theta, x))
        return length - 1.0

    def terms(self) -> list[tuple[float, Residual, Tensor, Tensor]]:
        """Return w_k / N_k, r_k, and its points and normals."""
        points, normals, volume = self.sample.points, self.sample.normals, self.sample.volume
        of_term = [(self.data, points, normals), (self.normal, points, normals), (self.eikonal, volume, volume)]
        return [(w / len(x), r, x, n) for w, (r, x, n) in zip(PAPER_WEIGHTS, of_term, strict=True)]

    def jacobian(self, residual: Residual, theta: Tensor, x: Tensor, n: Tensor) -> Tensor:
        """Return J_k, of shape (N_k, p)."""
        rows: Tensor = vmap(jacrev(residual), in_dims=(None, 0, 0), chunk_size=self.chunk)(theta, x, n)
        return rows

    def loss(self, theta: Tensor) -> float:
        """Return the loss at theta, of shape (p,)."""
        terms = self.terms()
        return sum(0.5 * scale * float(residuals(r, theta, x, n).square().sum()) for scale, r, x, n in terms)

    def direction(self, theta: Tensor) -> Tensor:
        """Return d, of shape (p,)."""
        A, b = self.damping * torch.eye(len(theta)).to(theta), torch.zeros_like(theta)
        for scale, residual, x, n in self.terms():
            J, r = self.jacobian(residual, theta, x, n), residuals(residual, theta, x, n)
            A += scale * (J.T @ J)
            b += scale * (J.T @ r)
        solution: Tensor = torch.linalg.lstsq(A, b[:, None]).solution
        return solution[:, 0]

    def step(self, theta: Tensor) -> BaselineStep:
        """Return the best trial along d, or the start where none is better."""
        direction = self.direction(theta)
        best = BaselineStep(theta, direction, self.loss(theta), 0.0)
        for trial in range(self.trials):
            length = 2.0**-trial
            moved = theta - length * direction
            loss = self.loss(moved)
            if loss < best.loss:
                best = BaselineStep(moved, direction, loss, length)
        return best


def network(widths: tuple[int, ...], theta: Tensor, x: Tensor) -> Tensor:
    """Return f at one point, of shape (3,); theta holds weights row by row, then biases, layer by layer."""
    activation, start = x, 0
    for out, into in shapes(widths):
        weights, start = theta[start : start + out * into].view(out, into), start + out * into
        bias, start = theta[start : start + out], start + out
        z = weights @ activation + bias
        activation = torch.sin(z) if start < len(theta) else z
    return activation[0]


def residuals(residual: Residual, theta: Tensor, x: Tensor, n: Tensor) -> Tensor:
    """Return r_k at all points, of shape (N_k,)."""
    values: Tensor = vmap(residual, in_dims=(None, 0, 0))(theta, x, n)
    return values


def shapes(widths: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return (out, in) of each layer."""
    return list(zip((*widths, 1), (3, *widths), strict=True))


def pretrained(
    widths: tuple[int, ...],
    iterations: int = 1500,
    seed: int = 0,
    *,
    points: int = 2048,
    rate: float = 1e-3,
    half_side: float = 1.2,
) -> Tensor:
    """Return theta, of shape (p,), of a network near the unit sphere's signed distance, by Adam.

    Every iteration has `points` in a cube of `half_side`, and the learning rate `rate`.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for out, into in shapes(widths):
        uniform = torch.rand(out * (into + 1), generator=generator, dtype=torch.float64)
        parts.append((2 * uniform - 1) / math.sqrt(into))
    theta = torch.cat(parts).requires_grad_()
    optimiser = torch.optim.Adam([theta], rate)
    for _ in range(iterations):
        uniform = torch.rand(points, 3, generator=generator, dtype=torch.float64)
        x = half_side * (2 * uniform - 1)
        value = vmap(lambda point: network(widths, theta, point))(x)
        loss = (value - (torch.linalg.vector_norm(x, dim=1) - 1.0)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return theta.detach()
