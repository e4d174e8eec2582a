"""Model files are checked whole: each damaged one is refused in one sentence when it is read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save

from gnrecon import NeuralSDF, reconstruct
from gnrecon.runtime.errors import InputError


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    normals = np.random.default_rng(0).normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path = tmp_path_factory.mktemp("model") / "good.gnr"
    reconstruct(normals * [1, 0.8, 0.6], normals, quality="draft", resolution=16).sdf.save(path)
    with safe_open(str(path), "pt") as file:
        return json.loads(file.metadata()["gnrecon"]), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def load(folder: Path, facts: str, tensors: dict[str, torch.Tensor]) -> NeuralSDF:
    (folder / "model.gnr").write_bytes(save({k: v.contiguous() for k, v in tensors.items()}, {"gnrecon": facts}))
    return NeuralSDF.load(folder / "model.gnr")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16, torch.int32, torch.bool, torch.complex64])
def test_types_that_no_fit_writes_are_refused(model: Any, tmp_path: Path, kind: torch.dtype) -> None:
    facts, tensors = model
    load(tmp_path, json.dumps(facts), tensors)
    for name, tensor in tensors.items():
        with pytest.raises(InputError, match=r"model\.gnr holds"):
            load(tmp_path, json.dumps(facts), tensors | {name: tensor.to(kind)})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [1e30, 1e-300, 0.0])
@pytest.mark.parametrize("name", ["frame.scale", "box", "support", "detail.lattice", "detail.noise", "detail.lengths"])
def test_sizes_out_of_range_are_refused(model: Any, tmp_path: Path, name: str, factor: float) -> None:
    facts, tensors = model
    with pytest.raises(InputError, match=r"model\.gnr holds"):
        load(tmp_path, json.dumps(facts), tensors | {name: tensors[name] * factor})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["theta", "frame.center", "detail.frequencies", "detail.amplitudes"])
@pytest.mark.parametrize("factor", [1e30, 1e290])
def test_numbers_that_are_no_distances_are_refused(model: Any, tmp_path: Path, name: str, factor: float) -> None:
    facts, tensors = model
    with pytest.raises(InputError, match=r"model\.gnr holds"):
        load(tmp_path, json.dumps(facts), tensors | {name: tensors[name].double() * factor})


def test_empty_and_missing_parts_are_refused(model: Any, tmp_path: Path) -> None:
    facts, tensors = model
    for name, tensor in tensors.items():
        with pytest.raises(InputError):
            load(tmp_path, json.dumps(facts), tensors | {name: tensor.reshape(-1)[:0]})
        if name != "support":
            with pytest.raises(InputError):
                load(tmp_path, json.dumps(facts), {key: value for key, value in tensors.items() if key != name})


@pytest.mark.parametrize(
    "change",
    [
        {"widths": []},
        {"widths": [0]},
        {"widths": [float("inf")]},
        {"widths": [10**400]},
        {"widths": "1000"},
        {"widths": [True]},
        {"options": None},
        {"options": {"smooth": {"a": [1]}}},
        {"options": {"seed": "x"}},
        {"options": {"seed": 10**30}},
        {"format": "other"},
    ],
)
def test_facts_that_no_fit_writes_are_refused(model: Any, tmp_path: Path, change: dict[str, Any]) -> None:
    facts, tensors = model
    with pytest.raises(InputError):
        load(tmp_path, json.dumps(facts | change), tensors)


def test_lists_in_lists_are_refused(model: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a gnrecon model"):
        load(tmp_path, "[" * 100_000, model[1])
