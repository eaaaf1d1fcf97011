"""The report of a run: content, escaping, and that the page stands alone."""

from __future__ import annotations

import html.parser
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.metrics import metric_to_json, psnr, ssim
from neuprim.core.model.fields import ConditionSpec
from neuprim.report.pictures import WorstRegions, error_map
from neuprim.report.run_report import write_report
from tests.reports import offered

NAMES = ("r_0", "r_25", "night-view", "r_75")


def scene(height: int, width: int, turn: float) -> torch.Tensor:
    """Smooth waves, turned a little for every view; float64 sRGB."""
    y, x = np.mgrid[:height, :width] / 10
    return torch.from_numpy(0.5 + 0.4 * np.stack([np.sin(x + turn), np.sin(y - turn), np.sin(x + y)], -1))


def blurred(image: torch.Tensor, seed: int) -> torch.Tensor:
    """What an imperfect model might render."""
    noise = np.random.default_rng(seed).standard_normal(image.shape) * (0.006 + 0.008 * seed)
    return (image + torch.from_numpy(noise)).clamp(0, 1)


def save(path: Path, image: Any) -> None:
    pixels = image if isinstance(image, np.ndarray) else (image * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(path)


def make_run(folder: Path, size: tuple[int, int] = (48, 64), lines: int = 400, names: tuple[str, ...] = NAMES) -> Path:
    """A run directory as training leaves it, with pictures and numbers that belong together."""
    (folder / "renders").mkdir(parents=True)
    entries = []
    for i, name in enumerate(names):
        truth = scene(*size, turn=0.8 * i)
        rendered = blurred(truth, i)
        base = folder / "renders" / f"test_{i:03d}_{name}"
        save(Path(f"{base}.png"), rendered)
        save(Path(f"{base}_truth.png"), truth)
        save(Path(f"{base}_error.png"), error_map(rendered, truth))
        numbers = {**metric_to_json("psnr", psnr(rendered, truth)), "ssim": ssim(rendered, truth)}
        entries.append({"name": name, **numbers, "seconds": 0.021})
    frames = [Image.fromarray((scene(*size, 0.5 * k).numpy() * 255).astype(np.uint8)) for k in range(6)]
    frames[0].save(folder / "renders" / "orbit.webp", save_all=True, append_images=frames[1:])
    metrics: dict[str, Any] = {
        "task": "static", "scene": "chequered-ball", "split": "test", "data_source": "generated",
        "psnr": float(np.mean([e["psnr"] for e in entries])), "ssim": float(np.mean([e["ssim"] for e in entries])),
        "psnr_worst": min(e["psnr"] for e in entries), "view_worst": "r_75", "per_view": entries,
        "primitives": 10_000, "parameters": 670_000, "parameters_per_primitive": 67, "model_bytes": 2_684_112,
        "iterations": 4000, "train_seconds": 664.2, "render_fps": 41.37, "backend": "cpu", "device": "16-core CPU",
        "checkpoint": "last", "downsampling": "200x200 from 800x800 by area", "background": [1.0, 1.0, 1.0], "seed": 0,
        "color_space": "srgb",
        "versions": {"neuprim": "0.1.0", "torch": "2.13.0+cpu", "python": "3.11.2", "numpy": "2.3.0"},
        "non_default": {"train.iterations": [30000, 4000], "scene.downsample": [1, 4],
            "model.growth": [None, {"until": 3000}], "train.ssim": [True, False]},
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    steps = range(10, 10 * lines + 1, 10)
    log = [{"step": n, "seconds": 0.085 * n, "loss": 1 / n, "psnr": 12 + n / 900, "primitives": 2 * n} for n in steps]
    log += [{"step": n, "seconds": 0.085 * n, "eval_psnr": 11 + n / 900} for n in steps[24::25]]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    (folder / "config.yaml").write_text("task: static\nmodel:\n  neurons: 8\n", encoding="utf-8")
    return folder


def change(run: Path, **entries: Any) -> None:
    """Set entries of metrics.json."""
    path = run / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | entries), encoding="utf-8")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run and its report; tests only read it."""
    run = make_run(tmp_path_factory.mktemp("runs") / "static,scene=ball 1")
    assert write_report(run) == run / "report.html"
    return run


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tiny finished run to change, for tests that do not look at its charts (which take most of the time)."""
    monkeypatch.setattr("neuprim.report.run_report._report_curves", lambda run: "")
    return make_run(tmp_path / "run", size=(8, 10), lines=4, names=("a", "b"))


def page_of(run: Path) -> str:
    return write_report(run).read_text(encoding="utf-8")


class Structure(html.parser.HTMLParser):
    """Collects elements, and asserts that every element that opens also closes in order."""

    VOID = frozenset({"meta", "link", "img"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def test_a_finished_run_shows_what_it_measured(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text(encoding="utf-8"))
    page = (finished / "report.html").read_text(encoding="utf-8")
    text = Structure(page).text
    assert "<title>static / chequered-ball – neuprim</title>" in page
    for expected in (
        "generated data: not photographs", "Metrics of the last checkpoint, not the best.",
        f"PSNR, mean {metrics['psnr']:.2f} dB 4 test views",
        f"PSNR, worst view {metrics['psnr_worst']:.2f} dB r_75", f"SSIM {metrics['ssim']:.4f}", "Primitives 10,000",
        "670,000 67 per primitive",
        "2.68 MB", "11 min 04 s 4,000 iterations", "41.4 fps cpu", "16-core CPU", "2.13.0+cpu",
        "200x200 from 800x800 by area",
        "train.iterations 30000 4000", 'model.growth null {"until": 3000}', "train.ssim true false", "neurons: 8",
        "≥ 0.2", "night-view",
        "mean absolute difference",
    ):  # fmt: skip
        assert expected in text, expected
    for entry in metrics["per_view"]:
        assert f"{entry['name']} {entry['psnr']:.2f} dB PSNR {entry['ssim']:.4f} SSIM" in text
    assert f"neuprim eval '{finished}'" in text
    assert f"neuprim render '{finished}' --camera orbit" in text


def test_the_commands_offered_are_those_of_the_task(quick: Path) -> None:
    shutil.copy(quick / "renders" / "orbit.webp", quick / "renders" / "clip_a.webp")
    eval_it, fly = ["eval", str(quick)], ["render", str(quick), "--camera", "orbit"]
    assert offered(write_report(quick)) == [eval_it, fly], "films alone promise no condition"
    light = ConditionSpec("light_position", (3,), "m", (-1.0, 1.0), lambda text: [], sweep="orbit:2 3")
    page = write_report(quick, (ConditionSpec("gain", (), "1", (0.0, 1.0), lambda text: []), light))
    assert offered(page) == [eval_it, fly, [*fly, "--light-position", "orbit:2 3"]]
    assert "while the light position changes" in Structure(page.read_text(encoding="utf-8")).text


def test_pictures_and_charts_are_all_there(finished: Path) -> None:
    elements = Structure((finished / "report.html").read_text(encoding="utf-8")).elements
    images = [attributes for tag, attributes in elements if tag == "img"]
    assert len(images) == 3 * len(NAMES) + 1
    assert all(
        i["alt"] and i["width"] == "64" and i["height"] == "48" and i.get("class") == "pixelated" for i in images
    )
    assert sum(str(i["src"]).startswith("data:image/webp;base64,") for i in images) == 1
    labels = [attributes["aria-label"] for tag, attributes in elements if tag == "svg"]
    lines = ["PSNR over time", "Loss over time", "Primitives over time", "PSNR over steps", "Loss over steps"]
    assert labels == [*lines, "PSNR per view"]


def test_the_page_stands_alone(finished: Path) -> None:
    page = (finished / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page and "https://" not in page
    assert "@import" not in page and "<script" not in page
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in page
    assert "prefers-color-scheme: dark" in page and 'name="viewport"' in page
    assert all(address.startswith("#") for address in re.findall(r"url\((.*?)\)", page))
    ids = []
    for tag, attributes in Structure(page).elements:
        assert tag not in {"script", "iframe", "object", "embed", "base", "form"}
        for key, value in attributes.items():
            assert not key.startswith("on") and key != "srcset"
            if key in {"src", "href", "xlink:href"}:
                assert str(value).startswith(("data:", "#")), (tag, key)
        if "id" in attributes:
            ids.append(attributes["id"])
    assert len(ids) == len(set(ids))
    references = set(re.findall(r'(?:href="|url\()#([^")]+)', page))
    assert references and references <= set(ids)


@pytest.mark.parametrize(
    ("entries", "badge"),
    [
        ({"data_source": "real"}, None),
        ({"data_source": "simulated"}, "simulated data: not captured"),
        ({"data_source": "dreamt"}, "dreamt"),
        ({"data_source": "generated", "rendered_from": "a.glb"}, "generated data: rendered from a.glb"),
    ],
)
def test_badge(quick: Path, entries: dict[str, str], badge: str | None) -> None:
    change(quick, **entries)
    page = page_of(quick)
    assert ('class="badge"' in page) == (badge is not None)
    assert badge is None or f'class="badge">{badge}<' in page


def test_everything_from_outside_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>\"'&$x^2$<i>"
    run = make_run(tmp_path / "a <i> & 'b' \"c\"", size=(8, 10), lines=3, names=("a",))
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    strings = {key: evil for key, value in metrics.items() if isinstance(value, str)}
    views = [{"name": evil, "psnr": 20.0, "ssim": 0.5}, {"name": "z", "psnr": 30.0, "ssim": 0.5}]
    changed = {evil: [evil, [evil]], "plain": [None, evil]}
    change(run, **strings, per_view=views, versions={evil: evil}, non_default=changed, background=[evil])
    (run / "config.yaml").write_text("x: '</code></pre><script>bad</script>'\n", encoding="utf-8")
    page = page_of(run)
    structure = Structure(page)
    assert not {"script", "i"} & {tag for tag, _ in structure.elements}
    assert structure.text.count("<script>alert(1)</script>\"'&$x^2$<i>") >= len(strings)
    assert "</code></pre><script>bad</script>" in structure.text


def test_infinite_psnr(quick: Path) -> None:
    views = [{"name": "a", **metric_to_json("psnr", math.inf), "ssim": 1.0}, {"name": "b", "psnr": 30.0, "ssim": 0.9}]
    change(quick, per_view=views, **metric_to_json("psnr", math.inf), psnr_worst=30.0, view_worst="b")
    text = Structure(page_of(quick)).text
    assert "PSNR, mean ∞ dB" in text and "a ∞ dB PSNR 1.0000 SSIM" in text and "PSNR, worst view 30.00 dB b" in text


def test_views_worse_than_nothing_and_not_measured_numbers_say_so(quick: Path) -> None:
    change(quick, worse_than_black_image=["<a>"], views_empty=2, lpips=None, not_measured={"lpips": "no weights"})
    change(quick, psnr_mask=20.0, psnr_black_image_mask=9.0, sigma_frames=[{"max_error": 0.25}, {"max_error": None}])
    text = Structure(page_of(quick)).text
    for expected in (
        *(
            "1 view is worse than a black image , which the mean hides: <a>.",
            "Empty views 2",
            "not measured: no weights",
        ),
        *("20.00 dB where anything ever is; a black image: 9.0 dB", "Largest error of extinction 25 %"),
    ):
        assert expected in text, expected


def test_the_worst_regions_come_first_and_the_rest_is_folded(quick: Path) -> None:
    regions = WorstRegions(lambda x: x)
    for i in range(20):
        truth = torch.full((40, 40, 3), 0.4)
        rendered = truth.clone()
        rendered[8:18, 8:18] += 0.1 + 0.02 * i
        regions.add_view(f"<i>{i}", rendered, truth)
    page = write_report(quick, regions=regions.write(quick / "renders")).read_text(encoding="utf-8")
    assert "8 more" in page and "&lt;i&gt;19" in page and "<i>" not in page
    assert page.count("worst region of view") == 20
    assert page.index("worst region of view &lt;i&gt;19") < page.index("worst region of view &lt;i&gt;18")
