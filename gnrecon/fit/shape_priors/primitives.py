"""Planes, round cylinders and spheres: signed distance, normals, and least-squares fits to oriented points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import leastsq

from gnrecon.fit.shape_priors.prior_parameters import DetectionParameters
from gnrecon.geometry.arrays import Float, Mask


@dataclass(frozen=True)
class Plane:
    """A plane through a point, of shape (3,), with an outward unit normal, of shape (3,)."""

    center: Float
    direction: Float

    def signed_distance(self, x: Float) -> Float:
        """Return the height over the plane, of shape (Q,), at x, of shape (Q, 3); negative inside."""
        height: Float = (x - self.center) @ self.direction
        return height

    def normal(self, x: Float) -> Float:
        """Return the plane's normal for each x, of shape (Q, 3)."""
        return np.broadcast_to(self.direction, x.shape)

    def refitted(
        self,
        points: Float,
        normals: Float,
        _radius: float,
        _normal_weight: float = DetectionParameters.normal_weight_radii,
    ) -> Plane:
        """Return the least-squares plane of points."""
        center = points.mean(axis=0)
        direction = _principal_axes(points - center)[0]
        return Plane(center, direction * np.sign(direction @ normals.sum(axis=0)))


@dataclass(frozen=True)
class Cylinder:
    """A round cylinder without ends.

    Parameters
    ----------
    center : array of shape (3,), on the axis
    axis : array of shape (3,), of length one
    radius : unit coordinates
    side : 1 for a peg, -1 for a bore
    """

    center: Float
    axis: Float
    radius: float
    side: float

    def signed_distance(self, x: Float) -> Float:
        """Return the distance from the axis minus the radius, or the reverse in a bore."""
        distance: Float = self.side * (np.linalg.norm(self._off_axis(x), axis=1) - self.radius)
        return distance

    def normal(self, x: Float) -> Float:
        """Return the direction away from the axis, or towards it in a bore."""
        across = self._off_axis(x)
        outward: Float = self.side * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        return outward

    def refitted(
        self,
        points: Float,
        normals: Float,
        radius: float,
        normal_weight: float = DetectionParameters.normal_weight_radii,
    ) -> Cylinder:
        """Return the least-squares cylinder of points and, by a weight, their normals.

        Parameters
        ----------
        points, normals : arrays of shape (N, 3)
        radius : of the disk that a point stands for, the unit of the heights
        normal_weight : height that counts as much as a normal's difference of one, in that unit
        """
        axis, upward, aside = _principal_axes(normals)

        def moved(step: Float) -> Cylinder:
            turned = axis + step[0] * aside + step[1] * upward
            center = self.center + step[2] * aside + step[3] * upward
            return Cylinder(center, turned / np.linalg.norm(turned), step[4], self.side)

        fit = _RoundFit(points, normals, self.side, radius, normal_weight)

        def residuals(step: Float) -> Float:
            return fit.residuals(moved(step)._off_axis(points), step[4])

        def jacobian(step: Float) -> Float:
            """Return the derivatives of the residuals by the step."""
            trial = moved(step)
            size = np.linalg.norm(axis + step[0] * aside + step[1] * upward)
            off, moves = points - trial.center, []
            for along in (aside, upward):
                # How the axis turns; what is along it moves across.
                turn = (along - (along @ trial.axis) * trial.axis) / size
                moves.append(-(off @ turn)[:, None] * trial.axis - (off @ trial.axis)[:, None] * turn)
            for along in (aside, upward):
                moves.append(np.broadcast_to((along @ trial.axis) * trial.axis - along, off.shape))
            return fit.jacobian(trial._off_axis(points), np.stack(moves))

        return moved(_minimised(residuals, jacobian, [0.0, 0.0, 0.0, 0.0, self.radius]))

    def _off_axis(self, x: Float) -> Float:
        """Return the vectors from the axis to x, both of shape (Q, 3)."""
        offset = x - self.center
        across: Float = offset - (offset @ self.axis)[:, None] * self.axis
        return across


@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Parameters
    ----------
    center : array of shape (3,)
    radius : unit coordinates
    side : 1 for a ball, -1 for a hollow
    """

    center: Float
    radius: float
    side: float

    def signed_distance(self, x: Float) -> Float:
        """Return the distance from the centre minus the radius, or the reverse in a hollow."""
        distance: Float = self.side * (np.linalg.norm(x - self.center, axis=1) - self.radius)
        return distance

    def normal(self, x: Float) -> Float:
        """Return the direction away from the centre, or towards it in a hollow."""
        offset = x - self.center
        outward: Float = self.side * offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
        return outward

    def refitted(
        self,
        points: Float,
        normals: Float,
        radius: float,
        normal_weight: float = DetectionParameters.normal_weight_radii,
    ) -> Sphere:
        """Return the least-squares sphere of points and normals; the parameters are those of `Cylinder.refitted`."""

        fit = _RoundFit(points, normals, self.side, radius, normal_weight)
        moves = np.broadcast_to(-np.eye(3)[:, None], (3, *points.shape))

        def residuals(step: Float) -> Float:
            return fit.residuals(points - self.center - step[:3], step[3])

        def jacobian(step: Float) -> Float:
            return fit.jacobian(points - self.center - step[:3], moves)

        found = _minimised(residuals, jacobian, [0.0, 0.0, 0.0, self.radius])
        return Sphere(self.center + found[:3], float(found[3]), self.side)


@dataclass(frozen=True)
class _RoundFit:
    """Heights of oriented points over a round primitive, and the differences of its normals from theirs.

    Parameters
    ----------
    points, normals, side, radius, normal_weight : as in `Cylinder` and `Cylinder.refitted`
    """

    points: Float
    normals: Float
    side: float
    radius: float
    normal_weight: float

    def residuals(self, away: Float, size: float) -> Float:
        """Return the residuals, of shape (4 N,), of points at `away`, of shape (N, 3), from the axis or centre."""
        distance, outward = self._outward(away)
        turn = self.normal_weight * (self.side * outward - self.normals)
        return np.concatenate([self.side * (distance - size) / self.radius, turn.ravel()])

    def jacobian(self, away: Float, moves: Float) -> Float:
        """Return their derivatives, of shape (K + 1, 4 N): by K unknowns, and by the primitive's radius.

        `moves` are the derivatives of `away` by the unknowns, of shape (K, N, 3).
        """
        distance, outward = self._outward(away)
        along = np.einsum("knd,nd->kn", moves, outward)
        turn = (moves - along[:, :, None] * outward) / distance[:, None]
        found = np.zeros((len(moves) + 1, 4 * len(away)))
        found[:-1, : len(away)] = self.side / self.radius * along
        found[:-1, len(away) :] = self.side * self.normal_weight * turn.reshape(len(moves), -1)
        found[-1, : len(away)] = -self.side / self.radius
        return found

    @staticmethod
    def _outward(away: Float) -> tuple[Float, Float]:
        """Return the distances, of shape (N,), and the directions, of shape (N, 3)."""
        distance = np.maximum(np.sqrt(np.einsum("nd,nd->n", away, away)), 1e-12)
        return distance, away / distance[:, None]


Primitive = Plane | Cylinder | Sphere


def project(primitive: Primitive, points: Float) -> Float:
    """Return the points of a primitive nearest to some, all of shape (K, 3)."""
    nearest: Float = points - primitive.signed_distance(points)[:, None] * primitive.normal(points)
    return nearest


def is_inlier(
    primitive: Primitive,
    points: Float,
    normals: Float,
    max_height: float,
    angle_degrees: float = DetectionParameters.angle_degrees,
) -> Mask:
    """Return which points, of shape (N, 3), lie on a primitive by their height over it and by their normals."""
    inliers: Mask = np.abs(primitive.signed_distance(points)) < max_height
    near = np.flatnonzero(inliers)
    inliers[near] = np.einsum("kd,kd->k", primitive.normal(points[near]), normals[near]) > cosine_of(angle_degrees)
    return inliers


def cosine_of(degrees: float) -> float:
    """Return the cosine of an angle in degrees."""
    return float(np.cos(np.radians(degrees)))


def _minimised(
    residuals: Callable[[Float], Float],
    jacobian: Callable[[Float], Float],
    start: list[float],
    *,
    max_evaluations: int = 60,
    tolerance: float = 1e-8,
) -> Float:
    """Return where the sum of squared residuals, of shape (M,), is least, by Levenberg-Marquardt.

    Parameters
    ----------
    residuals, jacobian : of the unknowns, of shape (K,); the latter has the shape (K, M)
    start : the unknowns to start from
    max_evaluations : bounds the time of a proposal that fits badly
    tolerance : of the sum of squares, the unknowns and the gradient, relative
    """
    # Points are few, so that `least_squares`, which checks each evaluation, would take several times as long.
    tolerances = {"ftol": tolerance, "xtol": tolerance, "gtol": tolerance, "diag": np.ones(len(start))}
    found: Float = leastsq(
        residuals, start, Dfun=jacobian, col_deriv=True, full_output=True, maxfev=max_evaluations, **tolerances
    )[0]
    return found


def _principal_axes(directions: Float) -> Float:
    """Return the principal axes of directions, of shape (K, 3), in rows, that of least variance first."""
    axes: Float = np.linalg.eigh(directions.T @ directions)[1].T
    return axes
