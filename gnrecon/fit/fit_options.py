"""The options of a fit, with their defaults and checks (`FitOptions`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from gnrecon.fit.parameters import NetworkLadderParameters, SingleNetworkParameters
from gnrecon.fit.penalties.regularisers import Regulariser, regularisers
from gnrecon.least_squares import SOLVERS
from gnrecon.residuals.constraints import Residual, SecondOrder, normal_cosine, normal_projection, normal_vector
from gnrecon.residuals.named_residuals import named
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.plugins import find, installed
from gnrecon.runtime.typed_values import require_field_types

NORMAL_RESIDUALS: dict[str, Residual] = {
    "vector": normal_vector,
    "projection": normal_projection,
    "cosine": normal_cosine,
}
# Features of each local field.
QUALITIES = {"draft": 150, "normal": 300, "high": 500}
SEARCHES = ("auto", "damping", "geodesic", "line")
OPTIMISERS = {"gn": "Gauss-Newton", "adam": "Adam", "lbfgs": "L-BFGS"}


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    Parameters
    ----------
    widths : tuple of int, optional
        Hidden layers of one network for the whole shape. By default there is a global network of a width that the data
        determines, and local fields; see `gnrecon.fit.two_level`. One wide layer starts from random sine
        features and an exact linear solve; several layers from random frequencies.
    steps : int, optional
        Steps after the start of one network; by default, of Gauss-Newton, 4 for one wide layer and 1,000 points or
        more, none for fewer points, 120 for several layers; 2,000 of Adam, and 40 of L-BFGS, each of 20 iterations.
        Given without widths, or with another optimiser or normal residual, one wide layer is fitted: with
        three units per point, at least 1,000 and at most 2,000, or beyond 8,000 points with one unit for four points,
        at most 3,000.
    quality : ``"draft"``, ``"normal"`` or ``"high"``
        Features of each local field: 150, 300 or 500. In draft quality, the global field is linear.
    normals : ``"vector"``, ``"projection"``, ``"cosine"``, or a name that another package brings
        Residual of the given normals; see `gnrecon.residuals.constraints`.
    optimiser : ``"gn"``, ``"adam"`` or ``"lbfgs"``
        Gauss-Newton, or one of the methods that the paper compares with.
    solver : str
        Linear solver of Gauss-Newton's steps, a name of `gnrecon.least_squares.SOLVERS`; ``"auto"`` picks by rows,
        parameters, memory and device.
    search : ``"auto"``, ``"damping"``, ``"geodesic"`` or ``"line"``
        Step control of Gauss-Newton: gain-ratio damping, the same with geodesic acceleration, or the paper's log-spaced
        line search with tiny damping; by default the one that suits the network's start.
    seed : int
        Seeds features and samples.
    device : str
        A torch device, ``"cpu"`` or ``"cuda"``.
    smooth, fill, prior : str, optional
        Curvature penalties of the default fit, such as ``"strain=1e-4"``, ``"minimal"`` and ``"developable"``; see
        `gnrecon.fit.penalties.regularisers`.

    Raises
    ------
    UsageError
        When a value is out of its range or of another type.
    """

    widths: tuple[int, ...] | None = None
    steps: int | None = None
    quality: str = "normal"
    normals: str = "vector"
    optimiser: str = "gn"
    solver: str = "auto"
    search: str = "auto"
    seed: int = 0
    device: str = "cpu"
    smooth: str | None = None
    fill: str | None = None
    prior: str | None = None

    def __post_init__(self) -> None:
        require_field_types(self)
        if self.widths is not None and (not self.widths or min(self.widths) < 1):
            raise UsageError(f"Network widths must be positive numbers, not {self.widths}.")
        self._require_bounded_network()
        if self.steps is not None and self.steps < 0:
            raise UsageError(f"The number of steps must not be negative, not {self.steps}.")
        normal_residual(self.normals)
        if self.quality not in QUALITIES:
            raise UsageError(f"The quality must be one of {', '.join(QUALITIES)}, not {self.quality!r}.")
        for name, known in (("optimiser", OPTIMISERS), ("solver", SOLVERS)):
            if getattr(self, name) not in known:
                raise UsageError(f"The {name} must be one of {', '.join(known)}, not {getattr(self, name)!r}.")
        if self.search not in SEARCHES:
            raise UsageError(f"The search must be one of {', '.join(SEARCHES)}, not {self.search!r}.")
        if self.regularisers and not self.adaptive:
            raise UsageError(
                "smooth, fill and prior are for the default fit; they cannot be combined with widths, steps, another "
                "optimiser or another normal residual."
            )

    def _require_bounded_network(self, *, most_layers: int = 64, most_parameters: int = 2_000_000) -> None:
        """Refuse networks whose Jacobian fits into no memory; one of 2,000,000 parameters takes 16 MB for each row."""
        widths = self.widths or ()
        sizes = (3, *widths, 1)
        count = sum((into + 1) * out for into, out in pairwise(sizes))
        if len(widths) > most_layers or count > most_parameters:
            raise UsageError(
                f"The network may have at most {most_layers} layers and {most_parameters:,} parameters; "
                f"choose fewer or smaller widths."
            )

    @property
    def adaptive(self) -> bool:
        """Whether the default fit is used: no option was given that only the fit of one network has."""
        one = self.widths is not None or self.steps is not None
        return not one and self.optimiser == "gn" and self.normals == "vector"

    @property
    def fits_network(self) -> bool:
        """Whether the default fit's global field is a network: without curvature penalties, except in draft quality."""
        return self.adaptive and self.quality != "draft" and not self.regularisers

    @property
    def regularisers(self) -> tuple[Regulariser, ...]:
        """The curvature penalties."""
        return regularisers(self.smooth, self.fill, self.prior)

    @property
    def features(self) -> int:
        """Features of each local field."""
        return QUALITIES[self.quality]

    def steps_for(self, points: int, *, parameters: SingleNetworkParameters = SingleNetworkParameters()) -> int:
        """Return the most steps after the start, for a number of points.

        Below 1,000 points frequencies that follow the data fit it better and what lies between it worse (measured, see
        docs/research/2026-11-21-one-wide-layer.md), so that by default the exact linear solve is left as it is.
        """
        if self.adaptive:
            # One point in six is left out for validation.
            return network_steps(points - points // 6) if self.fits_network else 0
        if self.steps is not None:
            return self.steps
        if self.optimiser == "adam":
            return parameters.adam_steps
        if self.optimiser == "lbfgs":
            return parameters.lbfgs_steps
        if self.widths is not None and len(self.widths) > 1:
            return parameters.deep_steps
        return parameters.wide_steps if points >= parameters.least_points_to_refine else 0

    def widths_for(
        self, points: int, *, parameters: SingleNetworkParameters = SingleNetworkParameters()
    ) -> tuple[int, ...]:
        """Return the hidden layers for a number of points.

        Fewer units than data rows smooth dense clouds; more of them only make sparse ones slower and less smooth.
        """
        if self.widths is not None:
            return self.widths
        most = min(max(points // parameters.points_per_unit, parameters.most_sparse_units), parameters.most_units)
        return (min(max(parameters.units_per_point * points, parameters.least_units), most),)

    def as_dict(self) -> dict[str, Any]:
        """Return the options as plain values."""
        return asdict(self)


def normal_residual(name: str) -> Residual:
    """Return the residual of normals of a name: of this library, or of another package's ``gnrecon.residuals``.

    Raises
    ------
    UsageError
        When there is none, it cannot be loaded, or it needs second derivatives, which fits to scans do not have.
    """
    if name in NORMAL_RESIDUALS:
        return NORMAL_RESIDUALS[name]
    if find("residual", name) is None:
        known = [*NORMAL_RESIDUALS, *(one.entry.name for one in installed("residual"))]
        raise UsageError(f"The normal residual must be one of {', '.join(known)}, not {name!r}.")
    residual = named(name)
    if isinstance(residual, SecondOrder):
        raise UsageError(f"The residual {name!r} needs second derivatives, so that it cannot be that of normals.")
    return residual


def network_count(points: int, *, parameters: NetworkLadderParameters = NetworkLadderParameters()) -> int:
    """Return how many global networks are fitted to so many seen points; their mean is used."""
    return min(max(round(parameters.points_per_member / max(points, 1)), 1), parameters.most_members)


def network_starts(points: int, *, parameters: NetworkLadderParameters = NetworkLadderParameters()) -> int:
    """Return from how many starts the first width of a network is fitted; several networks have one each."""
    return parameters.starts if network_count(points, parameters=parameters) == 1 else 1


def network_steps(points: int, *, parameters: NetworkLadderParameters = NetworkLadderParameters()) -> int:
    """Return the most steps of all global networks of so many seen points."""
    lost = (network_starts(points, parameters=parameters) - 1) * parameters.trial_steps
    each = lost + 2 * parameters.first_steps + (len(parameters.widths) - 1) * parameters.steps
    return network_count(points, parameters=parameters) * each
