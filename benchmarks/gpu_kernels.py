"""What every kernel of the CUDA backend takes of a card, compiled ahead of time on any machine: registers, stack,
shared memory, code.

    python benchmarks/gpu_kernels.py [--archs 80 89 90] [--forms "K=8 p=0" ...] [--kernels forward ...] [--record |
    --check | --print [--docs]]

Compiled are the kernels of K = 0, 2, 8 and 16 neurons, hard edges and p = 2, with constant colours and with colour
networks of 8 units, those that every frame needs, and those beside frames: of training and lights. No
driver is needed. A stack of a frame's kernel means spilled registers, but for kernels in float64, which keep their
neurons there; one at K <= 8 exits with status 1. Beside frames it means lists of arguments (Adam) and cosines of large
angles (grid). "Capped" are kernels that ask for fewer registers than they could use, as more warps hide more.

--record   writes benchmarks/results/gpu_kernels.json and the table in docs/results/gpu.md
--check    compares with what is recorded there: exits with status 1 when registers, stack or shared memory have grown
--print    compiles nothing and prints the recorded table; --docs writes it
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import warp
from shared.arguments import make_parser
from shared.cubins import compile_kernel, read_resources
from shared.tables import RESULT_PAGES, RESULTS, Table, between_markers, make_table, read_record

from neuprim.core.compute.warp import BLOCK
from neuprim.core.model import colours_warp
from neuprim.core.render.cuda import backward, binning, colour_net, float64, forward, prepare, prepare_backward, slots
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.layout import KernelForm
from neuprim.core.render.cuda.projection import PER_BLOCK
from neuprim.core.train import kernels_warp

RECORD = RESULTS / "gpu_kernels.json"
PAGE = RESULT_PAGES / "gpu.md"
ARCHS = (80, 89, 90)
EVERY, BESIDE = "every frame", "beside frames"
NET = ", H=8"
FORMS = {
    f"K={K} p={p}{NET if H > 0 else ''}": KernelForm(K, p, 3, H) for H, K, p in product((-1, 8), (0, 2, 8, 16), (0, 2))
}
UNSPILLED, IN_FLOAT64 = 8, "float64"
"""Neurons up to which no kernel may spill, other than those with this in their name."""

Row = dict[str, Any]


def kernels(name: str) -> Iterator[tuple[str, Any, int]]:
    """(name, kernel, threads of a block) of a form, or of every frame."""
    if name == EVERY:
        yield "prepare", prepare.project_primitives_kernel(False), PER_BLOCK
        yield "prepare, backward", prepare_backward._prepare_backward_kernel(False), PER_BLOCK
        yield "rows in float64", prepare.wide_kernel(False), PER_BLOCK
        yield "network units", colour_net._colour_net_kernels(False)[0], PER_BLOCK
        yield "emit", binning._binning_kernels(True)[0], PER_BLOCK
        yield "list", binning._binning_kernels(True)[1], BLOCK
        yield "spans", slots.row_spans, BLOCK
        yield "sums", backward.sum_pairs, BLOCK
        yield "float64 pairs", float64.float64_opacity_kernel(False), L.WARP
        return
    if name == BESIDE:
        for title, made in (
            ("harmonics", colours_warp._harmonic_kernels(3)),
            ("Adam", (kernels_warp.check_adam_gradient, kernels_warp.take_adam_step)),
            ("SSIM", kernels_warp.ssim_loss_kernels()),
        ):
            for number, kernel in enumerate(made, 1):
                yield f"{title} {number}" if len(made) > 1 else title, kernel, BLOCK
        return
    form = FORMS[name]
    yield "forward", forward.forward_kernel(form, True, False), L.PIXELS
    yield "pixels", backward.pixels_kernel(form, False), L.PIXELS
    if form.hidden > 0:
        yield "network pairs", colour_net.rasterizer_net_gradient_kernel(form), L.WARP
        return
    yield "pairs", backward.pairs_kernel(form, False), L.WARP
    yield "composite by entry", forward.composite_kernel(form, False), BLOCK
    yield "uncomposite by entry", backward.uncomposite_kernel(form, False), BLOCK
    yield "float64 pairs, backward", float64.float64_pairs_kernel(form, False), L.WARP


def measure(archs: list[int], forms: list[str], names: list[str] | None = None) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as place:
        for form, arch in product(forms, archs):
            for kernel, compiles, block in kernels(form):
                if names is None or kernel in names:
                    found = read_resources(compile_kernel(compiles, arch, block, Path(place, form, kernel, str(arch))))
                    capped = compiles.options.get("launch_bounds") is not None
                    row = {"form": form, "kernel": kernel, "arch": arch, "threads": block, "capped": capped}
                    yield row | asdict(found)


def spilled(rows: list[Row]) -> list[str]:
    return [
        f"{r['form']}: {r['kernel']} spills on sm_{r['arch']}: {r['stack']} bytes of stack"
        for r in rows
        if r["stack"]
        and r["form"] != BESIDE
        and IN_FLOAT64 not in r["kernel"]
        and (r["form"] == EVERY or FORMS[r["form"]].neurons <= UNSPILLED)
    ]


def grown(rows: list[Row], recorded: list[Row]) -> list[str]:
    """What takes more than it did, or is not in the record."""
    before = {(r["form"], r["kernel"], r["arch"]): r for r in recorded}
    found = []
    for row in rows:
        old = before.get((row["form"], row["kernel"], row["arch"]))
        where = f"{row['form']}: {row['kernel']} on sm_{row['arch']}"
        if old is None:
            found.append(f"{where} is not recorded")
            continue
        found += [
            f"{where}: {key} {old[key]} -> {row[key]}"
            for key in ("registers", "stack", "shared")
            if row[key] > old[key]
        ]
    return found


def document(record: dict[str, Any]) -> str:
    """The table of docs/results/gpu.md: registers of the hot kernels, with the stack where there is any."""
    found = {(r["form"], r["kernel"], r["arch"]): r for r in record["kernels"]}

    def cell(form: str, kernel: str) -> str:
        rows = [found[form, kernel, arch] for arch in ARCHS if (form, kernel, arch) in found]
        texts = [
            str(r["registers"]) + (f" + {r['stack']} B" if r["stack"] else "") + (" capped" if r["capped"] else "")
            for r in rows
        ]
        return texts[0] if len(set(texts)) == 1 else " / ".join(texts)

    columns = ("forward", "pixels", "pairs", "network pairs")
    table = Table("form", *columns)
    for form in FORMS:
        table.row(form, *(cell(form, kernel) for kernel in columns))
    shared = max(r["shared"] for r in record["kernels"])
    most = max((r for r in record["kernels"] if r["form"] == EVERY), key=lambda r: r["registers"])
    return (
        f"Registers a thread on sm_{' / '.join(str(a) for a in ARCHS)}, one number where they agree, with bytes of "
        f'stack where registers spill, "capped" where a kernel asks for fewer than it could use; C = 3 channels, H = 8 '
        f"units of a colour network. Of the kernels that every frame needs {most['kernel']} takes the most, "
        f"{most['registers']}; no block has more than {shared:,} bytes of shared memory. Compiled with Warp "
        f"{record['warp']}.\n\n{table}"
    )


def main() -> int:
    parser = make_parser(__doc__, "--docs")
    parser.add_argument("--archs", nargs="*", type=int, choices=ARCHS, default=list(ARCHS))
    parser.add_argument("--forms", nargs="*", choices=(*FORMS, EVERY, BESIDE), default=[*FORMS, EVERY, BESIDE])
    parser.add_argument("--kernels", nargs="*", help="of the forms, those of these names alone")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--record", action="store_true")
    what.add_argument("--check", action="store_true")
    what.add_argument("--print", action="store_true", dest="only_print", help="run nothing")
    args = parser.parse_args()
    if args.record and (args.kernels is not None or len(args.forms) < len(FORMS) + 2 or len(args.archs) < len(ARCHS)):
        parser.error("--record: expected every form, kernel and architecture")
    if args.only_print:
        text = document(read_record(RECORD))
        if args.docs:
            between_markers(PAGE, "gpu-kernels", text)
        return 0
    rows: list[Row] = []
    keys = ("form", "kernel", "arch", "threads", "capped", "registers", "stack", "shared", "code")
    columns = {key: itemgetter(key) for key in keys}
    make_table(columns, (rows.append(row) or row for row in measure(args.archs, args.forms, args.kernels)))
    faults = spilled(rows)
    if args.check:
        faults += grown(rows, read_record(RECORD)["kernels"])
    if args.record:
        record = {"warp": warp.__version__, "kernels": rows}
        lines = ",\n".join("  " + json.dumps(row) for row in rows)
        RECORD.write_text(f'{{\n "warp": "{warp.__version__}",\n "kernels": [\n{lines}\n ]\n}}\n')
        between_markers(PAGE, "gpu-kernels", document(record))
    for fault in faults:
        print(fault, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
