"""``neuprim export``, ``import``, ``compress`` and ``prune``: convert a run's model, or make it smaller."""

from __future__ import annotations

import argparse
import json
import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import (
    Command,
    add_frame_argument,
    parse_count,
    parse_decibels,
    parse_seconds,
    parse_whole,
    print_columns,
    take_condition_arguments,
)
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.core.extensions import ExportReport
    from neuprim.search.compress import Compression
    from neuprim.search.pruning import Pruning


# ---------------------------------------------------------------- export and import


_HELP_WIDTH = 100


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    formats = "name of the format; see the list below"
    parser.add_argument("--format", required=True, metavar="NAME", help=formats)
    parser.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR/export)")
    add_frame_argument(parser)
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _export_command(arguments: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.core.conditions import condition_flag
    from neuprim.runs.export import export_run

    words = [*(f"{condition_flag(k)}={text}" for k, text in arguments.conditions.items()), *arguments.overrides]
    with DrawProgress() as progress:
        report = export_run(arguments.run, arguments.format, arguments.out, words, arguments.force, progress.show)
    print_export_report(report, arguments.json)
    return 0


def _export_help(words: Sequence[str]) -> str:
    """Return the help text below the arguments: all export formats, or the options of ``--format NAME`` if typed.

    The text is empty if ``words``, the command line, have no ``--help``.
    """
    if not {"-h", "--help"} & set(words):
        return ""
    found = re.search(r"--format[= ]([^-\s]\S*)", " ".join(words))
    return "\n".join(_list_export_formats() if found is None else _describe_export_format(found[1]))


def _list_export_formats() -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    yield "formats:"
    for info in EXPORTERS.list_plugins():
        yield f"  {info.name}  ({info.origin})"


def _describe_export_format(name: str) -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    info, exporter = EXPORTERS.load_with_info(name)
    yield f"--format {name}  ({info.origin}): {exporter.summary}"
    rows = [
        (f"{option}={_format_option_default(default)}", help_) for option, (default, help_) in exporter.options.items()
    ]
    yield f"options of --format {name}, with their defaults:" if rows else f"--format {name} has no options"
    indent = 4 + max((len(first) for first, _ in rows), default=0)
    for first, second in rows:
        yield textwrap.fill(f"  {first:{indent - 4}}  {second}", _HELP_WIDTH, subsequent_indent=" " * indent)
    if exporter.conditions:
        yield "conditions of the run's task are flags after RUN_DIR, as --time 0.5 or --light 1,2,3"


def _format_option_default(value: Any) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def print_export_report(report: ExportReport, as_json: bool) -> None:
    """Print the files that an export wrote, its errors against the model, and its notes, as text or as JSON."""
    if as_json:
        errors = {name: value if math.isfinite(value) else None for name, value in report.errors.items()}
        files, notes = [str(path) for path in report.files], list(report.notes)
        record = {"files": files, "lossless": report.lossless, "errors": errors, "notes": notes}
        print(json.dumps(record, indent=1, allow_nan=False))
        return
    print(*report.files, sep="\n")
    print("lossless" if report.lossless else "lossy")
    width = max((len(name) for name in report.errors), default=0)
    for name, value in report.errors.items():
        print(f"{name:{width}}  {value:.4f}")
    for note in report.notes:
        print(f"note: {note}")


def _add_import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="a .ply, .npz or .neuprim file")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN_DIR", help="where to write, a new directory")


def _import_command(arguments: argparse.Namespace) -> int:
    from neuprim.runs.export import import_run_directory

    print(import_run_directory(arguments.file, arguments.out))
    return 0


EXPORT_COMMAND = Command(
    "export",
    "write a run's model in another format",
    _export_command,
    _add_export_arguments,
    _export_help,
    "options of the format, which `neuprim export --format NAME --help` lists",
    take_condition_arguments,
    opens_run=True,
)
IMPORT_COMMAND = Command(
    "import",
    "make a run directory from an exported .ply or .npz, or from a .neuprim file",
    _import_command,
    _add_import_arguments,
)


# ---------------------------------------------------------------- compress


def _add_compress_arguments(parser: argparse.ArgumentParser) -> None:
    tolerance = "largest loss of PSNR on training views (default: 0.1dB)"
    parser.add_argument("--tolerance", type=parse_decibels, metavar="DB", help=tolerance)
    level = "fixed precision instead: 1 is nearly lossless, 5 is the smallest"
    parser.add_argument("--level", type=parse_count, metavar="1-5", help=level)
    seconds = "time to fine-tune the quantised model, e.g. 90s; 0 for none (default: 30s)"
    parser.add_argument("--seconds", type=parse_seconds, default=30.0, metavar="S", help=seconds)
    steps = "fine-tune for N steps instead, which gives the same file on every machine"
    parser.add_argument("--steps", type=parse_whole, metavar="N", help=steps)
    out = "where to write (default: RUN_DIR/model.neuprim)"
    parser.add_argument("--out", type=Path, metavar="FILE", help=out)
    parser.add_argument("--force", action="store_true", help="replace a file that exists")


def _compress_command(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.search.compress import CompressRequest, compress_run

    for word in args.overrides:
        if not word.startswith("bits."):
            raise ConfigError(f"{word}: no setting of `neuprim compress`; expected bits.NAME=BITS, e.g. bits.means=16")
    bits = [word.removeprefix("bits.") for word in args.overrides]
    request = CompressRequest(
        args.run_dir, args.level, bits, args.out, args.force, args.seconds, args.steps, args.tolerance
    )
    with DrawProgress() as progress:
        made = compress_run(request, progress.show)
    _print_compression(made)
    return 0


def _print_compression(made: Compression) -> None:
    """Print the result of a compression: the file, the bytes of every parameter, and the loss of quality."""
    print(made.file)
    sizes = [(p.name, p.bits, p.before, p.after) for p in made.parameters]
    sizes.append(("all, and the header", "", made.before, made.after))
    rows = [("", "bits", "bytes before", "after", "times")]
    for name, bits, before, after in sizes:
        rows.append((name, bits, f"{before:,}", f"{after:,}", f"{before / after:.2f}" if before and after else "-"))
    print_columns(rows)
    for name, (loss_before, loss_after) in made.measured.items():
        unit, digits = (" dB", 3) if name == "psnr" else ("", 4)
        change = f"{loss_before:.{digits}f} -> {loss_after:.{digits}f}{unit} ({loss_after - loss_before:+.{digits}f})"
        print(f"{name:5} {change}, mean of the held-out views")
    for note in made.notes:
        print(f"note: {note}")
    trained = f", with {made.steps:,} steps of training" if made.steps else ""
    print(f"compressed in {made.seconds:.2f} s{trained}")


COMPRESS_COMMAND = Command(
    "compress",
    "write a run's model as one small quantised file, which every command reads",
    _compress_command,
    _add_compress_arguments,
    settings="""\
  bits.NAME=BITS             bits of a parameter, over those of --level (default: 3): bits.means=16 bits.sh_rest=6,5
  bits.others=BITS           bits of all other parameters""",
    opens_run=True,
)


# ---------------------------------------------------------------- prune


def _add_prune_arguments(parser: argparse.ArgumentParser) -> None:
    tolerance = "largest loss of PSNR on training views (default: 0.1dB)"
    parser.add_argument("--tolerance", type=parse_decibels, default=0.1, metavar="DB", help=tolerance)
    seconds = "time to fine-tune, e.g. 90s; 0 for none (default: 60s)"
    parser.add_argument("--seconds", type=parse_seconds, default=60.0, metavar="S", help=seconds)
    steps = "fine-tune for N steps instead, which gives the same model on every machine"
    parser.add_argument("--steps", type=parse_whole, metavar="N", help=steps)
    parser.add_argument("--out", type=Path, metavar="DIR", help="directory of the new run (default: RUN_DIR-pruned)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def _prune_command(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.search.pruning import PruneRequest, prune_run

    request = PruneRequest(args.run_dir, args.tolerance, args.seconds, args.steps, args.out, args.force)
    with DrawProgress() as progress:
        made = prune_run(request, progress.show)
    _print_pruning(made, args.tolerance)
    return 0


_PRUNING_ROWS = (
    ("primitives", "primitives", "{:,.0f}"),
    ("numbers", "numbers", "{:,.0f}"),
    ("bytes", "bytes", "{:,.0f}"),
    ("psnr", "PSNR, held-out views", "{:.3f} dB"),
    ("ssim", "SSIM, held-out views", "{:.4f}"),
    ("frames_per_second", "frames/s", "{:.1f}"),
)


def _print_pruning(made: Pruning, tolerance: float) -> None:
    before = made.judged_psnr[0]
    for number, stage in enumerate(made.stages, 1):
        less = f", {', '.join(stage.words)}" if stage.words else ""
        what = f"cut {number}: {stage.primitives:,} primitives, {stage.numbers:,} numbers{less}"
        loss = f"{stage.cut - before:+.3f} dB at once, {stage.trained - before:+.3f} dB after training"
        print(f"{what}; training views {loss}; {'kept' if stage.kept else 'taken back'}")
    if made.run_dir is None:
        print(f"nothing can be removed within {tolerance:g} dB; nothing was written")
        return
    print(made.run_dir)
    rows = [(name, form.format(made.before[key]), form.format(made.after[key])) for key, name, form in _PRUNING_ROWS]
    print_columns([("", "before", "after"), *rows])
    for word in made.reduced:
        print(f"all primitives: {word}")
    for name, share in made.kept.items():
        if share < 1:
            print(f"{name}: {share:.0%} of its numbers are kept")
    print(f"fine-tuned for {made.steps:,} steps, {made.seconds:.0f} s in all")


PRUNE_COMMAND = Command(
    "prune",
    "remove primitives and parameters that a run does not need, and write the rest as a new run",
    _prune_command,
    _add_prune_arguments,
    opens_run=True,
)
