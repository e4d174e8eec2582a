"""The engine's benchmark at a tiny scale: both sides are what they are said to be, and ratios are of their parts."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.engine.cost_growth import OPERATIONS, CostSettings, exponent, measure_cost, width_for
from benchmarks.engine.large_steps import KernelSetting, MillionSetting, explicit_step, measure_million, our_step
from benchmarks.engine.measurements import MEASUREMENTS, NEEDS_DATA, Plan, merged
from benchmarks.engine.measurements import main as engine
from benchmarks.engine.our_fit import OnRecord, our_fit, solved_start, weights_at
from benchmarks.engine.paper_loss import Sample, data_loss, eikonal_error, posed, sphere
from benchmarks.engine.plain_baseline import Baseline, pretrained
from benchmarks.engine.presentation import draw, tables
from benchmarks.engine.step_time import Frozen, dense_steps, freeze, measure_solvers, measure_step
from benchmarks.engine.time_to_loss import Goal, History, compare, measure_quality, run_baseline, run_ours
from benchmarks.harness.measurement import Clock, run_isolated
from PIL import Image
from printed_tables import printed
from torch import Tensor

from gnrecon.field import Siren
from gnrecon.least_squares import SOLVERS, Cholesky, identity
from gnrecon.runtime.errors import GnreconError

NET = (8, 8)
GOAL = Goal("rockerarm-100", 1e-2, 1e-3)
SMALL = partial(
    Plan,
    kernel=KernelSetting((8, 8), points=30, volume=20),
    million=MillionSetting((8, 8), points=60, volume=20, damping=10.0, keep_bytes=0),
    cost=CostSettings((100, 300), (100, 300), fixed_points=50, matmul=64),
    our_seconds=0.2,
    cost_seconds=5.0,
)


@pytest.fixture(scope="module")
def sample() -> Sample:
    return sphere(120, 50)


@pytest.fixture(scope="module")
def frozen(sample: Sample) -> Frozen:
    return freeze(NET, sample, steps=3)


def random_theta(seed: int) -> Tensor:
    return Siren(NET).initial(torch.Generator().manual_seed(seed))


def text_of(report: dict[str, Any]) -> str:
    return printed(*tables(report))


@pytest.mark.parametrize("chunk", [None, 7])
def test_the_baselines_jacobian_is_ours(sample: Sample, chunk: int | None) -> None:
    theta = random_theta(int(np.random.default_rng().integers(1000)))
    baseline = Baseline(NET, sample, chunk)
    J = torch.cat([scale**0.5 * baseline.jacobian(r, theta, x, n) for scale, r, x, n in baseline.terms()])
    jacobian, residual = posed(Siren(NET), theta, sample).linearise(theta)
    torch.testing.assert_close(torch.cat([part.clone() for part in jacobian.dense()]), J)
    assert baseline.loss(theta) == pytest.approx(0.5 * float(residual @ residual))


def test_the_baselines_direction_is_the_dense_step(sample: Sample) -> None:
    theta = random_theta(1)
    exact = Cholesky().linearise(*posed(Siren(NET), theta, sample).linearise(theta), identity).solve(Baseline.damping)
    torch.testing.assert_close(-Baseline(NET, sample).direction(theta), exact.direction, rtol=1e-5, atol=1e-7)


def test_a_baseline_step_takes_the_best_of_its_trials(sample: Sample) -> None:
    theta, baseline = random_theta(2), Baseline(NET, sample)
    step = baseline.step(theta)
    losses = {2.0**-k: baseline.loss(theta - 2.0**-k * step.direction) for k in range(15)}
    best = min(losses, key=lambda length: losses[length])
    assert step.length == best
    assert step.loss == pytest.approx(losses[best])
    torch.testing.assert_close(step.theta, theta - best * step.direction)


def test_pretraining_comes_nearer_to_the_sphere() -> None:
    x = 2 * torch.rand(200, 3, dtype=torch.float64) - 1
    target = torch.linalg.vector_norm(x, dim=1) - 1
    errors = [float((Siren((32, 32)).value(pretrained((32, 32), k), x) - target).square().mean()) for k in (0, 300)]
    assert errors[1] < 0.1 * errors[0]


def test_our_start_is_better_than_a_random_one(sample: Sample) -> None:
    field = Siren(NET)
    assert data_loss(field, solved_start(field, sample), sample) < data_loss(field, random_theta(0), sample)


def test_a_steps_ratios_are_of_its_medians(frozen: Frozen) -> None:
    result = measure_step(frozen, repeat=3, steps=2)
    for side in ("baseline", "baseline_chunked", "ours"):
        assert result[side]["seconds"] == sorted(result[side]["all_seconds"])[1]
        first, last, count = result[side]["losses"][0], result[side]["losses"][-1], len(result[side]["losses"]) - 1
        assert (1 - result[side]["decrease"]) ** count == pytest.approx(last / first)
        assert first == pytest.approx(Baseline(NET, frozen.sample).loss(frozen.theta))
        assert last < first
    assert result["ratio"] == pytest.approx(result["baseline"]["seconds"] / result["ours"]["seconds"])
    assert result["ratio_chunked"] == pytest.approx(result["baseline_chunked"]["seconds"] / result["ours"]["seconds"])
    assert len(result["ours"]["losses"]) == 3
    assert result["rows"] == [120, 120, 50]


def history(seconds: list[float], losses: list[float]) -> History:
    return History(0.0, seconds, losses)


def test_a_goal_that_both_reach_gives_the_ratio_of_times() -> None:
    ours, baseline = history([0, 1, 2], [1, 9e-3, 1e-4]), history([0, 30, 60], [1, 0.1, 1e-2])
    result = compare(ours, baseline, GOAL, budget=100)
    assert result["ratio"] == 60
    assert not result["is_lower_bound"]
    assert result["ours_seconds_to_final"] == 2


@pytest.mark.parametrize(("last", "ratio"), [(130.0, 65.0), (50.0, 50.0)])
def test_a_goal_that_the_baseline_misses_gives_a_lower_bound(last: float, ratio: float) -> None:
    ours, baseline = history([0, 2], [1, 9e-3]), history([0, last], [1, 0.1])
    result = compare(ours, baseline, GOAL, budget=100)
    assert result["is_lower_bound"]
    assert result["baseline_seconds"] is None
    assert result["ratio"] == ratio
    assert result["ours_seconds_to_final"] is None
    assert ">= " in text_of({"quality": {"rockerarm": result}})


def test_a_goal_that_we_miss_gives_no_ratio() -> None:
    result = compare(history([0], [1]), history([0, 50], [1, 1e-3]), GOAL, budget=100)
    assert result["ratio"] is None
    assert "not reached" in text_of({"quality": {"rockerarm": result}})


def test_a_baselines_run_goes_down_and_ends(sample: Sample) -> None:
    theta = pretrained(NET, 20)
    losses = run_baseline(sample, NET, theta, budget=60.0, last=0.02).losses
    assert losses[-1] <= 0.02 < min(losses[:-1])
    assert len(run_baseline(sample, NET, theta, budget=0.0, last=0.0).losses) == 1


def test_our_run_ends_at_the_last_loss_and_its_losses_are_of_all_points(sample: Sample) -> None:
    thetas = [random_theta(seed) for seed in range(6)]
    losses = [data_loss(Siren(NET), theta, sample) for theta in thetas]
    least = int(np.argmin(losses))

    def fit(points: Tensor, normals: Tensor, seconds: float, on_record: OnRecord) -> None:
        del points, normals, seconds
        for number, theta in enumerate(thetas):
            on_record(float(number), theta)

    assert run_ours(sample, NET, fit, 1.0, last=losses[least]).losses == losses[: least + 1]


def test_our_fit_lowers_the_loss(sample: Sample) -> None:
    result = measure_quality(
        GOAL, sample, (32, 32, 32), partial(our_fit, widths=(32, 32, 32)), pretrained((32, 32, 32), 1), (1.0, 1e-6)
    )
    assert result["ours"]["losses"][-1] < 0.5 * result["ours"]["losses"][0]
    assert result["ours"]["seconds"] == sorted(result["ours"]["seconds"])
    assert result["is_lower_bound"]
    assert "full eikonal weight" in text_of({"quality": {"rockerarm": result}})


def test_the_eikonal_weight_falls_to_its_least_and_the_datas_do_not() -> None:
    weights = [weights_at(number) for number in range(1, 60)]
    assert {of_data for of_data, _, _ in weights} == {of_normals for _, of_normals, _ in weights} == {1.0}
    of_volume = [volume for _, _, volume in weights]
    assert of_volume[0] < 1e-2
    assert of_volume == sorted(of_volume, reverse=True)
    assert of_volume[-1] == 1e-4


def test_the_eikonal_error_is_a_mean_of_squares(sample: Sample) -> None:
    theta = random_theta(3)
    lengths = Siren(NET).value_and_gradient(theta, sample.volume)[1].norm(dim=1)
    assert eikonal_error(Siren(NET), theta, sample) == pytest.approx(float(((lengths - 1) ** 2).mean()))


def test_a_clock_does_not_count_its_pauses() -> None:
    clock = Clock()
    with clock.pause():
        sleep(0.2)
    assert clock.seconds < 0.1


def test_both_kernel_forms_make_the_same_step() -> None:
    problem = KernelSetting((8, 8), points=30, volume=20).problem()
    exact = Cholesky().linearise(*problem.linearise(problem.free()), identity).solve(1e-3).direction
    for form in (explicit_step, our_step):
        torch.testing.assert_close(form(problem, 1e-3), exact, rtol=1e-6, atol=1e-9)


def test_the_large_step_lowers_the_loss_in_memory_of_its_own(tmp_path: Path) -> None:
    held = np.ones(60_000_000)
    setting = MillionSetting((8, 8), points=60, volume=20, damping=10.0, keep_bytes=0)
    result = measure_million(setting, tmp_path)
    assert result["losses"][1] < result["losses"][0]
    assert result["rows"] == 140
    assert 0 < result["libraries_memory_mb"] <= result["peak_memory_mb"]
    assert result["peak_memory_mb"] - result["libraries_memory_mb"] < held.nbytes / 1e6
    assert result["within_8_gb"] == (result["peak_memory_mb"] <= 8000)
    assert MillionSetting().rows == 200_000


def test_a_failed_process_is_a_sentence(tmp_path: Path) -> None:
    assert "no_such" in run_isolated("benchmarks.engine.large_steps:no_such", {}, tmp_path / "a")["error"]


@pytest.mark.parametrize(("target", "tolerance"), [(1000, 0.1), (31_623, 0.02), (1_000_000, 0.01)])
def test_widths_give_the_parameters_asked_for(target: int, tolerance: float) -> None:
    count = Siren((width_for(target),) * 3).layout.count
    assert count == pytest.approx(target, rel=tolerance)


def test_an_exponent_is_a_slope_of_what_took_long_enough() -> None:
    assert exponent([1, 10, 100], [1e-9, 0.1, 10.0]) == pytest.approx(2.0)
    assert exponent([1, 10], [1e-9, 0.1]) is None


def test_growth_has_every_size_and_ends_with_its_time() -> None:
    settings = CostSettings((100, 200), (100, 300), fixed_points=50, matmul=64)
    cost = measure_cost(30.0, settings)
    for series in (cost["by_points"], cost["by_parameters"]):
        assert series.keys() == OPERATIONS.keys()
        assert all(len(growth["measured"]) == 2 for growth in series.values())
    entry = cost["by_points"]["gram"]["measured"][0]
    flops = entry["rows"] * entry["parameters"] * (entry["parameters"] + 1)
    assert (entry["rows"], entry["parameters"]) == (250, Siren(settings.widths).layout.count)
    rate = 1e9 * cost["matmul_gflops"]
    assert entry["share_of_matmul"] == pytest.approx(flops / entry["operation_seconds"] / rate)
    assert not measure_cost(0.0, CostSettings((100,), (), matmul=64))["by_points"]["gram"]["measured"]


def test_every_solver_is_compared_with_the_dense_step(frozen: Frozen) -> None:
    dampings = (1.0, 1e-2)
    result = measure_solvers(frozen, dense_steps(frozen, dampings), dampings)
    assert list(result["solvers"]) == list(SOLVERS)
    for name in ("cholesky", "qr", "row-space", "cg-sampled"):
        assert all(solve["difference"] < 1e-4 for solve in result["solvers"][name]["solves"]), name
    wrong = measure_solvers(frozen, [2 * step for step in dense_steps(frozen, dampings)], dampings, names=["cholesky"])
    assert wrong["solvers"]["cholesky"]["solves"][0]["difference"] == pytest.approx(0.5)


def test_reports_are_merged_in_depth() -> None:
    assert merged({"a": {"x": 1}, "b": 1}, {"a": {"y": 2}, "c": 3}) == {"a": {"x": 1, "y": 2}, "b": 1, "c": 3}


def test_without_data_the_rest_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "engine.json"
    assert engine(["--data", str(tmp_path), "--json", str(file), "--repeat", "1"], SMALL) == 0
    report = json.loads(file.read_text())
    made = report["kernel"]
    assert report["kernel_ratio_5x256"] == made["ratio"]
    for ratio, key in (("ratio", "seconds"), ("memory_ratio", "peak_memory_mb")):
        assert made[ratio] == pytest.approx(made["explicit"][key] / made["ours"][key])
    assert made["difference"] < 1e-6
    assert made["rows"] == 80
    assert {"kernel", "million", "cost"} == MEASUREMENTS.keys() - set(NEEDS_DATA) == MEASUREMENTS.keys() & report.keys()
    assert report["command"].startswith("./scripts/bench engine")
    shown = capsys.readouterr().out
    assert "left out: step, quality, solvers" in shown
    assert "large step" in shown


def test_steps_and_times_stand_at_the_top(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = {"rockerarm-100": True, "bunny-20": False}
    stand_ins: dict[str, Any] = {
        "scan": lambda case, _: sphere({"bunny-20": 40, "bunny-100": 60}.get(case, 20), 20),
        "pretrained": partial(pretrained, iterations=1),
        "freeze": partial(freeze, steps=1),
        "measure_step": partial(measure_step, steps=1),
        "measure_quality": lambda goal, *_: {"ratio": 25.0, "is_lower_bound": bounds[goal.case]},
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(f"benchmarks.engine.measurements.{name}", stand_in)
    plan = SMALL(tmp_path, tmp_path, 1, 0.1, widths=NET)
    found = merged(MEASUREMENTS["step"](plan), MEASUREMENTS["quality"](plan))
    for name, points in (("bunny_20", 40), ("bunny_100", 60)):
        assert found[f"step_ratio_{name}"] == found["step"][name]["ratio"]
        assert found["step"][name]["rows"] == [points, points, 20]
        assert f"step, {name}" in text_of({"step": found["step"]})
    assert found["time_ratio_rockerarm"] == found["time_ratio_bunny_20"] == 25.0
    assert found["time_ratio_rockerarm_is_lower_bound"]
    assert not found["time_ratio_bunny_20_is_lower_bound"]
    solved = MEASUREMENTS["solvers"](plan)
    assert all(name in text_of(solved) for name in SOLVERS)


def test_a_picture_has_a_panel_for_each_result(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    growth = {"exponent": 1.0, "measured": [{"size": size, "seconds": 1e-3 * size} for size in (10, 100)]}
    cost = {series: {"gram": growth, "kernel": growth | {"measured": []}} for series in ("by_points", "by_parameters")}
    quality = compare(history([0.1, 1], [1, 1e-3]), history([0.1, 60], [1, 1e-2]), GOAL, 100)
    draw({"cost": cost}, tmp_path / "a.png")
    draw({"cost": cost, "quality": {"rockerarm": quality}}, tmp_path / "b.png")
    with Image.open(tmp_path / "a.png") as growth, Image.open(tmp_path / "b.png") as both:
        assert both.size[0] == pytest.approx(1.5 * growth.size[0], abs=2)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--repeat", "0"], "must be positive"),
        (["--json", "nowhere/a.json"], "folder does not exist"),
        (["--only", "step", "--data", "nowhere"], "nowhere/rocker-arm.off"),
    ],
)
def test_what_cannot_be_done_is_refused_first(arguments: list[str], sentence: str) -> None:
    with pytest.raises(GnreconError, match=sentence):
        engine(arguments)
