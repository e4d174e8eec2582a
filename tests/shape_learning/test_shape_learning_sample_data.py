"""The script that makes the sample problem makes the files that are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from make_sample_design import main

from gnrecon.io import read_mesh


def test_the_script_makes_the_files_that_are_there(repository: Path, tmp_path: Path) -> None:
    main(tmp_path)
    for name in ("design_region.stl", "design_interfaces.stl"):
        made, there = read_mesh(tmp_path / name), read_mesh(repository / "sample_data" / name)
        assert (repository / "sample_data" / name).stat().st_size < 200_000
        np.testing.assert_allclose(made.vertices, there.vertices, atol=1e-4)
        assert (made.faces == there.faces).all()
