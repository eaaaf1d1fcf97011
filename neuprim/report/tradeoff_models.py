"""The page of ``neuprim tradeoff task=…``: what the knobs of a model cost, each point with the words that train it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.report import page as elements
from neuprim.report.charts import Chart, front_chart
from neuprim.report.page import escape, format_bytes, format_count, format_decimal, section
from neuprim.report.tradeoff import Page, Picture, write_page

__all__ = ["write_models"]


def write_models(
    folder: Path, record: Mapping[str, Any], pictures: Mapping[int, Picture], command: Callable[[Sequence[str]], str]
) -> None:
    """Write ``tradeoff.html`` and ``front.png`` into ``folder``.

    Args:
        record: content of ``tradeoff.json``.
        pictures: of models by their number in it; -1 is the ground truth.
        command: the words of a model -> the command that trains it, ready to paste.
    """
    write_page(folder, _Models(record, pictures, command))


class _Models(Page):
    eyebrow, reference_is = "what the knobs of a model cost", "the centre of the set"
    time_is = "time of a frame, as a multiple of the centre’s"
    difference = 0.2

    def name(self, number: int) -> str:
        return str(self.points[number]["name"])

    def remark(self) -> str:
        return f'\n<p class="note">{escape(self.record["length"])}</p>'

    def headline(self) -> str:
        base = self.points[0]
        size, unit = format_bytes(base["bytes"])
        tiles = [
            (
                "The centre",
                format_decimal(base.get("ms_per_frame"), 2),
                "ms a frame",
                f"{format_count(base['primitives'])} primitives",
            ),
            ("PSNR", format_decimal(self.quality(0), 2), "dB", f"{len(self.record['same']['views'])} test views"),
            ("Model file", size, unit, f"{base['parameters_per_primitive']} numbers per primitive"),
            *self._within("speed", "Fastest", lambda i: f"{1 / self.ratio(i):.2f}"),
            *self._within("size", "Smallest", lambda i: f"{base['bytes'] / self.points[i]['bytes']:.2f}"),
        ]
        return elements.tiles(tiles, lead=range(3, len(tiles)))

    def charts(self) -> str:
        near = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr_exact")
        drawn = [
            *self.fronts(),
            front_chart("PSNR against the model’s own exact image", self.time_is, "dB", near, joined=False),
        ]
        panels = elements.chart_panels([(f"{escape(chart.title)}, dB", chart) for chart in drawn], "charts")
        note = (
            '<p class="note">Ringed: the centre. Orange and numbered: the front. Bars: half the range between the quartiles of all rounds. '
            "Each model was trained once per seed; trainings with another seed differ by some hundredths to tenths of a decibel.</p>"
        )
        return section("Fronts", f"{panels}{note}")

    def fronts(self) -> list[Chart]:
        in_time = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr")
        in_bytes = self._dots(
            "size", range(len(self.points)), lambda i: float(self.points[i]["bytes"]), lambda i: 0.0, "psnr"
        )
        return [
            front_chart("PSNR against time", self.time_is, "PSNR, dB", in_time),
            front_chart("PSNR against size", "bytes of the model file", "PSNR, dB", in_bytes),
        ]

    def speed(self) -> str:
        note = "Each is faster than all that are as good. Beside the picture: its difference from the ground truth. Below: the words that train it."
        return self._cards(
            "The front of speed", note, "speed", lambda i: f"{1 / self.ratio(i):.2f}× as fast as the centre"
        )

    def size(self) -> str:
        base = self.points[0]["bytes"]
        note = "Each is smaller than all that are as good."
        return self._cards(
            "The front of size",
            note,
            "size",
            lambda i: f"{base / self.points[i]['bytes']:.2f}× smaller than the centre",
        )

    def table(self) -> str:
        titles = (
            *(
                "model",
                "primitives",
                "numbers each",
                "PSNR",
                "change",
                "SSIM",
                "against exact, dB",
                "bytes",
                "time",
                "±",
                "ms",
                "frames/s",
            ),
            *("steps", "ms a step", "step", "seconds", "memory, MB", "rounds"),
        )
        head = "".join(f"<th>{title}</th>" for title in titles)
        marked = set(self.front_of["speed"]) | set(self.front_of["size"])
        rows = "".join(self._row(i, i in marked) for i in range(len(self.points)))
        table = f'<div class="scroll"><table class="numbers"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
        note = (
            '<p class="note">Time and ± are multiples of the centre’s of the same round, step is a training step’s time beside the centre’s; '
            "ms a step, seconds: of the model’s own training; orange: on a front.</p>"
        )
        return section(f"All {format_count(len(self.points))} models", table + note)

    def _row(self, i: int, marked: bool) -> str:
        p = self.points[i]
        peak = None if p["peak_bytes"] is None else p["peak_bytes"] / 1e6
        paces = p["steps_in_turns"]
        cells = (
            *(format_count(p["primitives"]), format_count(p["parameters_per_primitive"])),
            *(
                format_decimal(self.quality(i), 3),
                self.lost(i),
                format_decimal(self.quality(i, "ssim"), 4),
                format_decimal(self.quality(i, "psnr_exact"), 1),
            ),
            *(
                format_count(p["bytes"]),
                format_decimal(p.get("time_ratio"), 3),
                format_decimal(self.spread(i), 3) if len(p["ratios"]) > 2 else "–",
            ),
            *(format_decimal(p.get("ms_per_frame"), 2), format_decimal(p.get("frames_per_second"), 1)),
            *(
                format_count(p["steps"]),
                format_decimal(p["ms_per_step"], 2),
                format_decimal(sum(paces) / len(paces) if paces else None, 2),
            ),
            *(format_decimal(p["seconds"], 1), format_decimal(peak, 1), format_count(len(p["ms"]))),
        )
        kind = ' class="front"' if marked else ""
        return (
            f"<tr{kind}><th scope=row>{escape(self.name(i))}</th>"
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + "</tr>"
        )

    def facts(self) -> str:
        r, same = self.record, self.record["same"]
        width, height = same["image_size"]
        pairs = [
            ("words of the centre", " ".join(r["words"]) or "none"),
            ("budget", f"{r['budget_seconds']:g} s, of which {r['spent_seconds']:.0f} were used"),
            ("seeds", str(r["seeds"])),
            ("views", ", ".join(same["views"])),
            ("image size", f"{width}×{height}"),
            ("exact images", str(r.get("exact", {}).get("drawn_by", "–"))),
            ("backend", str(r["backend"])),
            *((name, str(value)) for name, value in same["machine"].items()),
            *((name, str(value)) for name, value in same["versions"].items()),
            *((f"{name} not measured", str(why)) for name, why in r.get("not_measured", {}).items()),
        ]
        return section("Where the numbers come from", elements.fact_list(pairs))
