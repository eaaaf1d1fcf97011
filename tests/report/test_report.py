"""The report of a run: content, escaping, and that the page stands alone."""

from __future__ import annotations

import base64
import hashlib
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
from tests.browsers import browser
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

    VOID = frozenset({"meta", "link", "img", "input"})

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
        if not {"style", "script"} & set(self.open):
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
        "generated data: not photographs", "with the last checkpoint, not the best one",
        f"PSNR {metrics['psnr']:.2f} dB mean of 4 held-out views; worst {metrics['psnr_worst']:.2f} dB (r_75)",
        f"SSIM {metrics['ssim']:.4f}", "Model file 2.68 MB 10,000 primitives",
        "Training time 11 min 04 s 4,000 iterations", "Machine 16-core CPU",
        "Parameters 670,000", "Parameters per primitive 67", "Rendering speed (cpu) 41.4 fps", "2.13.0+cpu",
        "200x200 from 800x800 by area",
        "train.iterations 30000 4000", 'model.growth null {"until": 3000}', "train.ssim true false", "neurons: 8",
        "0.2 or more", "night-view",
        "mean absolute difference",
    ):  # fmt: skip
        assert expected in text, expected
    for entry in metrics["per_view"]:
        assert f"{entry['name']} {entry['psnr']:.2f} dB PSNR {entry['ssim']:.4f} SSIM" in text
    assert f"neuprim eval '{finished}'" in text
    assert f"neuprim render '{finished}' --camera orbit" in text
    sections = ["Model", "Curves", "Held-out views", "Next steps", "Details"]
    assert re.findall("<h2>(.*?)</h2>", page) == sections


def test_the_head_names_command_date_machine_data_and_image_size(quick: Path) -> None:
    change(quick, dataset="chair", image_size=[800, 600])
    command = "neuprim run task=static 'scene.path=<my> \"data\"'"
    page = write_report(quick, command=command).read_text(encoding="utf-8")
    text = Structure(page).text
    assert f"{command} Copy Date 20" in text and page.index("neuprim run") < page.index("<h2>Model")
    assert re.search(r"Date \d{4}-\d\d-\d\d \d\d:\d\d Machine 16-core CPU Data chair Image size 800×600 Model", text)
    assert "neuprim run" not in page_of(quick), "no single command made this run"


def test_a_tile_exists_only_for_what_was_measured(quick: Path) -> None:
    def tiles() -> list[str]:
        return re.findall(r'<div class="tile"><dt>(.*?)</dt>', page_of(quick))

    assert tiles() == ["PSNR", "SSIM", "Model file", "Training time"]
    change(quick, ssim=None, train_seconds=None)
    assert tiles() == ["PSNR", "Model file"]
    change(quick, psnr=None, model_bytes=None)
    assert tiles() == [] and "last checkpoint" not in page_of(quick)


def test_the_commands_offered_are_those_of_the_task(quick: Path) -> None:
    shutil.copy(quick / "renders" / "orbit.webp", quick / "renders" / "clip_a.webp")
    fly = ["render", str(quick), "--camera", "orbit"]
    view, compress, measure = ([name, str(quick)] for name in ("view", "compress", "eval"))
    assert offered(write_report(quick)) == [view, fly, compress, measure], "films alone promise no condition"
    light = ConditionSpec("light_position", (3,), "m", (-1.0, 1.0), lambda text: [], sweep="orbit:2 3")
    page = write_report(quick, (ConditionSpec("gain", (), "1", (0.0, 1.0), lambda text: []), light))
    assert offered(page) == [view, fly, [*fly, "--light-position", "orbit:2 3"], compress, measure]
    assert "while the light position changes" in Structure(page.read_text(encoding="utf-8")).text


def test_pictures_and_charts_are_all_there(finished: Path) -> None:
    elements = Structure((finished / "report.html").read_text(encoding="utf-8")).elements
    images = [attributes for tag, attributes in elements if tag == "img"]
    assert len(images) == 3 * len(NAMES) + 1
    assert all(i["alt"] and i["width"] == "64" and i["height"] == "48" for i in images)
    kinds = [str(image["alt"]).partition(" of view ")[0] for image in images[1:]]
    assert kinds == ["ground truth", "render", "error"] * len(NAMES)
    assert sum(str(i["src"]).startswith("data:image/webp;base64,") for i in images) == 1
    labels = [attributes["aria-label"] for tag, attributes in elements if tag == "svg"]
    assert labels == ["PSNR over time", "Loss over time", "PSNR per view"]


def test_the_page_stands_alone(finished: Path) -> None:
    page = (finished / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page and "https://" not in page
    assert "@import" not in page and "pixelated" not in page, "pictures are scaled smoothly"
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in page
    assert "prefers-color-scheme: dark" in page and 'name="viewport"' in page
    assert all(address.startswith("#") for address in re.findall(r"url\((.*?)\)", page))
    ids = []
    for tag, attributes in Structure(page).elements:
        assert tag not in {"iframe", "object", "embed", "base", "form"} and (tag != "script" or not attributes)
        for key, value in attributes.items():
            assert not key.startswith("on") and key != "srcset"
            if key in {"src", "href", "xlink:href"}:
                assert str(value).startswith(("data:", "#")), (tag, key)
        if "id" in attributes:
            ids.append(attributes["id"])
    assert len(ids) == len(set(ids))
    scripts = re.findall("<script>(.*?)</script>", page, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(scripts) == 1 and f"; script-src 'sha256-{digests[0]}'\">" in page, "no other script may run"
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
    tags = [tag for tag, _ in structure.elements]
    assert "i" not in tags and tags.count("script") == 1, "the page's own"
    assert structure.text.count("<script>alert(1)</script>\"'&$x^2$<i>") >= len(strings)
    assert "</code></pre><script>bad</script>" in structure.text


def test_infinite_psnr(quick: Path) -> None:
    views = [{"name": "a", **metric_to_json("psnr", math.inf), "ssim": 1.0}, {"name": "b", "psnr": 30.0, "ssim": 0.9}]
    change(quick, per_view=views, **metric_to_json("psnr", math.inf), psnr_worst=30.0, view_worst="b")
    text = Structure(page_of(quick)).text
    assert "PSNR ∞ dB mean of 2 held-out views; worst 30.00 dB (b)" in text and "a ∞ dB PSNR 1.0000 SSIM" in text


def test_views_worse_than_nothing_and_not_measured_numbers_say_so(quick: Path) -> None:
    change(quick, worse_than_black_image=["<a>"], views_empty=2, lpips=None, not_measured={"lpips": "no weights"})
    change(quick, psnr_mask=20.0, psnr_black_image_mask=9.0, sigma_frames=[{"max_error": 0.25}, {"max_error": None}])
    text = Structure(page_of(quick)).text
    for expected in (
        "Views that are worse than a black image: 1 (<a>)",
        "Views in which no primitive is visible: 2",
        "LPIPS not measured: no weights",
        "PSNR inside the mask 20.00 dB PSNR inside the mask, black image 9.00 dB",
        "Largest error of extinction 25 % of the frame’s maximum",
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
    assert "14 more" in page and "&lt;i&gt;19" in page and "<i>" not in page
    assert page.count("worst region of view") == 20
    assert page.index("worst region of view &lt;i&gt;19") < page.index("worst region of view &lt;i&gt;18")


def test_a_browser_compares_sorts_and_copies(tmp_path: Path) -> None:
    report = write_report(make_run(tmp_path / "run"), command="neuprim run task=static")
    with browser() as found:
        page, faults = found.new_page(viewport={"width": 390, "height": 800}), []
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: faults.append(request.url) if request.url.startswith("http") else None)
        page.goto(report.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") == 390, "nothing is wider than a telephone"

        def shown() -> tuple[str, list[str]]:
            pictures = page.eval_on_selector_all(".slide img", "found => found.map(x => x.alt)")
            return str(page.inner_text(".compare figcaption")).partition(" ")[0], [str(x) for x in pictures]

        def order() -> list[str]:
            return [str(x) for x in page.eval_on_selector_all(".view h3", "found => found.map(x => x.textContent)")]

        assert shown() == ("night-view", ["ground truth of view night-view", "render of view night-view"]), "median"
        page.get_by_role("button", name="Worst view").click()
        assert shown()[0] == "r_75" and page.get_attribute("button[aria-pressed=true]", "data-view") == "view-3"
        slider = page.get_by_role("slider", name="Divider between ground truth and render")
        slider.press("ArrowRight")
        assert slider.get_attribute("aria-valuetext") == "51 % ground truth"
        box = page.locator(".slide").bounding_box()
        page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
        assert slider.input_value() == "25" and page.locator(".slide").get_attribute("style") == "--at: 25%;"
        assert order() == list(NAMES)
        page.select_option("#order", label="PSNR, lowest first")
        assert order() == [*reversed(NAMES)]
        page.select_option("#order", label="PSNR, highest first")
        assert order() == list(NAMES)
        page.get_by_role("button", name="Compare").nth(1).click()
        assert shown()[0] == "r_25"
        page.locator(".copy").first.click()
        page.get_by_role("button", name="Copied").wait_for()
        assert page.evaluate("getSelection().toString()") == "neuprim run task=static"
        assert faults == []
