"""What was measured, as ``tradeoff.json`` holds it, and as ``tradeoff.csv`` with the columns of the 3DGS compression
survey."""

from __future__ import annotations

import csv
import io
import shlex
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Self

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.files import read_json, write_json, write_text
from neuprim.core.metrics import from_json, to_json
from neuprim.core.validation import Range, coerce, validate
from neuprim.search.tradeoff.knobs import LeftOut

__all__ = ["COLUMNS", "Measured", "Record", "command", "read_record", "write_csv"]

FORMAT = 1

COLUMNS = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")
"""Of the 3DGS compression survey; SSIM and LPIPS by the rule of 3DGS's tools."""

_MORE = ("time ratio", "ms per frame", "frames/s", "PSNR against exact", "peak bytes", "speed front", "size front")

_Positive = Annotated[float, Range(above=0)]

_AS_IT_IS = "as the run draws"


def command(run_dir: str, words: Sequence[str]) -> str:
    """What draws the held-out views so, ready to paste."""
    return shlex.join(["neuprim", "render", run_dir, "--camera", "test", *words])


@dataclass
class Measured:
    """One point.

    Attributes:
        knob: what it turns; "reference" and "combined" are none.
        words: those that reproduce it.
        quality: psnr, ssim, ssim_3dgs, psnr_exact, ssim_exact, and lpips and lpips_3dgs where there are weights.
        bytes: of a model file that stores it so.
        peak_bytes: by how much memory rose while a frame was drawn; None where this system does not tell.
        ms: mean milliseconds per frame of each round; ratios: the same over the reference's of that round.
        rounds: how many it is to have, at most; None for as many as all.
    """

    knob: str
    words: tuple[str, ...]
    quality: dict[str, float]
    bytes: int
    peak_bytes: int | None = None
    ms: list[_Positive] = field(default_factory=list)
    ratios: list[_Positive] = field(default_factory=list)
    rounds: int | None = None

    @property
    def name(self) -> str:
        """The words as people read them."""
        return " ".join(word.removeprefix("renderer.") for word in self.words) or _AS_IT_IS

    @property
    def ratio(self) -> float:
        """Median time over the reference's."""
        return statistics.median(self.ratios) if self.ratios else float("nan")

    @property
    def time(self) -> float:
        """Median milliseconds per frame."""
        return statistics.median(self.ms) if self.ms else float("nan")

    @property
    def spread(self) -> float | None:
        """Half of the range between the quartiles of the ratios; None of fewer than three."""
        if len(self.ratios) < 3:
            return None
        low, _, high = statistics.quantiles(self.ratios, n=4, method="inclusive")
        return (high - low) / 2

    @property
    def doubt(self) -> float:
        """How uncertain the median of the ratios is: 1.57 times the range between the quartiles over the root of their
        number (McGill's notches; medians farther apart than both of theirs differ). All of it, of fewer than three."""
        if self.spread is None:
            return self.ratio if len(self.ratios) else 0.0
        return 3.14 * self.spread / len(self.ratios) ** 0.5

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        numbers: dict[str, Any] = {}
        for name, value in self.quality.items():
            numbers |= to_json(name, value)
        own = {name: getattr(self, name) for name in ("bytes", "peak_bytes", "ms", "ratios", "rounds")}
        return {"knob": self.knob, "words": list(self.words), "quality": numbers, **own}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        names = [name.removesuffix("_infinite") for name in data["quality"]]
        quality = {name: value for name in names if (value := from_json(data["quality"], name)) is not None}
        own = {name: data[name] for name in ("bytes", "peak_bytes", "ms", "ratios", "rounds")}
        return replace(
            validate(cls, {"knob": data["knob"], "words": data["words"], "quality": {}, **own}, "points"),
            quality=quality,
        )


@dataclass
class Record:
    """All of it.

    Attributes:
        same: what must be the same for points to be kept: model, settings, views, versions, machine.
        facts: what else a reader wants to know: the run, its data, the exact images.
        points: the reference first.
        left_out: what was not measured, and why.
        speed, size: numbers of the points on the front of time and of bytes against PSNR, best quality first.
        marching: closed form against ray marching, where that was measured.
    """

    same: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    points: list[Measured] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    speed: list[int] = field(default_factory=list)
    size: list[int] = field(default_factory=list)
    marching: dict[str, Any] = field(default_factory=dict)

    @property
    def reference(self) -> Measured:
        return self.points[0]

    def find(self, words: Sequence[str]) -> Measured | None:
        """The point of these words."""
        return next((point for point in self.points if point.words == tuple(words)), None)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        out = [{"knob": one.knob, "words": list(one.words), "reason": one.reason} for one in self.left_out]
        return {
            "format": FORMAT,
            "same": self.same,
            **self.facts,
            "points": [{**point.to_dict(), **_derived(point)} for point in self.points],
            "left_out": out,
            "front": {"speed": self.speed, "size": self.size},
            "marching": self.marching,
        }

    def write(self, path: Path) -> None:
        write_json(path, self.to_dict())


def _derived(point: Measured) -> dict[str, Any]:
    """For readers of the file; not read back."""
    if not point.ms:
        return {}
    times = {"ms_per_frame": point.time, "frames_per_second": 1e3 / point.time, "time_ratio": point.ratio}
    return {**times, "time_ratio_spread": point.spread, "time_ratio_doubt": point.doubt}


def read_record(path: Path, kind: type[Measured] = Measured) -> Record | None:
    """The record in a file; None where there is none.

    Args:
        kind: of its points.

    Raises:
        DataError: the file is not one.
    """
    data = read_json(path, "a record of `neuprim tradeoff`", "delete it to measure anew")
    if data is None:
        return None
    try:
        if data["format"] != FORMAT:
            raise DataError(
                f"{path}: format {data['format']!r}; this neuprim reads {FORMAT}; delete it to measure anew"
            )
        points = [kind.from_dict(entry) for entry in data["points"]]
        out = [validate(LeftOut, entry, "left_out") for entry in data["left_out"]]
        speed, size = (coerce(data["front"][name], list[int], f"front.{name}") for name in ("speed", "size"))
        if not points or not all(0 <= number < len(points) for number in (*speed, *size)):
            raise ValueError(f"front: expected numbers of the {len(points)} points")
        known = ("format", "same", "points", "left_out", "front", "marching")
        facts = {key: value for key, value in data.items() if key not in known}
        return Record(dict(data["same"]), facts, points, out, speed, size, dict(data["marching"]))
    except (KeyError, TypeError, AttributeError, ValueError, ConfigError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(f"{path}: not a record of `neuprim tradeoff` ({what}); delete it to measure anew") from error


def write_csv(
    path: Path,
    record: Record,
    primitives: Callable[[int], int],
    more: Mapping[str, Callable[[int], object]] = MappingProxyType({}),
) -> None:
    """The table, a row per point; empty cells are not measured. LPIPS is the survey's, of VGG; another network's is
    left out.

    Args:
        primitives: number of a point -> how many it has.
        more: further columns, and what stands in them, of a point's number.
    """
    perceived = "lpips_3dgs" if record.same.get("lpips") == "vgg" else ""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow((*COLUMNS, *_MORE, *more))
    for number, point in enumerate(record.points):
        q = point.quality
        own = (
            point.name,
            _cell(q.get("psnr")),
            _cell(q.get("ssim_3dgs")),
            _cell(q.get(perceived)),
            point.bytes,
            primitives(number),
        )
        times = (f"{point.ratio:.4f}", f"{point.time:.4f}", f"{1e3 / point.time:.2f}") if point.ms else ("", "", "")
        peak = "" if point.peak_bytes is None else point.peak_bytes
        fronts = (int(number in record.speed), int(number in record.size))
        writer.writerow(
            (*own, *times, _cell(q.get("psnr_exact")), peak, *fronts, *(cell(number) for cell in more.values()))
        )
    write_text(path, buffer.getvalue())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
