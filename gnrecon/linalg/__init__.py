"""Damped linear least squares from chunks of rows; knows no geometry."""

from gnrecon.linalg.damped import DampedSystem, Step, identity, jacobian_scaled, normal_equations

__all__ = ["DampedSystem", "Step", "identity", "jacobian_scaled", "normal_equations"]
