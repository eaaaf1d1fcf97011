"""The worst region of every held-out view: found where the error is, written worst first, shown, and never a way into
other files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.report import write_report
from neuprim.report.regions import MAX_REGIONS, MIN_SIDE, REGIONS_FILE, WorstRegions, read_regions, worst_region


def pair(height: int, width: int, x: int, y: int, size: int, off: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    """(rendered, truth) that differ by ``off`` in one square and a little everywhere."""
    truth = torch.full((height, width, 3), 0.4)
    rendered = truth + 0.01
    rendered[y : y + size, x : x + size] = truth[0, 0] + off
    return rendered, truth


@pytest.mark.parametrize(("x", "y"), [(0, 0), (80, 0), (0, 60), (90, 65), (41, 23)])
def test_it_is_where_the_error_is(x: int, y: int) -> None:
    rendered, truth = pair(80, 120, x, y, 10)
    region = worst_region(rendered, truth)
    assert region.side == 20
    assert region.x <= x and region.y <= y and region.x + 20 >= min(x + 10, 120) and region.y + 20 >= min(y + 10, 80)
    own = -10 * math.log10((region.of(rendered) - region.of(truth)).double().square().mean().item())
    assert region.psnr == pytest.approx(own, abs=1e-6) and region.psnr < 13


def test_small_and_perfect_images(tmp_path: Path) -> None:
    rendered, truth = pair(9, 30, 20, 3, 4)
    region = worst_region(rendered, truth)
    assert region.side == 9 < MIN_SIDE and (region.y, 12 <= region.x <= 20) == (0, True)
    assert worst_region(truth, truth).psnr == math.inf
    regions = WorstRegions(lambda x: x)
    regions.add_view("same", truth, truth)
    regions.write(tmp_path)
    assert json.loads((tmp_path / REGIONS_FILE).read_text()) == [] and read_regions(tmp_path) == []


def test_the_worst_come_first_and_not_all_are_kept(tmp_path: Path) -> None:
    regions = WorstRegions(lambda x: x)
    for i in range(3 * MAX_REGIONS):
        rendered, truth = pair(40, 40, 8, 8, 10, off=0.1 + 0.9 * ((i * 37) % (3 * MAX_REGIONS)) / (3 * MAX_REGIONS))
        regions.add_view(f"v{i}", rendered, truth)
    regions.write(tmp_path)
    found = read_regions(tmp_path)
    values = [one.psnr for one in found]
    assert len(found) == MAX_REGIONS and values == sorted(values) and found[0].place.startswith("16×16 at (")
    with Image.open(found[0].path) as image:
        assert image.size == (48, 16)
        assert image.getpixel((4, 4)) == (102, 102, 102), "the truth stands first"


def test_the_page_shows_them(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "renders").mkdir(parents=True)
    (run / "config.yaml").write_text("task: static\n")
    assert "Worst regions" not in write_report(run).read_text(encoding="utf-8"), "older runs have none"
    regions = WorstRegions(lambda x: x)
    for i in range(20):
        regions.add_view(f"<i>{i}", *pair(40, 40, 8, 8, 10, off=0.1 + 0.02 * i))
    regions.write(run / "renders")
    page = write_report(run).read_text(encoding="utf-8")
    assert "Worst regions" in page and "8 more" in page and "&lt;i&gt;19" in page and "<i>" not in page
    assert page.count("worst region of view") == 20


def test_a_list_from_elsewhere_reads_no_other_file(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "test_0_x.png")
    folder = tmp_path / "renders"
    folder.mkdir()
    good = {"file": "worst_000.png", "name": "x", "x": 0, "y": 0, "side": 4, "psnr": 10.0}
    Image.new("RGB", (4, 4)).save(folder / "worst_000.png")
    wrong = [
        good | {"file": "../secret.png"},
        good | {"file": "worst_../secret.png"},
        good | {"psnr": "1"},
        good | {"x": 0.5},
        good | {"file": "worst_9.png"},
        3,
    ]
    (folder / REGIONS_FILE).write_text(json.dumps([*wrong, good]))
    assert [one.path.name for one in read_regions(folder)] == ["worst_000.png"]
    for text in ("{", "{}", "[" * 100_000):
        (folder / REGIONS_FILE).write_text(text)
        with pytest.raises(DataError, match=r"worst\.json"):
            read_regions(folder)
