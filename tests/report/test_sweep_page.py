"""The page of a sweep: what it says without scripts, and how it is sorted with them."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
from PIL import Image

from neuprim.report.run_record import read_reported_run
from neuprim.report.sweep_page import SweepPageRun, better_sign, write_sweep_page
from tests.browsers import browser


def run(folder: Path, psnr: float, size: int, **more: object) -> None:
    (folder / "renders").mkdir(parents=True)
    metrics = {"task": "static", "scene": "solids", "psnr": psnr, "ssim": 0.9, "model_bytes": size, "seed": 1, **more}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    lines = [{"step": s, "seconds": s / 10, "eval_psnr": psnr - 10 + s} for s in (5, 10)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "report.html").touch()
    for kind, colour in (("", "red"), ("_truth", "blue"), ("_error", "black")):
        Image.new("RGB", (8, 8), colour).save(folder / "renders" / f"test_000_r_0{kind}.png")


def sweep(folder: Path) -> Path:
    numbers = {"a&b": (20.0, 3000), "<best>": (30.0, 5000), "small": (10.0, 1000)}
    runs = []
    for name, (psnr, size) in numbers.items():
        run(folder / name, psnr, size, lpips=None if name == "small" else 0.1 + psnr / 100)
        attempts, swept = 2 if name == "small" else 1, {"model.primitives": str(size)}
        runs.append(SweepPageRun(name, swept, "done", "", 2.0, attempts, read_reported_run(folder / name)))
    runs.append(
        SweepPageRun(
            "gone", {"model.primitives": "7"}, "failed", "no <images>", 0.1, 1, read_reported_run(folder / "gone")
        )
    )
    return write_sweep_page(folder, runs, ["task=static", "model.primitives=1,2"])


def test_it_stands_without_scripts_in_the_order_of_psnr(tmp_path: Path) -> None:
    text = sweep(tmp_path).read_text()
    names = ["&lt;best&gt;", "a&amp;b", "small", "gone"]
    places = [text.index(f'data-run="{name}"') for name in names]
    assert places == sorted(places)
    assert (
        '<td class="best" data-value="30.0">30.00 dB</td>' in text
        and '<td class="best" data-value="1000.0">1 kB</td>' in text
    )
    assert (
        "neuprim run -m task=static model.primitives=1,2" in text
        and "<strong>gone failed:</strong> no &lt;images&gt;" in text
    )
    assert 'href="%3Cbest%3E/report.html"' in text and "<td>done</td><td>2</td>" in text
    assert text.count("<figure data-run=") == 3 and text.count("ground truth</figcaption>") == 1
    colours = set(re.findall(r'class="chip" style="background: (#\w+)"', text))
    assert len(colours) == 4 and sum(text.count(colour) >= 4 for colour in colours) == 3, "table, key, both charts"
    assert "http" not in text.replace("http-equiv", "").replace("http://www.w3.org", ""), "nothing is loaded"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *(("psnr", 1), ("psnr_mask", 1), ("lpips_3dgs", -1), ("render_fps", 1), ("sigma_max_error", -1)),
        *(("parameters_per_primitive", 0), ("iterations", 0), ("glow", 0), ("psnrx", 0)),
    ],
)
def test_what_is_better_is_said_where_it_is_known(name: str, expected: int) -> None:
    assert better_sign(name) == expected


def test_of_many_runs_the_best_are_pictured_and_infinite_numbers_sort(tmp_path: Path) -> None:
    runs = []
    for n in range(9):
        run(tmp_path / str(n), 10.0 + n, 100, psnr_infinite=n == 3)
        runs.append(SweepPageRun(str(n), {}, "done", "", 1.0, 1, read_reported_run(tmp_path / str(n))))
    text = write_sweep_page(tmp_path, runs, []).read_text()
    assert runs[3].numbers["psnr"] == math.inf and 'data-value="Infinity">∞' in text
    assert "8 of 9 runs, those with the best PSNR" in text


def test_a_browser_sorts_and_ranks(tmp_path: Path) -> None:
    file = sweep(tmp_path)
    with browser() as found:
        page, faults = found.new_page(), []
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(file.as_uri())

        def order(selector: str) -> list[str]:
            return [str(x) for x in page.eval_on_selector_all(selector, "found => found.map(x => x.dataset.run)")]

        assert order("table.runs tbody tr") == ["<best>", "a&b", "small", "gone"]
        assert page.inner_text("#best") == "<best>: 30.00 dB"
        page.select_option("#metric", "model_bytes")
        assert (
            order("table.runs tbody tr") == ["small", "a&b", "<best>", "gone"]
            and page.inner_text("#best") == "small: 1 kB"
        )
        assert order(".pictures figure[data-run]") == ["small", "a&b", "<best>"]
        page.select_option("#metric", "lpips")
        assert order("table.runs tbody tr")[:2] == ["a&b", "<best>"], "less is better; those without come last"
        page.click("table.runs thead th:first-child button")
        assert order("table.runs tbody tr") in (["<best>", "a&b", "gone", "small"], ["a&b", "<best>", "gone", "small"])
        page.click("table.runs thead th:first-child button")
        assert order("table.runs tbody tr")[:2] == ["small", "gone"]
        assert faults == []
