"""Export the model of a run directory to another format, and import an exported file as a run directory."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neuprim.core import checkpoint
from neuprim.core.compression.file import is_compressed
from neuprim.core.conditions import condition_flag, frame_numbers, read_conditions, split_conditions
from neuprim.core.errors import ConfigError, DataError, NeuprimError, nearest
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, StoredModel
from neuprim.core.io.files import StagedOutput, refuse_existing, staged_output
from neuprim.core.model.fields import ConditionSpec
from neuprim.plugins.attribution import attribute_errors, find_plugin_source
from neuprim.plugins.registry import EXPORTERS, PluginError, UnknownPlugin
from neuprim.runs.open import COMPRESSED, Progress, StoredRun, ignore_progress, load_run, open_run

__all__ = ["export_run", "import_run_directory"]

# ---------------------------------------------------------------- export


def export_run(
    run: Path | StoredRun,
    name: str,
    out: Path | None = None,
    words: Sequence[str] = (),
    overwrite: bool = False,
    progress: Progress = ignore_progress,
) -> ExportReport:
    """Write a run's model in the export format ``name``. An export that fails leaves no partial files.

    The files go to ``RUN_DIR/export`` unless ``out`` is given. Existing files are only replaced with ``overwrite``.

    Args:
        words: ``KEY=VALUE`` options of the exporter, and conditions of the task as ``--NAME TEXT`` or ``--NAME=TEXT``.
        progress: called with (text, fraction 0..1).

    Raises:
        NeuprimError: the run, format or option does not exist, the format cannot hold the model, the files exist
            already, or the exporter crashed.
    """
    run_dir = run.directory if isinstance(run, StoredRun) else run
    try:
        exporter = EXPORTERS.load(name)
    except UnknownPlugin:
        load_run(run)  # a missing package of the run itself is the more helpful error
        raise
    source = find_plugin_source(EXPORTERS, name)
    model = open_run(run, progress)
    options, conditions = _parse_run_export_options(words, exporter, model.task.conditions)
    notes: list[str] = []
    found = read_conditions(model.task.conditions, conditions, notes.append)
    several = exporter.sequence and any(len(values) > 1 for values in found.values())
    final = _run_export_destination(run_dir, exporter, out, several)
    refuse_existing(final, overwrite)
    with staged_output(final, overwrite) as output:
        job = ExportJob(model, output.out, options, conditions, progress)
        with attribute_errors(source):
            report = _write_export_sequence(job, exporter) if several else exporter.write(job)
        files = _check_run_export_files(report, output, source.label)
        output.publish()
    return replace(report, files=files, notes=(*notes, *(output.final_text(note) for note in report.notes)))


def _write_export_sequence(job: ExportJob, exporter: Exporter) -> ExportReport:
    """Write one file per frame into the folder ``job.out``, with the frame numbers of the model's source if known."""
    frames = job.frames(several=True)
    numbers, name = frame_numbers(job.run.header, frames), Path(_export_file_name(exporter))
    width = max(4, len(str(max(numbers))))
    job.out.mkdir()
    reports = []
    for i, (number, frame) in enumerate(zip(numbers, frames, strict=True)):
        job.progress("writing frames", i / len(frames))
        path = job.out / f"{name.stem}.{number:0{width}d}{name.suffix}"
        reports.append(exporter.write(replace(job, out=path, frame=frame, progress=ignore_progress)))
    return ExportReport(
        tuple(file for report in reports for file in report.files),
        all(report.lossless for report in reports),
        {f"frame_{n:0{width}d}.{key}": x for n, r in zip(numbers, reports, strict=True) for key, x in r.errors.items()},
        (f"{len(frames)} frames; of frame {numbers[0]}:", *reports[0].notes),
    )


def _export_file_name(exporter: Exporter) -> str:
    return exporter.default or exporter.name + "".join(exporter.suffixes[:1])


def _run_export_destination(run_dir: Path, exporter: Exporter, out: Path | None, several: bool) -> Path:
    """Return the path to write: ``out``, or a path in ``RUN_DIR/export`` with the exporter's default file name.

    With ``several`` frames, this is a folder. Raises ConfigError if the suffix of ``out`` does not fit the exporter.
    """
    if out is None:
        name = _export_file_name(exporter)
        return run_dir / "export" / (Path(name).stem if several else name)
    fits = any(out.name.lower().endswith(suffix) and len(out.name) > len(suffix) for suffix in exporter.suffixes)
    if several:
        if fits:
            raise ConfigError(f"--out {out}: several frames need several files; expected a folder")
        return out
    if exporter.suffixes and (not fits or out.is_dir()):
        raise ConfigError(f"--out {out}: expected a file name that ends in {' or '.join(exporter.suffixes)}")
    return out


def _check_run_export_files(report: Any, output: StagedOutput, exporter: str) -> tuple[Path, ...]:
    """Check the files that an exporter reports, which are still in a temporary folder; return their final paths.

    Raises PluginError if the report is wrong, or if a file is missing or outside of the output path.
    """
    if not isinstance(report, ExportReport):
        raise PluginError(f"{exporter}: write returned {type(report).__name__}; expected an ExportReport")
    files = []
    for path in map(Path, report.files):
        final = output.final_path(path)
        if final is None:
            raise PluginError(
                f"{exporter}: wrote {path} instead of {output.out}; expected only this output path, or "
                f"files in it (neuprim protects existing files there)"
            )
        if not path.exists():
            raise PluginError(f"{exporter}: reports {path}, which it did not write")
        files.append(final)
    return tuple(files)


def _parse_run_export_options(
    words: Sequence[str], exporter: Exporter, specs: Sequence[ConditionSpec]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Parse the last arguments of ``neuprim export``, such as ``KEY=VALUE`` and ``--time 0.5``.

    Returns the exporter's options, completed with defaults, and condition name -> text, e.g. ``{"time": "0.5"}``.
    """
    options = {name: default for name, (default, _) in exporter.options.items()}
    conditions, rest = split_conditions(words, specs)
    if conditions and not exporter.conditions:
        flag = condition_flag(next(iter(conditions)))
        raise ConfigError(f"{flag}: --format {exporter.name} takes no conditions; leave out {flag}")
    given = set()
    for word in rest:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise ConfigError(f"{word!r}: expected KEY=VALUE")
        if key in given:
            raise ConfigError(f"{key}: given twice")
        if key not in exporter.options:
            conditions_of_task = (condition_flag(spec.name) for spec in specs) if exporter.conditions else ()
            hint = nearest(key, [*exporter.options, *conditions_of_task]) or "; this format has no options"
            raise ConfigError(f"{key}: no such option of --format {exporter.name}{hint}")
        given.add(key)
        options[key] = _parse_run_export_option(text)
    return options, conditions


def _parse_run_export_option(text: str) -> Any:
    """Parse a value: a number, true, false, null or text. Unlike in YAML, 1e-3 is a number and 1:40 is text."""
    words = {"true": True, "false": False, "null": None, "": None}
    if text in words:
        return words[text]
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


# ---------------------------------------------------------------- import


def import_run_directory(path: Path, out: Path, name: str | None = None) -> Path:
    """Create a run directory from a file written by a lossless exporter or by ``neuprim compress``; return its path.

    The new directory holds ``config.yaml``, and the model as ``model.safetensors``, or compressed as
    ``model.neuprim``. Commands accept the directory like the original run. ``name`` is the format of the file; None for
    the format that the suffix of ``path`` names.

    Raises:
        ConfigError: ``out`` exists and is not empty, or no format reads such files.
        DataError: the file is damaged or was not written by neuprim.
        CheckpointError: the model in the file is damaged.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"--out {out}: exists and is not an empty folder; expected a new or empty folder")
    if name is None and is_compressed(path):
        config = checkpoint.checkpoint_config(path)
        if config is None:
            raise DataError(f"{path}: contains no config.yaml; expected a file written by `neuprim compress`")
        return _write_imported_run(path, out, config, lambda folder: shutil.copyfile(path, folder / COMPRESSED))
    name = name or path.suffix.lower().removeprefix(".")
    try:
        reader = EXPORTERS.load(name)
    except UnknownPlugin:
        raise ConfigError(
            f"{path}: cannot import .{name} files; expected a file of `neuprim compress` or `neuprim export` (ply, npz)"
        ) from None
    if reader.read is None:
        raise ConfigError(
            f"{path}: --format {name} is lossy, and neuprim cannot import such a file; expected ply or npz"
        )
    with attribute_errors(find_plugin_source(EXPORTERS, name)):
        stored = reader.read(path)
    return import_model_as_run(stored, path, out)


def import_model_as_run(stored: StoredModel, path: Path, out: Path) -> Path:
    """Write a model that was read from the exported file ``path`` as the run directory ``out``; return ``out``.

    The directory gets its final name only after the model was loaded from it once, as a check.
    """
    header: Mapping[str, Any] = {key: value for key, value in stored.header.items() if key not in ("format", "kind")}
    tensors = {name: torch.from_numpy(value) for name, value in stored.tensors.items()}

    def write(folder: Path) -> None:
        checkpoint.write_tensors(folder / "model.safetensors", "model", tensors, header)

    return _write_imported_run(path, out, stored.config, write)


def _write_imported_run(path: Path, out: Path, config: str, write: Callable[[Path], object]) -> Path:
    """Create the run directory ``out`` and check that it can be loaded; return ``out``.

    Args:
        path: the imported file, which errors name.
        config: text of ``config.yaml``.
        write: function (folder) that writes the model's file.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        folder.chmod(0o755)
        (folder / "config.yaml").write_text(config, encoding="utf-8", newline="")
        try:
            write(folder)
            load_run(folder, named=False)
        except (NeuprimError, ValueError, TypeError) as error:  # the message would name the temporary folder
            raise DataError(f"{path}: {str(error).replace(str(folder), 'its model')}") from error
        if out.exists():
            out.rmdir()
        folder.rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return out
