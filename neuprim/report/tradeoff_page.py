"""The page of ``neuprim tradeoff``: fronts, pictures of their points, and the numbers of all points."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuprim.core.io.files import write_text
from neuprim.core.io.images import write_png
from neuprim.core.metrics import metric_from_json
from neuprim.report import report_page as elements
from neuprim.report.charts import Chart, Dot, front_chart, write_png_charts
from neuprim.report.pictures import InlinedPicture, color_bar, error_map, inline_picture
from neuprim.report.report_page import (
    escape,
    format_decimal,
    format_report_bytes,
    format_report_count,
    report_note,
    section,
)

_SLOWEST = 12.0  # multiples of the reference's time beyond which points are off the charts

Command = Callable[[Sequence[str]], str]


class TradeoffPicture(NamedTuple):
    """Displayed image of a point, (H, W, 3) sRGB, and the image that it is compared with (None: not compared)."""

    image: Tensor
    against: Tensor | None


class _Texts(NamedTuple):
    """What differs between pages of a finished run and of trained models."""

    eyebrow: str
    reference: str
    compared_with: str
    difference: float


_RENDERED = _Texts("speed and accuracy of a finished run", "the reference", "the reference’s", 0.05)
_TRAINED = _Texts("trade-offs of trained models", "the centre", "the ground truth", 0.2)


def write_tradeoff_page(
    folder: Path, record: Mapping[str, Any], pictures: Mapping[int, TradeoffPicture], command: Command
) -> None:
    """Write ``tradeoff.html`` and ``front.png`` into ``folder``.

    Args:
        record: content of ``tradeoff.json``, of a finished run or of trained models.
        pictures: number of a point -> its picture; -1 is the ground truth.
        command: overrides of a point -> the command that draws or trains it.
    """
    page = _TradeoffPage(record, pictures, command)
    title = f"{record['task']} / {record['scene']} – speed and accuracy"
    sections = [
        page.heading(),
        page.tiles(),
        page.charts(),
        page.cards("speed", "The front of speed", "Each is faster than all that are as good."),
        page.cards("size", "The front of size", "Each is smaller than all that are as good."),
        page.table(),
        page.left_out(),
        page.facts(),
    ]
    write_png_charts(folder / "front.png", page.fronts())
    write_text(folder / "tradeoff.html", elements.render_page(title, sections, "compared"))


class _TradeoffPage:
    def __init__(self, record: Mapping[str, Any], pictures: Mapping[int, TradeoffPicture], command: Command) -> None:
        self.record, self.points, self.pictures, self.command = record, record["points"], pictures, command
        self.front: dict[str, list[int]] = {name: list(record["front"][name]) for name in ("speed", "size")}
        self.trained = bool(self.points[0].get("run_dir"))
        self.texts = _TRAINED if self.trained else _RENDERED

    # ------------------------------------------------------------ numbers

    def quality(self, number: int, name: str = "psnr") -> float:
        value = metric_from_json(self.points[number]["quality"], name)
        return math.nan if value is None else value

    def ratio(self, number: int) -> float:
        return float(self.points[number].get("time_ratio", math.nan))

    def spread(self, number: int) -> float:
        return float(self.points[number].get("time_ratio_spread") or 0.0)

    def name(self, number: int) -> str:
        return str(self.points[number]["name"])

    def gain(self, front: str, number: int) -> str:
        if front == "speed":
            return f"{1 / self.ratio(number):.2f}× as fast"
        return f"{self.points[0]['bytes'] / self.points[number]['bytes']:.2f}× smaller"

    def change(self, number: int) -> str:
        change = self.quality(number) - self.quality(0)
        return f"{'+' if change >= 0.005 else '−' if change <= -0.005 else '±'}{abs(change):.2f} dB"

    # ------------------------------------------------------------ sections

    def heading(self) -> str:
        source = self.record["data_source"]
        more = "" if source == "real" else elements.badge(f"{source} data")
        if self.trained:
            more += "\n" + report_note(escape(self.record["length"]))
        return elements.masthead(self.texts.eyebrow, f"{self.record['task']} / {self.record['scene']}", more)

    def tiles(self) -> str:
        base = self.points[0]
        (size, unit), count = (
            format_report_bytes(base["bytes"]),
            base.get("primitives") or self.record.get("primitives"),
        )
        tiles = [
            (self.texts.reference, format_decimal(base.get("ms_per_frame"), 2), "ms a frame", escape(self.name(0))),
            ("PSNR", format_decimal(self.quality(0), 2), "dB", f"{len(self.record['same']['views'])} test views"),
            ("Model file", size, unit, f"{format_report_count(count)} primitives"),
        ]
        for front, label in (("speed", "Fastest"), ("size", "Smallest")):
            good = [i for i in self.front[front] if self.quality(i) >= self.quality(0) - 0.1]
            if good:
                value, _, what = self.gain(front, good[-1]).partition("×")
                tiles.append((f"{label} within 0.1 dB", value, f"times{what}", escape(self.name(good[-1]))))
        return elements.report_tiles(tiles, lead=range(3, len(tiles)))

    def fronts(self) -> list[Chart]:
        """Return PSNR against time and against bytes; of a finished run the latter of smaller points alone."""
        bytes_of = [float(point["bytes"]) for point in self.points]
        sized = [i for i, size in enumerate(bytes_of) if self.trained or i == 0 or size < bytes_of[0]]
        dots = [Dot(bytes_of[i], self.quality(i), 0.0, self._mark("size", i), i == 0) for i in sized]
        return [
            self._time_chart("PSNR against time", "psnr", True),
            front_chart("PSNR against size", "bytes of the model file", "PSNR, dB", dots),
        ]

    def _time_chart(self, title: str, quality: str, joined: bool) -> Chart:
        dots = [
            Dot(self.ratio(i), self.quality(i, quality), self.spread(i), self._mark("speed", i), i == 0)
            for i in range(len(self.points))
        ]
        axis = f"time of a frame, as a multiple of that of {self.texts.reference}"
        return front_chart(title, axis, "PSNR, dB", dots, joined=joined, most=math.inf if self.trained else _SLOWEST)

    def _mark(self, front: str, number: int) -> str | None:
        return str(self.front[front].index(number) + 1) if number in self.front[front] else None

    def charts(self) -> str:
        charts = [*self.fronts(), self._time_chart("PSNR against the exact image", "psnr_exact", False)]
        text = f"Ringed: {self.texts.reference}. Orange and numbered: the front. Bars: half of the interquartile range."
        if self.trained:
            text += " Trainings with another seed differ by some hundredths to tenths of a decibel."
        panels = elements.chart_panels([(f"{escape(chart.title)}, dB", chart) for chart in charts], "charts")
        return section("Fronts", panels + report_note(text))

    def cards(self, front: str, title: str, text: str) -> str:
        """Return a card with picture, numbers and command for every point of a front."""
        cards = [self._card(-1, "ground truth", "")] if -1 in self.pictures else []
        if 0 not in self.front[front]:
            cards.append(self._card(0, escape(self.name(0)), self.texts.reference))
        for place, number in enumerate(self.front[front], 1):
            cards.append(self._card(number, f"{place}. {escape(self.name(number))}", self.gain(front, number)))
        bar = f'<span class="bar" style="background: {color_bar()}"></span>'
        text += f" Beside the picture: its difference from {self.texts.compared_with}."
        scale = report_note(f"Difference: 0{bar}{self.texts.difference:g} or more.")
        return section(title, f'{report_note(text)}{scale}<div class="points">{"".join(cards)}</div>')

    def _card(self, number: int, heading: str, gain: str) -> str:
        html = f'<article class="point"><header><span class="gain">{gain}</span><h3>{heading}</h3></header>'
        if number in self.pictures:
            html += self._pair(self.pictures[number], "ground truth" if number < 0 else self.name(number))
        if number < 0:
            return html + "</article>"
        point, (size, unit) = self.points[number], format_report_bytes(self.points[number]["bytes"])
        quality = f"{format_decimal(self.quality(number), 2)} dB ({self.change(number)})"
        ssim = format_decimal(self.quality(number, "ssim"), 4)
        ms, rate = format_decimal(point.get("ms_per_frame"), 2), format_decimal(point.get("frames_per_second"), 1)
        numbers = f"{quality}, SSIM {ssim}; {ms} ms, {rate} frames/s; {size} {unit}"
        return f"{html}<p>{numbers}</p><code>{escape(self.command(point['words']))}</code></article>"

    def _pair(self, picture: TradeoffPicture, name: str) -> str:
        images = [(picture.image, escape(name))]
        if picture.against is not None:
            error = error_map(picture.image, picture.against, self.texts.difference)
            images.append((torch.from_numpy(error).float() / 255, f"difference of {escape(name)}"))
        figures = [elements.picture(_inline_image(image), "", text) for image, text in images]
        return f'<div class="pair">{"".join(figures)}</div>'

    def table(self) -> str:
        names = ["point", "PSNR", "change", "SSIM", "against exact, dB", "time", "±", "ms", "frames/s", "bytes"]
        names += ["rounds"]
        names += ["primitives", "numbers each", "steps", "ms a step", "seconds"] if self.trained else []
        rows, marked = [], {*self.front["speed"], *self.front["size"]}
        for i, p in enumerate(self.points):
            cells = [
                format_decimal(self.quality(i), 3),
                self.change(i),
                format_decimal(self.quality(i, "ssim"), 4),
                format_decimal(self.quality(i, "psnr_exact"), 1),
                format_decimal(p.get("time_ratio"), 3),
                format_decimal(p.get("time_ratio_spread"), 3),
                format_decimal(p.get("ms_per_frame"), 2),
                format_decimal(p.get("frames_per_second"), 1),
                format_report_count(p["bytes"]),
                format_report_count(len(p["ms"])),
            ]
            if self.trained:
                cells += [format_report_count(p[name]) for name in ("primitives", "parameters_per_primitive", "steps")]
                cells += [format_decimal(p["ms_per_step"], 2), format_decimal(p["seconds"], 1)]
            rows.append(elements.table_row(escape(self.name(i)), cells, ' class="front"' if i in marked else ""))
        text = f"Time and ± are multiples of the time of {self.texts.reference} in the same round; orange: on a front."
        title = f"All {format_report_count(len(self.points))} {'models' if self.trained else 'points'}"
        return section(title, elements.number_table(names, rows) + report_note(text))

    def left_out(self) -> str:
        rows = [
            elements.table_row(escape(one["knob"]), (escape(" ".join(one["words"])), escape(one["reason"])))
            for one in self.record["left_out"]
        ]
        return section("Not measured", elements.number_table(("knob", "point", "why"), rows, "")) if rows else ""

    def facts(self) -> str:
        r, same, exact = self.record, self.record["same"], self.record.get("exact", {})
        text = str(exact.get("drawn_by", elements.MISSING))
        if not exact.get("float64", True):
            size = "×".join(map(str, exact["checked_size"]))
            text += f"; {format_decimal(exact['psnr_against_float64'], 0)} dB from float64 at {size}"
        pairs = [("views", ", ".join(same["views"])), ("image size", "×".join(map(str, same["image_size"])))]
        pairs += [("exact images", text), ("backend", str(r["backend"]))]
        if self.trained:
            pairs += [
                ("overrides of the centre", " ".join(r["words"]) or "none"),
                ("budget", f"{r['budget_seconds']:g} s, of which {r['spent_seconds']:.0f} were used"),
                ("seeds", str(r["seeds"])),
            ]
        else:
            pairs.append(("model", same["model"][:16]))
        pairs += [(name, str(value)) for name, value in (*same["machine"].items(), *same["versions"].items())]
        pairs += [(f"{name} not measured", str(why)) for name, why in r.get("not_measured", {}).items()]
        return section("Where the numbers come from", elements.fact_list(pairs))


def _inline_image(image: Tensor) -> InlinedPicture | None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_png(path, image)
        return inline_picture(path)
