"""Numbers that no machine can serve are refused before the work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gnrecon.batch.job import JobOutcome, Status
from gnrecon.batch.summary import summary_csv
from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.files import printable


@pytest.mark.parametrize(
    "values",
    [
        {"threads": 2000},
        {"widths": (1_000_000_000,)},
        {"widths": (2,) * 65},
        {"resolution": 10**30},
        {"seed": 10**5000},
        {"faces": 10**30},
        {"read_points": 10**30},
        {"steps": 10**30},
        {"max_error": 1e-300},
        {"edge_length": 1e300},
        {"remesh": 1e-200},
    ],
)
def test_absurd_values(values: dict[str, Any]) -> None:
    with pytest.raises(UsageError) as error:
        Options(**values)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize("values", [{"remesh": 1e-9}, {"max_error": 1e-12}])
def test_lengths_too_short_for_the_scan(values: dict[str, Any]) -> None:
    options = Options(**values)
    options.require_reachable(np.array([[0.0] * 3, [1e-6] * 3]))
    with pytest.raises(UsageError, match="give --"):
        options.require_reachable(np.array([[0.0] * 3, [100.0] * 3]))


def test_names_are_no_formulas_and_need_not_be_text() -> None:
    lines = summary_csv([JobOutcome("=1+1", "-scan.ply", Status.FAILED)]).splitlines()
    assert lines[1].startswith("'=1+1,'-scan.ply,")
    assert printable("a\udcff.ply") == "a\\udcff.ply"
