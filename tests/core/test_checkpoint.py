"""Files that are damaged, foreign or hostile: refused by name, quickly, and nothing in them runs."""

from __future__ import annotations

import errno
import json
import os
import struct
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from neuprim.core import checkpoint
from neuprim.core.errors import CheckpointError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.tasks.static import TASK, SphericalHarmonics
from tests import scenes


def model(neurons: int = 3, degree: int = 1) -> Primitives:
    t = scenes.tensors(5, neurons)
    params = {k: v for k, v in t.items() if k != "colors"} | {"sh_dc": t["colors"]}
    if degree:
        params["sh_rest"] = torch.randn(5, (degree + 1) ** 2 - 1, 3)
    return Primitives(CosineDensity(neurons), SphericalHarmonics(degree), params)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "a folder" / "model.safetensors"
    checkpoint.save_model(path, model(), "static", {"background": [0.0, 0.5, 1.0], "note": "naïve"})
    return path


def refused(path: Path, task: TaskSpec = TASK) -> str:
    """The message with which a model is refused, which names the file; within a second of computing, whatever else the
    machine does."""
    start = time.thread_time()
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load_model_checkpoint(path, task)
    assert time.thread_time() - start < 1.0
    assert str(path) in str(caught.value)
    return str(caught.value)


def rewrite(
    path: Path, header: dict[str, Any] | str | None = None, tensors: dict[str, Tensor] | None = None, **changes: Any
) -> None:
    """The saved model with another header or other tensors."""
    old, values = checkpoint.read_tensors(path, "model")
    text = header if isinstance(header, str) else json.dumps({**old, **(header or {}), **changes})
    save_file({**values, **(tensors or {})}, str(path), metadata={"neuprim": text})


# ---------------------------------------------------------------- what is whole


def test_round_trip(saved: Path) -> None:
    again, header = checkpoint.load_model_checkpoint(saved, TASK)
    torch.manual_seed(0)
    first = checkpoint.read_tensors(saved, "model")[1]
    assert list(again.params) == [s.name for s in again.specs]
    assert all(torch.equal(first[k], v) for k, v in again.params.items())
    assert isinstance(again.density, CosineDensity) and again.density.neurons == 3
    assert isinstance(again.colour, SphericalHarmonics) and again.colour.degree == 1
    assert header["background"] == [0.0, 0.5, 1.0] and header["note"] == "naïve" and header["primitives"] == 5
    assert sys.platform == "win32" or saved.stat().st_mode & 0o777 == 0o666 & ~_umask()
    assert [p.name for p in saved.parent.iterdir()] == ["model.safetensors"]


def _umask() -> int:
    old = os.umask(0)
    os.umask(old)
    return old


# ---------------------------------------------------------------- what belongs elsewhere


def test_another_task(saved: Path) -> None:
    rewrite(saved, task="relight")
    assert "'relight'" in refused(saved) and "'static'" in refused(saved)


@pytest.mark.parametrize(
    "entry",
    [
        None, [], "CosineDensity", {"class": "CosineDensity"}, {"class": 3, "settings": {}},
        {"class": "CosineDensity", "settings": []},
        *({"class": "CosineDensity", "settings": s} for s in (
            {"neurons": 10**9}, {"neurons": -1}, {"neurons": 2**70}, {"neurons": 1e9}, {"neurons": 2.5},
            {"neurons": None}, {"neurons": "3"},
            {"neurons": [3]}, {"neurons": {}}, {"width": 3}, {"neurons": 4}, {"self": 3},
        )),
    ],
    ids=lambda e: json.dumps(e)[:60],
)  # fmt: skip
def test_absurd_density_settings(saved: Path, entry: Any) -> None:
    rewrite(saved, density=entry)
    refused(saved)


# ---------------------------------------------------------------- tensors that do not fit


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_tensors_that_are_not_finite(saved: Path, value: float) -> None:
    w2 = torch.zeros(5, 3)
    w2[2, 1] = value
    rewrite(saved, tensors={"w2": w2})
    assert "w2" in refused(saved)


# ---------------------------------------------------------------- writing


def test_a_full_disk_leaves_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def full(tensors: dict[str, Tensor], name: str, metadata: dict[str, str]) -> None:
        Path(name).write_bytes(b"partial")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "save_file", full)
    with pytest.raises(CheckpointError, match="No space left on device") as caught:
        checkpoint.save_model(saved, model(2), "static", {})
    assert str(saved) in str(caught.value)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_a_header_that_claims_terabytes(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in (2**40, 2**63, 2**64 - 1):
        saved.write_bytes(struct.pack("<Q", length) + whole[8:])
        refused(saved)
    huge = json.dumps(
        {
            "means": {"dtype": "F32", "shape": [2**38, 3], "data_offsets": [0, 3 * 2**40]},
            "__metadata__": {"neuprim": "{}"},
        }
    ).encode()
    saved.write_bytes(struct.pack("<Q", len(huge)) + huge + b"\0" * 64)
    refused(saved)
    overflow = json.dumps({"means": {"dtype": "F32", "shape": [2**62, 2**62], "data_offsets": [0, 64]}}).encode()
    saved.write_bytes(struct.pack("<Q", len(overflow)) + overflow + b"\0" * 64)
    refused(saved)
