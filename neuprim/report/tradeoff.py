"""The page of ``neuprim tradeoff``: charts with the front marked, pictures of its points side by side, and every
point's numbers."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.io.files import write_text
from neuprim.core.io.images import write_png
from neuprim.core.metrics import from_json
from neuprim.report import page as elements
from neuprim.report.charts import Chart, Dot, front_chart, write_png_charts
from neuprim.report.page import escape, format_bytes, format_count, format_decimal, section
from neuprim.report.pictures import Inlined, color_bar, error_map, inline

__all__ = ["DIFFERENCE", "Page", "Picture", "write_page", "write_tradeoff"]

DIFFERENCE = 0.05
"""Difference from the reference point at the bright end of its colours."""

TIME = "time of a frame, as a multiple of the reference’s"

SLOWEST = 12.0
"""Multiples of the reference's time beyond which points are off the charts."""


@dataclass(frozen=True)
class Picture:
    """What a point shows: (H, W, 3) sRGB values, and those of the reference point that it is compared with, if any."""

    image: Tensor
    against: Tensor | None


def write_tradeoff(
    folder: Path, record: Mapping[str, Any], pictures: Mapping[int, Picture], command: Callable[[Sequence[str]], str]
) -> None:
    """Write ``tradeoff.html`` and ``front.png`` into ``folder``.

    Args:
        record: content of ``tradeoff.json``.
        pictures: of points by their number in it; -1 is the ground truth.
        command: the words of a point -> the command that draws it, ready to paste.
    """
    write_page(folder, Page(record, pictures, command))


def write_page(folder: Path, page: Page) -> None:
    """Write ``tradeoff.html`` and ``front.png`` into ``folder``."""
    title = f"{page.record['task']} / {page.record['scene']} – speed and accuracy"
    sections = [
        page.heading(),
        page.headline(),
        page.charts(),
        page.speed(),
        page.size(),
        page.table(),
        page.left_out(),
        page.facts(),
    ]
    write_png_charts(folder / "front.png", page.fronts())
    write_text(folder / "tradeoff.html", elements.render_page(title, sections, "compared"))


class Page:
    """What both pages of `neuprim tradeoff` have; texts are those of a finished run's drawing."""

    def __init__(
        self, record: Mapping[str, Any], pictures: Mapping[int, Picture], command: Callable[[Sequence[str]], str]
    ) -> None:
        self.record, self.points, self.command = record, record["points"], command
        self.front_of: dict[str, list[int]] = {name: list(record["front"][name]) for name in ("speed", "size")}
        self.pictures = pictures

    eyebrow, reference_is, time_is = "speed and accuracy of a finished run", "the reference", TIME
    difference = DIFFERENCE

    # ------------------------------------------------------------ numbers

    def quality(self, number: int, name: str = "psnr") -> float:
        found = from_json(self.points[number]["quality"], name)
        return math.nan if found is None else found

    def ratio(self, number: int) -> float:
        return float(self.points[number].get("time_ratio", math.nan))

    def spread(self, number: int) -> float:
        return float(self.points[number].get("time_ratio_spread") or 0.0)

    def name(self, number: int) -> str:
        words = self.points[number]["words"]
        return " ".join(word.removeprefix("renderer.") for word in words) or "as the run draws"

    def lost(self, number: int) -> str:
        change = self.quality(number) - self.quality(0)
        return f"{'+' if change >= 0.005 else '−' if change <= -0.005 else '±'}{abs(change):.2f} dB"

    # ------------------------------------------------------------ sections

    def heading(self) -> str:
        r, mark = self.record, ""
        if r["data_source"] != "real":
            mark = elements.badge(f"{r['data_source']} data")
        return elements.masthead(self.eyebrow, f"{r['task']} / {r['scene']}", mark + self.remark())

    def remark(self) -> str:
        """HTML below the heading."""
        return ""

    def headline(self) -> str:
        base = self.points[0]
        size, unit = format_bytes(base["bytes"])
        tiles = [
            ("As compared with", format_decimal(base.get("ms_per_frame"), 2), "ms a frame", escape(self.name(0))),
            ("PSNR", format_decimal(self.quality(0), 2), "dB", f"{len(self.record['same']['views'])} held-out views"),
            ("Model file", size, unit, f"{format_count(self.record['primitives'])} primitives"),
            *self._within("speed", "Fastest", lambda i: f"{1 / self.ratio(i):.2f}"),
            *self._within("size", "Smallest", lambda i: f"{base['bytes'] / self.points[i]['bytes']:.2f}"),
        ]
        return elements.tiles(tiles, lead=range(3, len(tiles)))

    def _within(self, front: str, label: str, value: Any) -> list[tuple[str, str, str, str]]:
        """The last point of a front that loses at most a tenth of a decibel."""
        good = [i for i in self.front_of[front] if self.quality(i) >= self.quality(0) - 0.1]
        if not good:
            return []
        what = "times as fast" if front == "speed" else "times smaller"
        return [(f"{label} within 0.1 dB", value(good[-1]), what, escape(self.name(good[-1])))]

    def fronts(self) -> list[Chart]:
        """Quality against time and against bytes; the latter of points that are smaller, or the reference."""
        bytes_of = [float(p["bytes"]) for p in self.points]
        smaller = [i for i in range(len(self.points)) if i == 0 or bytes_of[i] < bytes_of[0]]
        in_time = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr")
        in_bytes = self._dots("size", smaller, lambda i: bytes_of[i], lambda i: 0.0, "psnr")
        return [
            front_chart("PSNR against time", self.time_is, "PSNR, dB", in_time, most=SLOWEST),
            front_chart("PSNR against size", "bytes of the model file", "PSNR, dB", in_bytes),
        ]

    def _dots(
        self,
        front: str,
        numbers: Sequence[int],
        cost: Callable[[int], float],
        spread: Callable[[int], float],
        good: str,
    ) -> list[Dot]:
        place = {number: str(k + 1) for k, number in enumerate(self.front_of[front])}
        return [Dot(cost(i), self.quality(i, good), spread(i), place.get(i), i == 0) for i in numbers]

    def charts(self) -> str:
        near = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr_exact")
        more = [
            front_chart("PSNR against the exact image", self.time_is, "dB", near, joined=False, most=SLOWEST),
            *self._marching(),
        ]
        panels = elements.chart_panels(
            [(f"{escape(chart.title)}, dB", chart) for chart in [*self.fronts(), *more]], "charts"
        )
        note = (
            '<p class="note">Ringed: the reference. Orange and numbered: the front. Bars: half the range between the quartiles of all rounds.'
            f"{self._march_note()}</p>"
        )
        return section("Fronts", f"{panels}{note}")

    def _marching(self) -> list[Chart]:
        rows = self.record["marching"].get("rows", [])
        if not rows:
            return []
        closed = rows[0]["seconds"]
        dots = [
            Dot(row["seconds"] / closed, row["psnr"], 0.0, str(row["samples"]))
            for row in rows[1:]
            if row["psnr"] is not None
        ]
        return [
            front_chart(
                "Sampled chords against the closed form",
                "time of the integrals, as a multiple of the closed form's",
                "dB",
                dots,
            )
        ]

    def _march_note(self) -> str:
        marching = self.record["marching"]
        if "rows" not in marching:
            return f" Sampling of chords: not measured, {escape(marching.get('not_measured'))}."
        width, height = marching["image_size"]
        return (
            f" Sampled chords: n midpoint samples on each of {format_count(marching['chords'])} chords of an image of {width}×{height}, in float64 torch; "
            "numbers are n, and the closed form takes 1."
        )

    def speed(self) -> str:
        note = "Each is faster than all that are as good. Beside the picture: its difference from the reference’s."
        return self._cards("The front of speed", note, "speed", lambda i: f"{1 / self.ratio(i):.2f}× as fast")

    def size(self) -> str:
        base = self.points[0]["bytes"]
        note = "Each is smaller than all that are as good; bytes are those of a model file that stores it so."
        return self._cards(
            "The front of size", note, "size", lambda i: f"{base / self.points[i]['bytes']:.2f}× smaller"
        )

    def _cards(self, title: str, note: str, front: str, gain: Any) -> str:
        cards = [self._card(None, -1, "ground truth", "")] if -1 in self.pictures else []
        if 0 not in self.front_of[front]:
            cards.append(self._card(None, 0, self.name(0), self.reference_is))
        for k, number in enumerate(self.front_of[front]):
            cards.append(self._card(k + 1, number, self.name(number), gain(number)))
        ticks = f'<p class="note">Difference: 0<span class="bar" style="background: {color_bar()}"></span>{self.difference:g} or more.</p>'
        return section(title, f'<p class="note">{note}</p>{ticks}<div class="points">{"".join(cards)}</div>')

    def _card(self, place: int | None, number: int, name: str, gain: str) -> str:
        head = f"{place}. {escape(name)}" if place else escape(name)
        html = f'<article class="point"><header><span class="gain">{gain}</span><h3>{head}</h3></header>'
        if number in self.pictures:
            html += self._pair(self.pictures[number], name)
        if number < 0:
            return html + "</article>"
        point, (size, unit) = self.points[number], format_bytes(self.points[number]["bytes"])
        numbers = (
            f"{format_decimal(self.quality(number), 2)} dB ({self.lost(number)}), SSIM {format_decimal(self.quality(number, 'ssim'), 4)}; "
            f"{format_decimal(point.get('ms_per_frame'), 2)} ms, {format_decimal(point.get('frames_per_second'), 1)} frames/s; {size} {unit}"
        )
        return f"{html}<p>{numbers}</p><code>{escape(self.command(point['words']))}</code></article>"

    def _pair(self, picture: Picture, name: str) -> str:
        images = [picture.image]
        if picture.against is not None:
            images.append(torch.from_numpy(error_map(picture.image, picture.against, self.difference)).float() / 255)
        drawn = [_inlined(image) for image in images]
        captions = (escape(name), f"difference of {escape(name)}")
        figures = [
            elements.picture(one, "", text) for one, text in zip(drawn, captions, strict=False) if one is not None
        ]
        return f'<div class="pair">{"".join(figures)}</div>'

    def table(self) -> str:
        head = "".join(
            f"<th>{title}</th>"
            for title in (
                "point",
                "time",
                "±",
                "ms",
                "frames/s",
                "PSNR",
                "change",
                "SSIM",
                "against exact, dB",
                "bytes",
                "memory, MB",
                "rounds",
            )
        )
        marked = set(self.front_of["speed"]) | set(self.front_of["size"])
        rows = "".join(self._row(i, i in marked) for i in range(len(self.points)))
        table = f'<div class="scroll"><table class="numbers"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
        note = '<p class="note">Time and ± are multiples of the reference’s of the same round; orange: on a front.</p>'
        return section(f"All {format_count(len(self.points))} points", table + note)

    def _row(self, i: int, marked: bool) -> str:
        p = self.points[i]
        peak = None if p["peak_bytes"] is None else p["peak_bytes"] / 1e6
        cells = (
            *(
                format_decimal(p.get("time_ratio"), 3),
                format_decimal(self.spread(i), 3) if len(p["ratios"]) > 2 else "–",
            ),
            *(format_decimal(p.get("ms_per_frame"), 2), format_decimal(p.get("frames_per_second"), 1)),
            *(
                format_decimal(self.quality(i), 3),
                self.lost(i),
                format_decimal(self.quality(i, "ssim"), 4),
                format_decimal(self.quality(i, "psnr_exact"), 1),
            ),
            *(format_count(p["bytes"]), format_decimal(peak, 1), format_count(len(p["ms"]))),
        )
        kind = ' class="front"' if marked else ""
        return (
            f"<tr{kind}><th scope=row>{escape(self.name(i))}</th>"
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + "</tr>"
        )

    def left_out(self) -> str:
        rows = "".join(
            f"<tr><th scope=row>{escape(one['knob'])}</th><td>{escape(' '.join(one['words']))}</td><td>{escape(one['reason'])}</td></tr>"
            for one in self.record["left_out"]
        )
        if not rows:
            return ""
        head = "<tr><th>knob</th><th>point</th><th>why</th></tr>"
        return section(
            "Not measured", f'<div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
        )

    def facts(self) -> str:
        r, same = self.record, self.record["same"]
        width, height = same["image_size"]
        exact = r.get("exact", {})
        checked = (
            ""
            if exact.get("float64", True)
            else (
                f"; {format_decimal(exact['psnr_against_float64'], 0)} dB from float64 at {'×'.join(map(str, exact['checked_size']))}"
            )
        )
        pairs = [
            ("views", ", ".join(same["views"])),
            ("image size", f"{width}×{height}"),
            ("exact images", f"{exact.get('drawn_by', '–')}{checked}"),
            ("backend", r["backend"]),
            *((name, str(value)) for name, value in same["machine"].items()),
            *((name, str(value)) for name, value in same["versions"].items()),
            ("model", same["model"][:16]),
            *((f"{name} not measured", str(why)) for name, why in r.get("not_measured", {}).items()),
        ]
        return section("Where the numbers come from", elements.fact_list(pairs))


def _inlined(image: Tensor) -> Inlined | None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_png(path, image)
        return inline(path)
