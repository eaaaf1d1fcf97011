"""No bit of a frame depends on which block comes first, how many rows are read at a time, or what was in memory
before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.compute import warp
from neuprim.core.render.cuda import backward, binning, colour_net, forward, prepare, prepare_backward
from neuprim.core.render.cuda import layout as L
from tests.core.render.cuda.frames import SCENES, Args, Launch, assert_same_bits, everything, intercept


@pytest.fixture(scope="module")
def plain() -> dict[str, dict[str, Tensor]]:
    return {name: everything(name) for name in SCENES}


@pytest.mark.parametrize("name", SCENES)
def test_a_rerun_gives_the_same_bits(name: str, plain: dict[str, dict[str, Tensor]]) -> None:
    assert_same_bits(plain[name], everything(name))
    assert (
        plain[name]["alpha"].max() > 0.5 and plain[name]["means"].abs().max() > 0 and plain[name]["weight"].max() > 0.5
    )


def _alone(starts: Tensor, tile: int) -> Tensor:
    """Lists of which this tile's alone is not empty."""
    return torch.where(torch.arange(len(starts)) <= tile, starts[tile], starts[tile + 1])


def _only(reached: Tensor, tile: int) -> Tensor:
    """Pairs composited, as if those of all other tiles were none."""
    return torch.where(torch.arange(len(reached)) == tile, reached, 0).int()


def _tile_by_tile(
    launch: Launch, kernel: Any, dim: Any, inputs: Sequence[Any], device: torch.device, block: int
) -> None:
    """Tiles one at a time, the last first: what a launch leaves of the others is thrown away."""
    args = Args(kernel, inputs)
    if "starts" in args and "reached" in args:
        starts = args.tensor("starts")
        size = args.values[args.names.index("size")]
        across, pixels = -(-size[0] // L.TILE), torch.arange(size[0] * size[1])
        tile_of = (pixels // size[0] // L.TILE) * across + pixels % size[0] // L.TILE
        for tile in reversed(range(len(starts) - 1)):
            # slots belong to pairs, and empty lists have none: only what pixels and tiles get needs a copy
            if "keys" in args:
                copies = {n: args.tensor(n).clone() for n in ("rgb", "transmittance", "zsum", "reached")}
                launch(kernel, dim, args.with_tensors(starts=_alone(starts, tile), **copies), device, block)
            else:
                copies = {}
                launch(
                    kernel,
                    dim,
                    args.with_tensors(starts=_alone(starts, tile), reached=_only(args.tensor("reached"), tile)),
                    device,
                    block,
                )
            for name, copy in copies.items():
                own = torch.arange(len(copy)) == tile if name == "reached" else tile_of == tile
                if len(copy):
                    args.tensor(name)[own] = copy[own]
    elif "reached" in args and "out" in args and dim[0] == len(args.tensor("ids")):
        tiles, reached = args.tensor("tiles"), args.tensor("reached")
        out = args.tensor("out").view(len(tiles), -1)
        for tile in reversed(range(len(reached))):
            copy = torch.full_like(out, torch.nan)
            launch(kernel, dim, args.with_tensors(reached=_only(reached, tile), out=copy.view(-1)), device, block)
            out[tiles == tile] = copy[tiles == tile]
    else:
        launch(kernel, dim, inputs, device, block)


@pytest.mark.parametrize("name", SCENES)
def test_tiles_may_come_in_any_order(
    name: str, plain: dict[str, dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each as if it were alone, the last first."""
    met = []

    def wrapped(launch: Launch, kernel: Any, *rest: Any) -> None:
        met.append(kernel.key.partition("__")[0])
        _tile_by_tile(launch, kernel, *rest)

    intercept(monkeypatch, wrapped)
    assert_same_bits(plain[name], everything(name))
    assert {"forward_kernel", "pairs_kernel"} <= set(met)


@pytest.mark.parametrize(
    ("threads", "name"), [(32, "center, depth"), *((96, name) for name in SCENES), (512, "colour networks")]
)
def test_blocks_may_be_of_any_size(
    threads: int, name: str, plain: dict[str, dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a block is a number of threads; it is a tile, or a warp, in kernels that work together, and these have one
    size."""
    changed, together = set(), set()

    def through(kernel: Any, dim: Any, inputs: Sequence[Any], device: torch.device, block: int = warp.BLOCK) -> None:
        called = kernel.key.partition("__")[0]
        one = isinstance(dim, Sequence) and len(dim) == 2 and dim[1] == block
        (together if one else changed).add(called)
        warp.launch_kernel(kernel, dim, inputs, device, block if one else threads)

    for module in (binning, prepare, colour_net, forward, backward, prepare_backward):
        monkeypatch.setattr(module, "launch_kernel", through)
    assert_same_bits(plain[name], everything(name))
    assert {"row_spans", "sum_pairs", "_binning_kernels", "_prepare_backward_kernel"} <= changed
    assert {"forward_kernel", "pairs_kernel"} <= together


@pytest.mark.parametrize("name", SCENES)
def test_what_is_read_was_written(
    name: str, plain: dict[str, dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory that kernels fill is full of NaN, and of whole numbers far off, before them."""
    genuine, filled = torch.empty, []

    def poisoned(*args: Any, **kwargs: Any) -> Tensor:
        made = genuine(*args, **kwargs)
        if made.is_floating_point():
            filled.append(made.numel())
            return made.fill_(torch.nan)
        return made.fill_(77 if made.element_size() == 1 else -12345)

    class Torch:
        empty = staticmethod(poisoned)

        def __getattr__(self, name: str) -> Any:
            return getattr(torch, name)

    for module in (forward, backward, binning, prepare, colour_net):
        monkeypatch.setattr(module, "torch", Torch())
    assert_same_bits(plain[name], everything(name))
    assert sum(filled) > 10000


# ---------------------------------------------------------------- the launch


def test_blocks_that_are_single_threads_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the flag Warp runs a block on the processor as one thread, and says nothing."""
    monkeypatch.setattr(warp.wp.config, "enable_cpu_blocks", False)
    with pytest.raises(RuntimeError, match="enable_cpu_blocks was turned off"):
        everything("center, depth", 3)
