"""The page of ``neuprim tradeoff task=…``: what the knobs of a model cost, each point with the words that train it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.report.scatter import Chart, chart_svg
from neuprim.report.text import byte_size, count, decimal, escape
from neuprim.report.tradeoff import Page, Picture, section, write_page

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

    def heading(self) -> str:
        return super().heading() + f'\n<p class="note">{escape(self.record["length"])}</p>'

    def headline(self) -> str:
        base = self.points[0]
        size, unit = byte_size(base["bytes"])
        tiles = [
            (
                "The centre",
                decimal(base.get("ms_per_frame"), 2),
                "ms a frame",
                f"{count(base['primitives'])} primitives",
            ),
            ("PSNR", decimal(self.quality(0), 2), "dB", f"{len(self.record['same']['views'])} test views"),
            ("Model file", size, unit, f"{base['parameters_per_primitive']} numbers per primitive"),
            *self._within("speed", "Fastest", lambda i: f"{1 / self.ratio(i):.2f}"),
            *self._within("size", "Smallest", lambda i: f"{base['bytes'] / self.points[i]['bytes']:.2f}"),
        ]
        return self.tiles(tiles)

    def charts(self) -> str:
        near = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr_exact")
        drawn = [
            *self.fronts(),
            Chart("PSNR against the model’s own exact image", self.time_is, "dB", near, joined=False),
        ]
        panels = "".join(
            f'<figure class="panel"><figcaption>{escape(chart.title)}, dB</figcaption>{svg}</figure>'
            for chart in drawn
            if (svg := chart_svg(chart)) is not None
        )
        note = (
            '<p class="note">Ringed: the centre. Orange and numbered: the front. Bars: half the range between the quartiles of all rounds. '
            "Each model was trained once per seed; trainings with another seed differ by some hundredths to tenths of a decibel.</p>"
        )
        return section("Fronts", f'<div class="charts">{panels}</div>{note}')

    def fronts(self) -> list[Chart]:
        in_time = self._dots("speed", range(len(self.points)), self.ratio, self.spread, "psnr")
        in_bytes = self._dots(
            "size", range(len(self.points)), lambda i: float(self.points[i]["bytes"]), lambda i: 0.0, "psnr"
        )
        return [
            Chart("PSNR against time", self.time_is, "PSNR, dB", in_time),
            Chart("PSNR against size", "bytes of the model file", "PSNR, dB", in_bytes),
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
        return section(f"All {count(len(self.points))} models", table + note)

    def _row(self, i: int, marked: bool) -> str:
        p = self.points[i]
        peak = None if p["peak_bytes"] is None else p["peak_bytes"] / 1e6
        paces = p["steps_in_turns"]
        cells = (
            *(count(p["primitives"]), count(p["parameters_per_primitive"])),
            *(
                decimal(self.quality(i), 3),
                self.lost(i),
                decimal(self.quality(i, "ssim"), 4),
                decimal(self.quality(i, "psnr_exact"), 1),
            ),
            *(
                count(p["bytes"]),
                decimal(p.get("time_ratio"), 3),
                decimal(self.spread(i), 3) if len(p["ratios"]) > 2 else "–",
            ),
            *(decimal(p.get("ms_per_frame"), 2), decimal(p.get("frames_per_second"), 1)),
            *(count(p["steps"]), decimal(p["ms_per_step"], 2), decimal(sum(paces) / len(paces) if paces else None, 2)),
            *(decimal(p["seconds"], 1), decimal(peak, 1), count(len(p["ms"]))),
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
        cells = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
        return section("Where the numbers come from", f'<dl class="facts">{cells}</dl>')
