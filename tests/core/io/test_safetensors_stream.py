"""Files of tensors that nobody holds whole are those that the library writes of whole ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from neuprim.core.io.safetensors_stream import storage_order, write_safetensors_stream

TENSORS = {
    "a": torch.arange(15, dtype=torch.float32).reshape(5, 3),
    "none": torch.zeros(5, 0),
    "ages": torch.arange(5),
    "bytes": torch.arange(7, dtype=torch.uint8),
    "flags": torch.tensor([True, False]),
    "number": torch.tensor(3.5, dtype=torch.float64),
}
KINDS = {name: (value.dtype, tuple(value.shape)) for name, value in TENSORS.items()}


def test_what_is_written_is_read_by_the_library(tmp_path: Path) -> None:
    asked = []

    def pieces(name: str) -> Iterator[torch.Tensor]:
        asked.append(name)
        value = TENSORS[name]
        yield from value.split(2) if value.dim() else [value]

    write_safetensors_stream(tmp_path / "x.safetensors", KINDS, {"key": '{"ä": 1}'}, pieces)
    found = load_file(tmp_path / "x.safetensors")
    assert found.keys() == TENSORS.keys() and asked == storage_order(KINDS)
    for name, value in TENSORS.items():
        assert found[name].dtype == value.dtype and torch.equal(found[name], value), name
    with safe_open(str(tmp_path / "x.safetensors"), framework="pt") as file:
        assert file.metadata() == {"key": '{"ä": 1}'}
        assert torch.equal(file.get_slice("a")[1:4], TENSORS["a"][1:4])


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        (torch.zeros(4, 3), r"a: 3 numbers are missing of \(5, 3\)"),
        (torch.zeros(6, 3), r"a: a chunk of 18 torch\.float32; expected torch\.float32, 15 at most"),
        (torch.zeros(5, 3, dtype=torch.float64), r"a: a chunk of 15 torch\.float64; expected torch\.float32"),
    ],
)
def test_pieces_that_are_not_what_was_announced_are_refused(piece: torch.Tensor, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        write_safetensors_stream(tmp_path / "x.safetensors", {"a": KINDS["a"]}, {}, lambda name: [piece])
