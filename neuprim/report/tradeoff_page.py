"""Write the page of ``neuprim tradeoff``: Pareto fronts, pictures of the points on them, and a table of all points."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuprim.core.io.files import write_text
from neuprim.core.metrics import metric_from_json
from neuprim.report import report_page as elements
from neuprim.report.charts import Chart, Dot, front_chart, write_png_charts
from neuprim.report.pictures import color_bar, error_map
from neuprim.report.report_page import escape, format_decimal, format_report_count, report_note, section

_SLOWEST = 12.0  # multiples of the reference's time beyond which points are off the charts
_DIFFERENCE = 0.1  # error at the bright end of the colour bar

Command = Callable[[Sequence[str]], str]


class TradeoffPicture(NamedTuple):
    """Picture of one point of a trade-off, that is of one render configuration or trained model.

    Attributes:
        image: the displayed image, (H, W, 3) sRGB.
        against: the image that the page compares ``image`` with, or None.
    """

    image: Tensor
    against: Tensor | None


def write_tradeoff_page(
    folder: Path, record: Mapping[str, Any], pictures: Mapping[int, TradeoffPicture], command: Command
) -> None:
    """Write ``tradeoff.html`` and ``front.png`` into ``folder``.

    Args:
        record: content of ``tradeoff.json``: points are render configurations of a finished run, or trained models.
        pictures: index of a point -> the point's picture; the index -1 stands for the ground truth.
        command: function that returns, for a point's overrides, the command that renders or trains the point.
    """
    page = _TradeoffPage(record, pictures, command)
    title = f"{record['task']} / {record['scene']}"
    sections = [
        page.heading(title),
        page.charts(),
        page.cards("speed", "The front of speed", "Each is faster than all that are as good."),
        page.cards("size", "The front of size", "Each is smaller than all that are as good."),
        page.table(),
        page.left_out(),
        page.facts(),
    ]
    write_png_charts(folder / "front.png", page.fronts())
    write_text(folder / "tradeoff.html", elements.render_page(f"{title} – speed and accuracy", sections, "compared"))


class _TradeoffPage:
    def __init__(self, record: Mapping[str, Any], pictures: Mapping[int, TradeoffPicture], command: Command) -> None:
        self.record, self.points, self.pictures, self.command = record, record["points"], pictures, command
        self.front: dict[str, list[int]] = {name: list(record["front"][name]) for name in ("speed", "size")}
        self.trained = bool(self.points[0].get("run_dir"))
        self.reference = "the centre" if self.trained else "the reference"

    # ------------------------------------------------------------ numbers

    def quality(self, number: int, name: str = "psnr") -> float:
        value = metric_from_json(self.points[number]["quality"], name)
        return math.nan if value is None else value

    def gain(self, front: str, number: int) -> str:
        if front == "speed":
            return f"{1 / float(self.points[number].get('time_ratio', math.nan)):.2f}× as fast"
        return f"{self.points[0]['bytes'] / self.points[number]['bytes']:.2f}× smaller"

    def change(self, number: int) -> str:
        change = self.quality(number) - self.quality(0)
        return f"{'+' if change >= 0.005 else '−' if change <= -0.005 else '±'}{abs(change):.2f} dB"

    # ------------------------------------------------------------ sections

    def heading(self, title: str) -> str:
        source = self.record["data_source"]
        badge = "" if source == "real" else f"{source} data"
        more = "\n" + report_note(escape(self.record["length"])) if self.trained else ""
        eyebrow = "trade-offs of trained models" if self.trained else "speed and accuracy of a finished run"
        return elements.masthead(eyebrow, title, badge, more)

    def fronts(self) -> list[Chart]:
        """Return two charts: PSNR against time, and PSNR against bytes.

        For the trade-offs of a finished run, the second chart has only the run's model and smaller models.
        """
        bytes_of = [float(point["bytes"]) for point in self.points]
        sized = [i for i, size in enumerate(bytes_of) if self.trained or i == 0 or size < bytes_of[0]]
        dots = [Dot(bytes_of[i], self.quality(i), 0.0, self._mark("size", i), i == 0) for i in sized]
        return [
            self._time_chart(),
            front_chart("PSNR against size", "bytes of the model file", "PSNR, dB", dots),
        ]

    def _time_chart(self) -> Chart:
        dots = []
        for i, point in enumerate(self.points):
            ratio, spread = float(point.get("time_ratio", math.nan)), float(point.get("time_ratio_spread") or 0.0)
            dots.append(Dot(ratio, self.quality(i), spread, self._mark("speed", i), i == 0))
        axis = f"time of a frame, as a multiple of that of {self.reference}"
        most = math.inf if self.trained else _SLOWEST
        return front_chart("PSNR against time", axis, "PSNR, dB", dots, most=most)

    def _mark(self, front: str, number: int) -> str | None:
        return str(self.front[front].index(number) + 1) if number in self.front[front] else None

    def charts(self) -> str:
        text = f"Ringed: {self.reference}. Orange and numbered: the front. Bars: half of the interquartile range."
        if self.trained:
            text += " Trainings with another seed differ by some hundredths to tenths of a decibel."
        panels = elements.chart_panels([(f"{escape(chart.title)}, dB", chart) for chart in self.fronts()], "charts")
        return section("Fronts", panels + report_note(text))

    def cards(self, front: str, title: str, text: str) -> str:
        """Return HTML with a card (picture, metrics, command) for every point of a Pareto front, "speed" or "size"."""
        cards = [self._card(-1, "ground truth", "")] if -1 in self.pictures else []
        if 0 not in self.front[front]:
            cards.append(self._card(0, escape(self.points[0]["name"]), self.reference))
        for place, number in enumerate(self.front[front], 1):
            name = escape(self.points[number]["name"])
            cards.append(self._card(number, f"{place}. {name}", self.gain(front, number)))
        bar = f'<span class="bar" style="background: {color_bar()}"></span>'
        text += f" Beside the picture: its difference from {'the ground truth' if self.trained else 'the reference’s'}."
        scale = report_note(f"Difference: 0{bar}{_DIFFERENCE:g} or more.")
        return section(title, f'{report_note(text)}{scale}<div class="points">{"".join(cards)}</div>')

    def _card(self, number: int, heading: str, gain: str) -> str:
        html = f'<article class="point"><header><span class="gain">{gain}</span><h3>{heading}</h3></header>'
        if number in self.pictures:
            image, against = self.pictures[number]
            html += f'<div class="pair">{elements.figure(image, "", heading)}'
            if against is not None:
                error = torch.from_numpy(error_map(image, against, _DIFFERENCE)).float() / 255
                html += elements.figure(error, "", f"difference of {heading}")
            html += "</div>"
        if number < 0:
            return html + "</article>"
        point, ssim = self.points[number], format_decimal(self.quality(number, "ssim"), 4)
        quality = f"{format_decimal(self.quality(number), 2)} dB ({self.change(number)}), SSIM {ssim}"
        time = f"{format_decimal(point.get('ms_per_frame'), 2)} ms"
        numbers = f"{quality}; {time}; {elements.format_report_bytes(point['bytes'])}"
        return f"{html}<p>{numbers}</p><code>{escape(self.command(point['words']))}</code></article>"

    def table(self) -> str:
        columns: dict[str, Callable[[int, Mapping[str, Any]], str]] = {
            "PSNR": lambda i, p: format_decimal(self.quality(i), 3),
            "change": lambda i, p: self.change(i),
            "SSIM": lambda i, p: format_decimal(self.quality(i, "ssim"), 4),
            "time": lambda i, p: format_decimal(p.get("time_ratio"), 3),
            "±": lambda i, p: format_decimal(p.get("time_ratio_spread"), 3),
            "ms": lambda i, p: format_decimal(p.get("ms_per_frame"), 2),
            "bytes": lambda i, p: format_report_count(p["bytes"]),
        }
        if self.trained:
            columns |= {
                "primitives": lambda i, p: format_report_count(p["primitives"]),
                "numbers each": lambda i, p: format_report_count(p["parameters_per_primitive"]),
                "steps": lambda i, p: format_report_count(p["steps"]),
                "ms a step": lambda i, p: format_decimal(p["ms_per_step"], 2),
                "seconds": lambda i, p: format_decimal(p["seconds"], 1),
            }
        rows, marked = [], {*self.front["speed"], *self.front["size"]}
        for i, point in enumerate(self.points):
            cells = [column(i, point) for column in columns.values()]
            rows.append(elements.table_row(escape(point["name"]), cells, ' class="front"' if i in marked else ""))
        text = f"Time and ± are multiples of the time of {self.reference} in the same round; orange: on a front."
        title = f"All {format_report_count(len(self.points))} {'models' if self.trained else 'points'}"
        return section(title, elements.number_table(["point", *columns], rows) + report_note(text))

    def left_out(self) -> str:
        rows = [
            elements.table_row(escape(one["knob"]), (escape(" ".join(one["words"])), escape(one["reason"])))
            for one in self.record["left_out"]
        ]
        return section("Not measured", elements.number_table(("knob", "point", "why"), rows, "")) if rows else ""

    def facts(self) -> str:
        r, same = self.record, self.record["same"]
        pairs = [
            ("views", ", ".join(same["views"])),
            ("image size", "×".join(map(str, same["image_size"]))),
            ("backend", r["backend"]),
        ]
        if self.trained:
            budget = f"{r['budget_seconds']:g} s, of which {r['spent_seconds']:.0f} were used"
            words = " ".join(r["words"]) or "none"
            pairs += [("overrides of the centre", words), ("budget", budget)]
        pairs += [*same["machine"].items(), *same["versions"].items()]
        return section("Where the numbers come from", elements.fact_list(pairs))
