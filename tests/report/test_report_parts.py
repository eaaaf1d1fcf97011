"""The report's parts: reading a run directory, error maps, worst regions, pictures, charts, numbers as text."""

from __future__ import annotations

import base64
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.errors import DataError, NonFiniteError
from neuprim.core.metrics import metric_to_json
from neuprim.report.charts import HELD_OUT, TRAINING, ChartPoints, Dot, curve_chart, draw_svg, front_chart
from neuprim.report.pictures import ERROR_SCALE, MAX_REGIONS, WorstRegions, error_map, inline_picture, worst_region
from neuprim.report.report_page import (
    escape,
    format_decimal,
    format_report_bytes,
    format_report_count,
    format_report_duration,
)
from neuprim.report.run_record import median_and_worst, read_reported_run


@pytest.mark.parametrize("text", [b"{", b"[]", b"\xff\xfe\x00", b"[" * 100_000])
def test_damaged_metrics_are_named(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "metrics.json").write_bytes(text)
    with pytest.raises(DataError, match=r"metrics\.json: "):
        read_reported_run(tmp_path)


def test_views_are_told_apart_by_index(tmp_path: Path) -> None:
    folder = tmp_path / "renders"
    folder.mkdir()
    for stem in ("010_a", "002_x_truth", "1000_b", "note", "003_unfinished"):
        for kind in ("", "_truth", "_error") if "unfinished" not in stem else ("", "_truth"):
            (folder / f"test_{stem}{kind}.png").touch()
    views = read_reported_run(tmp_path).views
    assert [(v.index, v.stem) for v in views] == [(2, "x_truth"), (10, "a"), (1000, "b")]
    assert views[0].truth == folder / "test_002_x_truth_truth.png"
    assert views[0].error == folder / "test_002_x_truth_error.png"


@pytest.mark.parametrize(
    ("psnrs", "expected"),
    [
        ([], ()), ([None], ()), ([3.0], (0,)), ([4.0, 3.0], (1,)), ([5.0, 3.0, 4.0], (2, 1)),
        ([5.0, None, 3.0, 4.0, math.inf], (3, 2)), ([7.0, 7.0, 7.0], (1, 0)),
    ],
)  # fmt: skip
def test_the_median_and_the_worst_view(psnrs: list[float | None], expected: tuple[int, ...]) -> None:
    assert median_and_worst([metric_to_json("psnr", x) if x else {"psnr": None} for x in psnrs]) == expected


def test_large_pictures_are_compressed(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    picture = inline_picture(tmp_path / "a.png")
    assert picture and picture.url.startswith("data:image/webp")
    assert (picture.width, picture.height) == (400, 400)
    assert len(picture.url) < (tmp_path / "a.png").stat().st_size


def test_small_pictures_are_the_files_byte_for_byte(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (5, 3), (200, 10, 40)).save(path)
    picture = inline_picture(path)
    assert picture and base64.b64decode(picture.url.partition(",")[2]) == path.read_bytes()
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


@pytest.mark.parametrize(("x", "y"), [(0, 0), (80, 0), (0, 60), (90, 65), (41, 23)])
def test_the_worst_region_is_where_the_error_is(x: int, y: int) -> None:
    truth = torch.full((80, 120, 3), 0.4)
    rendered = truth + 0.01
    rendered[y : y + 10, x : x + 10] += 0.5
    region = worst_region("a", rendered, truth)
    assert region.side == 20
    assert region.x <= x and region.y <= y and region.x + 20 >= min(x + 10, 120) and region.y + 20 >= min(y + 10, 80)
    own = -10 * math.log10((region.of(rendered) - region.of(truth)).double().square().mean().item())
    assert region.psnr == pytest.approx(own, abs=1e-6) and region.psnr < 13
    small = worst_region("a", rendered[:9, :30], truth[:9, :30])
    assert small.side == 9 and worst_region("a", truth, truth).psnr == math.inf


def test_the_worst_regions_are_kept_and_the_exact_views_left_out(tmp_path: Path) -> None:
    regions, truth = WorstRegions(lambda x: x), torch.full((40, 40, 3), 0.4)
    regions.add_view("same", truth, truth)
    assert regions.write(tmp_path) == []
    for i in range(2 * MAX_REGIONS):
        regions.add_view(f"v{i}", truth + 0.1 + 0.001 * ((i * 37) % (2 * MAX_REGIONS)), truth)
    found = regions.write(tmp_path)
    values = [region.psnr for region, _ in found]
    assert len(found) == MAX_REGIONS and values == sorted(values)
    with Image.open(found[0][1]) as image:
        assert image.size == (48, 16)
        assert image.getpixel((4, 4)) == (102, 102, 102), "the truth stands first"


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
    assert draw_svg(front_chart("x", "cost", "dB", [Dot(math.nan, 3.0)])) is None


def test_a_front_is_marked_and_says_what_is_left_out() -> None:
    dots = [Dot(1.0, 30.0, reference=True), Dot(0.5, 29.9, mark="1"), Dot(0.4, 28.0, mark="2"), Dot(50.0, 31.0)]
    assert {"1", "2", "cost (1 beyond 12)"} <= texts(draw_svg(front_chart("x", "cost", "dB", dots, most=12.0)))


def test_unreadable_lines_and_non_finite_values_are_left_out_of_the_curves(tmp_path: Path) -> None:
    lines = [
        '{"step": 1, "loss": 2, "psnr": 3}',
        '{"step": 2, "loss": NaN, "psnr": Infinity}',
        '{"step": 3, "loss": null, "psnr": true}',
        "[1]",
        '{"step": 4, "lo',
    ]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines))
    run = read_reported_run(tmp_path)
    for key, value in (("loss", 2.0), ("psnr", 3.0)):
        assert run.series("step", key) == ([1.0], [value])


def test_numbers_as_text() -> None:
    assert [format_report_duration(s) for s in (8.34, 59.97, 247, 3599.7, 7500, None, math.nan)] == [
        "8.3 s", "1 min 00 s", "4 min 07 s", "1 h 00 min", "2 h 05 min", "–", "–",
    ]  # fmt: skip
    assert [format_report_bytes(b) for b in (0, 999, 1234, 45_600_000, 456_700_000, 7.25e9, "x")] == [
        "0 B", "999 B", "1.23 kB", "45.6 MB", "457 MB", "7.25 GB", "–",
    ]  # fmt: skip
    assert [format_report_count(v) for v in (1234567, 67.25, None, math.inf)] == ["1,234,567", "67.25", "–", "–"]
    assert [format_decimal(v, 2) for v in (1.005, math.inf, -math.inf, None)] == ["1.00", "∞", "−∞", "–"]
    texts = ["–", "–", "a&quot;&lt;", "true", "[1, &quot;b&quot;]", "0.001"]
    assert [escape(v) for v in (None, "", 'a"<', True, [1, "b"], 0.001)] == texts
