"""The start of a fit, which decides how it ends.

*Wide and linear.* One hidden layer of random sine features sin(w . x + b) is linear in its output weights, so that
f = 0, grad f = n and the coarse signed distance have one exact least-squares solution (variable projection). The
frequencies w follow the spectral density of a Matern kernel, a Student t distribution: w = z / (l sqrt(c / nu)) with z
normal, c chi-squared of nu degrees of freedom, and l a length of 0.12 of the radius; the solve is then a sketch of
kernel interpolation with Hermite data.
Source: Rahimi and Recht, Random Features for Large-Scale Kernel Machines (2007).
Where the solution's sign disagrees with the coarse distance ("ghosts"), samples are added and the solve is repeated.

*Smooth.* Deeper networks start from small weights and the same solve of their last layer on the coarse distance alone,
so that Gauss-Newton finds a smooth field in which undamped directions are good ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from gnrecon.errors import FitError
from gnrecon.field.siren import Siren
from gnrecon.fit.problem import FieldProblem
from gnrecon.fit.scene import Scene
from gnrecon.fit.terms import Term
from gnrecon.linalg.cholesky import Cholesky
from gnrecon.linalg.metric import identity

LENGTH = 0.12
DEGREES_OF_FREEDOM = 4.0
RIDGE = 1e-8
ROUNDS = 3
ATTEMPTS = 6

SEARCH_POINTS, FINAL_POINTS = 5000, 20000
"""Most data points of the rounds that look for ghosts, and of the last round."""

TermsOf = Callable[[Tensor, Tensor, int], Sequence[Term]]
"""Terms of volume samples x, their coarse distances, and at most so many data points."""


def random_features(width: int, rng: np.random.Generator, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return frequencies, of shape (width, 3), and phases, of shape (width,), of Matern-like sine features."""
    direction = rng.standard_normal((width, 3))
    spread = np.sqrt(rng.chisquare(DEGREES_OF_FREEDOM, width) / DEGREES_OF_FREEDOM)
    frequencies = direction / spread[:, None] / LENGTH
    phases = rng.uniform(0.0, 2 * np.pi, width)
    return torch.as_tensor(frequencies).to(like), torch.as_tensor(phases).to(like)


def wide_start(field: Siren, scene: Scene, terms_of: TermsOf, rng: np.random.Generator) -> Tensor:
    """Return parameters, of shape (p,), of the one-layer network that solves `terms_of` its volume samples.

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    like = scene.points
    frequencies, phases = random_features(field.widths[0], rng, like)
    theta = field.layout.flatten([(frequencies, phases), (like.new_zeros(1, field.widths[0]), like.new_zeros(1))])
    x, distance = scene.volume(scene.volume_count, rng)
    for round_number in range(ROUNDS):
        last = round_number + 1 == ROUNDS
        terms = terms_of(scene.tensor(x), scene.tensor(distance), FINAL_POINTS if last else SEARCH_POINTS)
        theta = solve_last_layer(field, terms, theta)
        if not last:
            trial, expected = scene.volume(3 * scene.volume_count, rng)
            value = field.value(theta, scene.tensor(trial)).cpu().numpy()
            wrong = np.flatnonzero(value * np.sign(expected) <= 0)[: scene.volume_count // 2]
            x, distance = np.concatenate([x, trial[wrong]]), np.concatenate([distance, expected[wrong]])
    return theta


def smooth_start(field: Siren, scene: Scene, terms_of: TermsOf, rng: np.random.Generator) -> Tensor:
    """Return parameters, of shape (p,), of a smooth network whose last layer fits the coarse distance."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    theta = field.initial(generator).to(scene.points)
    x, distance = scene.volume(scene.volume_count, rng)
    return solve_last_layer(field, terms_of(scene.tensor(x), scene.tensor(distance), FINAL_POINTS), theta)


def solve_last_layer(field: Siren, terms: Sequence[Term], theta: Tensor) -> Tensor:
    """Return theta, of shape (p,), with its last layer solved by least squares; exact for terms linear in f.

    Raises
    ------
    FitError
        When the system is not finite.
    """
    none = torch.zeros(0, dtype=torch.long, device=theta.device)
    units = (*(none for _ in field.widths), None)
    problem = FieldProblem(field, terms, theta, units)
    free = problem.free()
    system = Cholesky().linearise(*problem.linearise(free), identity)
    ridge = RIDGE / max(len(term) for term in terms)
    for _ in range(ATTEMPTS):
        step = system.solve(ridge)
        if step.failure is None:
            return problem.whole(free + step.direction)
        # Features that nearly depend on each other: what rounding takes from the smallest eigenvalue, the ridge gives.
        ridge *= 10
    raise FitError("The linear start could not be solved: the system holds values that are not finite.")
