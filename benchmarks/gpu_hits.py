"""What a hit costs on a card, counted without one: instructions, operations and bytes, and the time that they take at
full issue.

    python benchmarks/gpu_hits.py [--count 100000] [--size 800] [--neurons 8 2 0] [--nvdisasm FILE] [--record |
    --from-record]

The rule. *Instructions* are those of the innermost loop that draws hits, as compiled for sm_90 and listed by nvdisasm,
every branch of the loop counted once; neurons take the polynomial up to half a turn, and what one beyond that takes
more is counted apart. *Operations* are those of its FFMA (two), FMUL and FADD. *Lanes* are the share of a warp's
threads that draw a hit while it is in the loop: a frame of the random scene of the other benchmarks, drawn on Warp's
CPU blocks, says how many warps enter it. *At full issue* is the time of instructions times warps at an instruction a
cycle of every
lane of an H100; what is done once a pair or a pixel is not in it, and what was measured stands beside it.

--record        writes benchmarks/results/gpu_hits.json and the table in docs/gpu.md
--from-record   writes the table from the file and measures nothing

Needs nvdisasm: pip install nvidia-cuda-nvdisasm.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp
from shared.cubins import compiled
from shared.sass import find_nvdisasm, flops, hot_loop, listed
from shared.scenes import lower, random_scene, view
from shared.tables import ROOT, Table, between_markers

from neuprim.core.compute.warp import wp
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cuda import backend, backward_pairs, forward, functions, passes
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.forms import Form

RESULTS = Path(__file__).parent / "results" / "gpu_hits.json"
CARD = Path(__file__).parent / "results" / "gpu" / "nvidia_h100_80gb_hbm3.json"
PAGE = ROOT / "docs" / "gpu.md"
ARCH = 90
RATE = 132 * 128 * 1.98e9
"""Instructions a second of all lanes of an H100: multiprocessors, lanes of each, clock."""

FORMS = {8: 0, 2: 2, 0: 2}
"""Neurons -> edge, those of benchmarks/gpu.py."""

MEASURED = {"forward": "forward", "pixels": "backward_pixels", "pairs": "backward_pairs"}
"""Kernel -> its name in the record of a card."""

STUDY = {"forward": 350, "pairs": 780}
"""Instructions of a hit with 8 neurons in the study that the kernels were planned by."""

Row = dict[str, Any]


def _slow_bands(edge: int) -> tuple[Any, Any]:
    """:func:`~neuprim.core.render.cuda.functions.band_of` of neurons below half a turn."""
    low, high = functions._B[edge], functions._B[edge + 1]

    @wp.func
    def value(v: float):  # type: ignore[no-untyped-def]
        return low(v * v)

    @wp.func
    def pair(v: float):  # type: ignore[no-untyped-def]
        y = v * v
        return wp.vec2(low(y), high(y))

    return value, pair


def _kernels(form: Form) -> dict[str, tuple[Any, int, str]]:
    """Name -> (kernel, threads of a block, an instruction that its loop over hits has most of)."""
    return {
        "forward": (forward.forward_kernel(form, True, False), L.PIXELS, "FFMA"),
        "pixels": (passes.pixels_kernel(form, False), L.PIXELS, "FFMA"),
        "pairs": (backward_pairs.pairs_kernel(form, False), L.WARP, "FFMA"),
    }


def _clear() -> None:
    for made in (forward.forward_kernel, backward_pairs.pairs_kernel):
        made.cache_clear()


def instructions(neurons: int, nvdisasm: str) -> dict[str, Row]:
    """Of each kernel's loop."""
    form, found = Form(neurons, FORMS[neurons], 3, -1), {}
    genuine = functions.band_of
    counted: dict[bool, dict[str, tuple[Any, int]]] = {}
    for slow in (False, True):
        forward.band_of = backward_pairs.band_of = _slow_bands if slow else genuine
        _clear()
        try:
            with tempfile.TemporaryDirectory() as place:
                counted[slow] = {
                    name: hot_loop(listed(nvdisasm, compiled(kernel, ARCH, block, Path(place) / name)), most)
                    for name, (kernel, block, most) in _kernels(form).items()
                }
        finally:
            forward.band_of = backward_pairs.band_of = genuine
            _clear()
    for name, (loop, _) in counted[True].items():
        faster = (counted[False][name][0].total() - loop.total()) / max(neurons, 1)
        found[name] = {
            "instructions": loop.total(), "flops": flops(loop), "faster_neuron": round(faster),
        }  # fmt: skip
    return found


@dataclass(frozen=True)
class Lanes:
    """Of a frame.

    Attributes:
        hits, slots, pairs: how many there are.
        patches: times that a warp of 8 x 4 pixels enters the forward loop for a primitive.
        steps: times that a warp takes 32 slots of a pair.
    """

    hits: int
    slots: int
    pairs: int
    patches: int
    steps: int


def _observed(lowered: Lowered, size: int) -> tuple[Any, Any]:
    """A frame and what its forward pass kept, on CPU blocks."""
    kept: list[tuple[Any, Any]] = []
    genuine: Callable[..., Any] = backend.forward

    def watched(frame: Any, *rest: Any) -> Any:
        drawn = genuine(frame, *rest)
        kept.append((frame, drawn))
        return drawn

    backend.forward = watched
    try:
        render_lowered(lowered, view(size), RenderSettings(backend="cuda", device="cpu"))
    finally:
        backend.forward = genuine
    return kept[0]


def lanes(count: int, size: int, neurons: int) -> Lanes:
    low = lower(random_scene(count))
    d, c = low.density, low.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    own = Cosine(d.W1[:, :neurons], d.b1[:, :neurons], d.w2[:, :neurons], d.b2, 1.0, FORMS[neurons])
    settings = RenderSettings()
    frame, drawn = _observed(Lowered(low.geometry, own, c), size)
    alpha, before = drawn.hits.unbind(1)
    spans = drawn.spans.int() & 0xFFFF
    counts = drawn.offsets.diff()
    starts = spans >> 8
    rows = (
        torch.cat([starts[:, 1:], counts[:, None]], 1) - starts
    )  # pixels of each row of a pair; rows without any end where they begin
    which = torch.repeat_interleave(torch.arange(rows.numel(), dtype=torch.int32), rows.reshape(-1).clamp_min(0))
    pair, y = which // L.TILE, which % L.TILE
    x = (
        (spans.reshape(-1)[which] & 15)
        + torch.arange(len(which), dtype=torch.int32)
        - drawn.offsets[pair]
        - starts.reshape(-1)[which]
    )
    assert len(which) == len(alpha) and int(x.min()) >= 0 and int(x.max()) < L.TILE
    patch = pair * 8 + (y // 4) * 2 + x // 8
    entered = torch.bincount(patch[before >= settings.transmittance_min], minlength=1) > 0
    reached = torch.arange(len(counts)) < drawn.reached[frame.lists.tile_of.long()]
    steps = ((counts[reached] + L.WARP - 1) // L.WARP).sum()
    return Lanes(int((alpha > 0).sum()), len(alpha), len(counts), int(entered.sum()), int(steps))


def predicted(name: str, loop: Row, seen: Lanes) -> tuple[float, float]:
    """Share of lanes that hit, and the milliseconds at full issue."""
    warps = seen.patches if name != "pairs" else seen.steps
    return seen.hits / (L.WARP * warps), 1e3 * L.WARP * loop["instructions"] * warps / RATE


def document(record: dict[str, Any]) -> str:
    """The table of docs/gpu.md."""
    head = [
        "form",
        "kernel",
        "instructions a hit",
        "and a faster neuron",
        "operations",
        "lanes",
        "ms at full issue",
        "measured ms",
    ]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " --- |" * (len(head) - 1)]
    for row in record["rows"]:
        faster = str(row["faster_neuron"]) if row["neurons"] and row["kernel"] != "pixels" else "–"
        measured = "–" if row["measured_ms"] is None else f"{row['measured_ms']:.2f}"
        cells = [
            f"K={row['neurons']} p={row['edge']}", row["kernel"], row["instructions"], faster, row["flops"], f"{row['lanes']:.2f}",
            f"{row['full_issue_ms']:.2f}", measured,
        ]  # fmt: skip
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    s = record["scene"]
    said = (
        f"{s['count']:,} primitives at {s['size']} × {s['size']}: {s['hits']:,} hits in {s['slots']:,} slots of {s['pairs']:,} pairs; what forward keeps "
        f"of them for backward is {(8 * s['slots'] + 36 * s['pairs']) / 1e6:.0f} MB. Warp {record['warp']}, sm_{record['arch']}; measured on the H100 that "
        "the record names, before kernels took the instructions that stand here."
    )
    return f"{said}\n\n" + "\n".join(lines)


def _measured(neurons: int, kernel: str) -> float | None:
    """Milliseconds of a kernel on the recorded card; None where it was not timed."""
    if not CARD.exists():
        return None
    spent: dict[str, float] = json.loads(CARD.read_text()).get("kernels", {}).get(f"K={neurons} p={FORMS[neurons]}", {})
    return next((ms for label, ms in spent.items() if MEASURED[kernel] in label), None)


def measure(count: int, size: int, neurons: list[int], nvdisasm: str) -> dict[str, Any]:
    table, rows = (
        Table("neurons", "kernel", "instructions", "operations", "lanes", "ms at full issue", "measured ms"),
        [],
    )
    scene: Row = {}
    for K in neurons:
        seen = lanes(count, size, K)
        scene = scene or {"count": count, "size": size, "hits": seen.hits, "slots": seen.slots, "pairs": seen.pairs}
        for name, loop in instructions(K, nvdisasm).items():
            share, full = predicted(name, loop, seen)
            row = {
                "neurons": K, "edge": FORMS[K], "kernel": name, **loop, "lanes": share, "full_issue_ms": full, "measured_ms": _measured(K, name),
            }  # fmt: skip
            rows.append(row)
            table.row(K, name, loop["instructions"], loop["flops"], f"{share:.2f}", f"{full:.3f}", row["measured_ms"])
    return {"warp": warp.__version__, "arch": ARCH, "scene": scene, "rows": rows}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--neurons", nargs="*", type=int, choices=list(FORMS), default=list(FORMS))
    parser.add_argument("--nvdisasm", default=find_nvdisasm())
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--record", action="store_true")
    what.add_argument("--from-record", action="store_true")
    args = parser.parse_args()
    if args.from_record:
        between_markers(PAGE, "gpu-hits", document(json.loads(RESULTS.read_text())))
        return 0
    if args.nvdisasm is None:
        print("nvdisasm is missing: pip install nvidia-cuda-nvdisasm, or name one with --nvdisasm", file=sys.stderr)
        return 1
    record = measure(args.count, args.size, args.neurons, args.nvdisasm)
    if args.record:
        RESULTS.write_text(json.dumps(record, indent=1) + "\n")
        between_markers(PAGE, "gpu-hits", document(record))
    return 0


if __name__ == "__main__":
    sys.exit(main())
