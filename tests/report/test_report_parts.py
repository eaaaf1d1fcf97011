"""The report's parts: reading a run directory, error maps, pictures, charts, numbers as text."""

from __future__ import annotations

import base64
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.errors import ConfigError, DataError, NonFiniteError
from neuprim.report import ERROR_SCALE, error_map
from neuprim.report.charts import HELD_OUT, TRAINING, ChartPoints, Dot, curve_chart, draw_svg, front_chart, view_chart
from neuprim.report.pictures import inline_picture
from neuprim.report.report_page import (
    escape,
    format_decimal,
    format_report_bytes,
    format_report_count,
    format_report_duration,
)
from neuprim.report.run_record import read_reported_run


def test_a_resumed_run_counts_each_step_once(tmp_path: Path) -> None:
    steps = [(10, 1.0), (20, 2.0), (30, 3.0), (20, 2.5), (30, 3.5), (40, 4.5)]
    lines = [json.dumps({"step": s, "loss": v}) for s, v in steps]
    (tmp_path / "metrics.jsonl").write_text("\n".join([*lines, "[1]", '{"loss": 3}', ""]))
    run = read_reported_run(tmp_path)
    assert [(line["step"], line["loss"]) for line in run.log] == [(10, 1.0), (20, 2.5), (30, 3.5), (40, 4.5)]
    assert run.unreadable_lines == 2 and run.last("loss") == (40, 4.5) and run.last("psnr") is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("metrics.json", "{", "metrics.json: not valid JSON"),
        ("metrics.json", "[]", "expected a mapping, found list"),
        ("config.yaml", "a: [", "config.yaml: not valid YAML"),
        ("config.yaml", "- a", "expected a mapping, found list"),
        ("config.yaml", b"\xff\xfe\x00", "not UTF-8"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, text: str | bytes, message: str) -> None:
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=message):
        read_reported_run(tmp_path)


def test_large_pictures_are_compressed(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    picture = inline_picture(tmp_path / "a.png")
    assert picture and picture.compressed and picture.url.startswith("data:image/webp")
    assert (picture.width, picture.height) == (400, 400)
    assert len(picture.url) < (tmp_path / "a.png").stat().st_size


def test_small_pictures_are_the_files_byte_for_byte(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (5, 3), (200, 10, 40)).save(path)
    picture = inline_picture(path)
    assert picture and not picture.compressed and base64.b64decode(picture.url.partition(",")[2]) == path.read_bytes()
    path.write_bytes(path.read_bytes()[:50])
    assert inline_picture(path) is None


def test_error_map_has_a_fixed_scale() -> None:
    truth = torch.zeros(1, 5, 3)
    rendered = truth.clone()
    rendered[0, 1] = torch.tensor([0.3, 0.0, 0.0])  # mean over channels 0.1
    rendered[0, 2] = ERROR_SCALE
    rendered[0, 3] = -5.0
    colours = error_map(rendered, truth)
    assert colours.shape == (1, 5, 3) and colours.dtype == np.uint8
    assert colours[0, 0].tolist() == [0, 0, 3] and colours[0, 4].tolist() == [0, 0, 3]  # inferno's ends
    assert colours[0, 2].tolist() == colours[0, 3].tolist() == [252, 254, 164]
    middle = error_map(torch.full((1, 1, 1), 0.5), torch.zeros(1, 1, 1), scale=1.0)
    assert colours[0, 1].tolist() == middle[0, 0].tolist()


def test_error_map_refuses_what_it_cannot_show() -> None:
    image = torch.zeros(2, 2, 3)
    with pytest.raises(NonFiniteError):
        error_map(image * float("nan"), image)
    with pytest.raises(DataError, match="shape"):
        error_map(image, torch.zeros(2, 3, 3))
    with pytest.raises(ConfigError, match="positive"):
        error_map(image, image, scale=0.0)


Pairs = list[tuple[float, float]]


def curve(training: Pairs, held_out: Pairs, unit: str, log: bool = False) -> str | None:
    """The SVG of a chart with two lines."""
    both = ((training, TRAINING), (held_out, HELD_OUT))
    lines = [ChartPoints([x for x, _ in pairs], [y for _, y in pairs], colour) for pairs, colour in both]
    return draw_svg(curve_chart("Loss", unit, lines, log))


def texts(svg: str | None) -> set[str]:
    assert svg is not None
    return set(re.findall(r"<text[^>]*>([^<]*)</text>", svg))


def test_charts_keep_text_as_text_and_follow_the_page() -> None:
    svg = curve([(1, 0.5), (50, 0.004), (100, 0.001)], [(50, 0.01)], "steps", log=True)
    assert {"0.001", "0.01", "0.1", "steps", "100"} <= texts(svg)
    assert svg is not None and "var(--training)" in svg and "var(--held-out)" in svg and "var(--muted)" in svg
    assert not re.search(r"#01020|font-family|<style|<metadata|xmlns|xlink|<!", svg)


def test_charts_of_nothing_and_of_one_point() -> None:
    assert curve([], [], "steps") is None
    assert curve([(0, 3)], [], "steps") is not None and curve([], [(7, 3)], "seconds") is not None
    assert draw_svg(view_chart("x", [None, math.inf], math.inf, None)) is None
    assert "a" in texts(draw_svg(view_chart("x", [None, 3.0, math.inf, 2.0], 2.5, "a")))
    assert draw_svg(front_chart("x", "cost", "dB", [Dot(math.nan, 3.0)])) is None


def test_a_front_is_marked_and_says_what_is_left_out() -> None:
    dots = [Dot(1.0, 30.0, reference=True), Dot(0.5, 29.9, mark="1"), Dot(0.4, 28.0, mark="2"), Dot(50.0, 31.0)]
    assert {"1", "2", "cost (1 beyond 12)"} <= texts(draw_svg(front_chart("x", "cost", "dB", dots, most=12.0)))


def test_non_finite_log_values_are_left_out_of_the_curves(tmp_path: Path) -> None:
    lines = [
        '{"step": 1, "loss": 2, "psnr": 3}',
        '{"step": 2, "loss": NaN, "psnr": Infinity}',
        '{"step": 3, "loss": null, "psnr": true}',
    ]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines))
    run = read_reported_run(tmp_path)
    assert run.last("loss") == (1, 2) and run.last("psnr") == (1, 3)
    for key, value in (("loss", 2.0), ("psnr", 3.0)):
        assert run.series("step", key) == ([1.0], [value])


def test_numbers_as_text() -> None:
    assert [format_report_duration(s) for s in (8.34, 59.97, 247, 3599.7, 7500, None, -1, math.nan)] == [
        "8.3 s", "1 min 00 s", "4 min 07 s", "1 h 00 min", "2 h 05 min", "–", "–", "–",
    ]  # fmt: skip
    assert [format_report_bytes(b) for b in (0, 999, 1234, 45_600_000, 456_700_000, 7.25e9, "x")] == [
        ("0", "B"), ("999", "B"), ("1.23", "kB"), ("45.6", "MB"), ("457", "MB"), ("7.25", "GB"), ("–", ""),
    ]  # fmt: skip
    assert [format_report_count(v) for v in (1234567, 67.25, None, math.inf)] == ["1,234,567", "67.25", "–", "–"]
    assert [format_decimal(v, 2) for v in (1.005, math.inf, -math.inf, None)] == ["1.00", "∞", "−∞", "–"]
    texts = ["–", "–", "a&quot;&lt;", "true", "[1, &quot;b&quot;]", "0.001"]
    assert [escape(v) for v in (None, "", 'a"<', True, [1, "b"], 0.001)] == texts
