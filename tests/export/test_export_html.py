"""`neuprim export --format html`: the page of a run, with or without its data, and the page inside of a run's
report."""

from __future__ import annotations

import html
import math
import re
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError
from neuprim.report.run_report import VIEWER_LIMIT, Viewer, write_report
from neuprim.runs.export import export_run
from neuprim.runs.open import open_run
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.webpage.model_page import held_out_webpage_views
from tests.core import tiny
from tests.page_models import header_of, random_model
from tests.plugins import marked
from tests.short_runs import fit, words


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    return fit(words(tiny.write_blender(folder / "scene"), folder / "run", 20))


def test_a_run_with_its_data(trained: Path, tmp_path: Path) -> None:
    report = export_run(trained, "html", tmp_path / "p.html", ["views=2"])
    header = header_of((tmp_path / "p.html").read_text(encoding="utf-8"))
    assert len(header["views"]) == 2
    assert all(view["truth"].startswith("data:image/webp;base64,") for view in header["views"])
    assert header["home"] == header["views"][0]["camera"] and header["count"] == 40
    assert not report.lossless and report.errors["psnr"] > 50
    assert any("MB" in note for note in report.notes)


def test_a_page_begins_where_something_is_to_be_seen(tmp_path: Path) -> None:
    """The first frame of a sequence may be empty."""
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "vdb"))
    dataset = open_run(run).dataset()
    views = held_out_webpage_views(dataset, open_run(run).channels, 4)
    picked = {
        view.name: float(dataset.test.pixels(i).over(dataset.background).std())
        for i, view in enumerate(map(dataset.test.view, range(len(dataset.test))))
    }
    assert len(views) == 4 and max(picked[view.name] for view in views) == pytest.approx(picked[views[0].name], rel=0.2)


def test_a_sequence_plays_its_frames_at_a_rate(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", tmp_path / "no files", data={"frames": [1001, 1049]})
    for more, period in (([], 6.0), (["fps=24"], 2.0)):
        path = export_run(run, "html", tmp_path / f"{period}.html", ["views=0", "--time=0.5", *more]).files[0]
        (time,) = header_of(path.read_text(encoding="utf-8"))["conditions"]
        assert time["frames"] == [1001, 1049] and time["period"] == period
    plain = marked.dynamic_run(tmp_path / "plain", tmp_path / "no files")
    with pytest.raises(ConfigError, match="fps: the model has no numbered frames"):
        export_run(plain, "html", tmp_path / "plain.html", ["views=0", "--time=0.5", "fps=24"])


@pytest.mark.parametrize("start", [0.1, 0.9])
@pytest.mark.parametrize("active", ["late", "never", "no primitive"])
def test_a_page_of_what_is_not_active(active: str, start: float, tmp_path: Path) -> None:
    """Nothing is active at time 0.1; the page looks at where something is later, if anything ever is."""
    model = random_model(
        TimeDensity(2, "window", edge=2),
        TimeHarmonics(0, powers=1, waves=0),
        count=0 if active == "no primitive" else 40,
    )
    model.params["means"] += 7.0
    model.params["log_window"].fill_(math.log(0.05))
    model.params["window_center"].fill_(9.0 if active == "never" else 0.9)
    run = marked.write_run(
        tmp_path / "run", model, ["task=dynamic", "scene=vdb", f"scene.vdb={tmp_path / 'gone'}"], color_space="linear"
    )
    report = export_run(run, "html", tmp_path / "p.html", [f"--time={start}"])
    header = header_of((tmp_path / "p.html").read_text(encoding="utf-8"))
    assert header["conditions"][0]["value"] == pytest.approx(start) and header["count"] == model.count
    if active == "late":
        assert header["center"] == pytest.approx([7.0] * 3, abs=1.0) and 1.0 < header["radius"] < 5.0
        assert 30 < report.errors["psnr"] < math.inf
    else:
        assert report.errors["psnr"] == math.inf
        with pytest.raises(ConfigError, match="no primitive absorbs anything under these conditions"):
            export_run(run, "gaussian-ply", tmp_path / "g.ply", [f"--time={start}"])


def test_levels_lose_what_they_say(trained: Path, tmp_path: Path) -> None:
    errors = [
        export_run(trained, "html", tmp_path / f"{level}.html", [f"level={level}", "views=1"]).errors
        for level in (0, 1, 5)
    ]
    assert errors[0] == {} and math.inf > errors[1]["psnr"] > errors[2]["psnr"] + 6
    with pytest.raises(ConfigError, match=r"^level: found 6; expected a whole number from 0 to 5|^level"):
        export_run(trained, "html", tmp_path / "x.html", ["level=6"])


def test_a_run_without_its_data(trained: Path, tmp_path: Path) -> None:
    """No cameras to jump to, and a note that says why."""
    config = (trained / "config.yaml").read_text(encoding="utf-8")
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "config.yaml").write_text(
        config.replace(str(trained.parent / "scene"), str(tmp_path / "gone")), encoding="utf-8"
    )
    (copy / "model.safetensors").write_bytes((trained / "model.safetensors").read_bytes())
    report = export_run(copy, "html", tmp_path / "p.html")
    assert any(note.startswith("no held-out cameras: ") and "gone" in note for note in report.notes)
    header = header_of((tmp_path / "p.html").read_text(encoding="utf-8"))
    assert header["views"] == [] and report.errors["psnr"] > 50


# ---------------------------------------------------------------- in the report


def test_the_report_of_a_run_holds_its_page(trained: Path) -> None:
    text = (trained / "report.html").read_text(encoding="utf-8")
    frame = re.search(r'<iframe [^>]*srcdoc="([^"]*)"', text)
    assert frame and not (trained / "viewer.html").exists()
    page = html.unescape(frame[1])
    header = header_of(page)
    assert header["count"] == 40 and not any(view["truth"] for view in header["views"]), "the report shows them"
    inner, outer = (re.search(r"script-src (?:'sha256-\S+' )?'nonce-(\w+)'", part) for part in (page, text))
    assert inner and outer and inner[1] == outer[1] and len(text.encode()) < VIEWER_LIMIT


def test_a_large_page_lies_beside_the_report(trained: Path) -> None:
    viewer = Viewer("<!doctype html><p>" + "x" * VIEWER_LIMIT, "nonce")
    text = write_report(trained, viewer=viewer).read_text(encoding="utf-8")
    assert (trained / "viewer.html").read_text(encoding="utf-8") == viewer.text
    assert '<a href="viewer.html">' in text and "iframe title" not in text and "nonce" not in text
    write_report(trained)
    assert not (trained / "viewer.html").exists(), "of an earlier report"
