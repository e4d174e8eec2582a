"""Random fields of many kinds, some of them unpleasant, each made from a seed alone."""

from __future__ import annotations

import numpy as np
import torch
from analytic_fields import UNIT, UTM, Field, Function, plate, sines, sphere, union

from gnrecon.export import SignedDistance
from gnrecon.field import Siren
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box

Rng = np.random.Generator
FAR = Frame(np.array([-3e3, 2e4, 7.0]), 0.01)
"""A shape of a centimetre, kilometres from the origin."""


def network(rng: Rng) -> SignedDistance:
    """A sine network of one to three layers with random weights, from smooth to wild."""
    widths = tuple(int(n) for n in rng.integers(4, 64, rng.integers(1, 4)))
    field = Siren(widths)
    theta = field.initial(torch.Generator().manual_seed(int(rng.integers(2**31))))
    layers = [(w.clone(), b.clone()) for w, b in field.layout.layers(theta)]
    layers[0][0].mul_(float(rng.uniform(2.0, 20.0)))
    layers[-1][1].copy_(torch.tensor(rng.normal(0, 0.1, 1)))
    return NeuralSDF(field, field.layout.flatten(layers), _frame(rng), Box(np.full(3, -1.1), np.full(3, 1.1)))


def ring(rng: Rng) -> SignedDistance:
    """A torus of any thickness, place and direction; a thin one is a few cells, or less, across."""
    major, minor = rng.uniform(0.3, 0.7), rng.uniform(0.02, 0.4)
    turn, shift = _rotation(rng), rng.uniform(-0.2, 0.2, 3)

    def function(x: np.ndarray) -> np.ndarray:
        y = (x - shift) @ turn
        return np.hypot(np.hypot(y[:, 0], y[:, 1]) - major, y[:, 2]) - minor

    return _posed(function, rng)


def nested_shells(rng: Rng) -> SignedDistance:
    """Up to four spheres about nearly one centre, with walls and gaps from thick to thinner than a cell."""
    radii = np.sort(rng.uniform(0.05, 1.0, rng.integers(2, 5)))
    centers = rng.uniform(-0.05, 0.05, (len(radii), 3))

    def function(x: np.ndarray) -> np.ndarray:
        distances = np.stack([np.linalg.norm(x - c, axis=1) - r for c, r in zip(centers, radii, strict=True)])
        inside = (distances < 0).sum(axis=0) % 2 == 1
        return np.where(inside, -1, 1) * np.abs(distances).min(axis=0)

    return _posed(function, rng)


def touching_spheres(rng: Rng) -> SignedDistance:
    """Spheres that touch in a point, or in a circle's width of nothing, or overlap a little."""
    count = int(rng.integers(2, 6))
    direction = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    direction /= np.linalg.norm(direction)
    gap = rng.choice([0.0, 0.0, 1e-9, -1e-9, 1e-3, -1e-3])
    radius = 0.9 / count
    places = (np.arange(count) - (count - 1) / 2) * (2 * radius + gap)
    return _posed(union(*(sphere(radius, tuple(direction * place)) for place in places)), rng)


def beyond_the_box(rng: Rng) -> SignedDistance:
    """Spheres and plates that reach through the border of the box."""
    center = rng.uniform(-1.2, 1.2, 3)
    shapes = [sphere(rng.uniform(0.3, 1.3), tuple(center)), plate(rng.uniform(0.01, 0.3))]
    turn = _rotation(rng)
    return _posed(lambda x: union(*shapes)(x @ turn), rng, reach=rng.uniform(0.4, 0.9))


def noise(rng: Rng) -> SignedDistance:
    """A sum of sines with many small parts and saddles, which reaches through the border everywhere."""
    return _posed(sines(int(rng.integers(2**31)), rng.uniform(3.0, 15.0)), rng)


def steps(rng: Rng) -> SignedDistance:
    """Values that are flat but for jumps, and exactly zero in places."""
    inner = sines(int(rng.integers(2**31)), rng.uniform(2.0, 6.0))
    levels = rng.uniform(3.0, 40.0)
    return _posed(lambda x: np.round(levels * inner(x)) / levels, rng)


KINDS = (network, ring, nested_shells, touching_spheres, beyond_the_box, noise, steps)


def random_field(seed: int) -> tuple[str, SignedDistance]:
    """The kind and the field of a seed; networks come most often."""
    kind = network if seed % 2 == 0 else KINDS[1 + seed // 2 % (len(KINDS) - 1)]
    return kind.__name__, kind(np.random.default_rng(seed))


def _frame(rng: Rng) -> Frame:
    return (UNIT, UTM, FAR)[rng.integers(3)]


def _posed(function: Function, rng: Rng, reach: float = 1.1) -> Field:
    return Field(function, reach, _frame(rng))


def _rotation(rng: Rng) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]
