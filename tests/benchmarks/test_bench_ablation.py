"""The ablation: each part is known to the fit, changes what uses it, and its table says by how much."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.accuracy.ablation import WHOLE, ablation_table, main
from benchmarks.accuracy.comparison import Protocol
from benchmarks.accuracy.parts import PARTS
from printed_tables import printed

from gnrecon.fit.parameters import FitParameters
from gnrecon.runtime.errors import ExitCode


def test_each_part_is_left_out_by_parameters_of_its_own() -> None:
    assert all(one != FitParameters() for one in PARTS.values())
    assert len({repr(one) for one in PARTS.values()}) == len(PARTS)


@pytest.mark.usefixtures("measured_here")
def test_the_benchmark_writes_and_prints_what_a_part_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "ablation.json"
    tiny = Protocol(threads=1, samples=2000, options={"resolution": 24, "quality": "draft"})
    words = ["--cases", "sphere, 100 points", "--without", "ball", "--json", str(report)]
    assert main(words, tiny) == ExitCode.OK
    (case,) = json.loads(report.read_text())["cases"]
    whole, ball = (case["fits"][part] for part in (WHOLE, "ball"))
    assert "ball" in whole["status"]
    assert "ball" not in ball["status"]
    assert ball["chamfer_mean"] > 1.5 * whole["chamfer_mean"]
    assert f"{ball['chamfer_mean'] / whole['chamfer_mean']:.2f} / " in capsys.readouterr().out


def test_failures_are_told_and_unused_parts_leave_their_cells_empty() -> None:
    whole, worse = ({"chamfer_mean": mean, "hausdorff": 2 * mean} for mean in (0.001, 0.002))
    fits = {WHOLE: whole, "ball": whole, "holes": worse, "eikonal": {"error": "The fit failed."}}
    text = printed(ablation_table([{"case": "made", "unit": "radius", "factor": 1e3, "fits": fits}]))
    row = next(line for line in text.splitlines() if "made" in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells == ["made", "1.000 / 2.0", "", "2.00 / 2.00", "failed"]


def test_an_unknown_part_is_refused() -> None:
    with pytest.raises(SystemExit):
        main(["--without", "luck"])
