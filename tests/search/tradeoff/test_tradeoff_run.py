"""``neuprim tradeoff`` on a tiny run: what it measures, keeps, writes and refuses."""

from __future__ import annotations

import csv
import html
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import neuprim.search.tradeoff.run as engine
from neuprim.cli import main
from neuprim.core import checkpoint
from neuprim.core.data import Dataset, ViewSet
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.metrics import psnr
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.search.tradeoff import memory
from neuprim.search.tradeoff.knobs import LADDERS, joined, knobs_of
from neuprim.search.tradeoff.measure import Models, take_turns
from neuprim.search.tradeoff.record import COLUMNS, Measured, Record, command, read_record
from neuprim.search.tradeoff.run import Request, seconds_of, tradeoff_run
from neuprim.search.tradeoff.subject import load_subject
from tests.lpips_weights import weights, written
from tests.search.tradeoff_runs import copied, tiny_run

QUICK = ("alpha_min", "resolution", "store", "colour.degree", "density.neurons")
"""Knobs that compile nothing more."""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    return tiny_run(tmp_path_factory.mktemp("tradeoff"))


@pytest.fixture(scope="module")
def measured(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record]:
    """The same, measured."""
    run_dir = copied(bare, tmp_path_factory.mktemp("measured") / "run it")
    return run_dir, tradeoff_run(Request(run_dir, views=2, repeats=3, knobs=QUICK, budget=120.0))


def point_of(record: Record, *words: str) -> Measured:
    found = record.find(words)
    assert found is not None, words
    return found


# ---------------------------------------------------------------- what is measured


def test_every_step_of_every_knob_is_measured(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    _, _, model, _ = load_run(run_dir)
    found = [point.knob for point in record.points]
    assert record.reference.words == () and found[0] == "reference"
    assert found.count("alpha_min") == 7 and found.count("resolution") == 3 and found.count("store") == 10
    assert found.count("colour.degree") == 3 and found.count("density.neurons") == 4 and "combined" in found
    assert len({point.words for point in record.points}) == len(record.points)
    for point in record.points:
        assert len(point.ms) == len(point.ratios) and len(point.ms) >= 3 and min(point.ms) > 0
        assert {"psnr", "ssim", "ssim_3dgs", "psnr_exact", "ssim_exact"} == point.quality.keys()
        assert point.peak_bytes is None or 0 <= point.peak_bytes < 1 << 30
    assert set(knobs_of(model)) == {*LADDERS, "colour.degree", "density.neurons"}


def test_the_reference_has_the_numbers_of_eval(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    metrics = evaluate_run(run_dir)
    quality = record.reference.quality
    assert (
        quality["psnr"] == metrics["psnr"]
        and quality["ssim"] == metrics["ssim"]
        and quality["ssim_3dgs"] == metrics["ssim_3dgs"]
    )
    assert record.reference.bytes == (run_dir / "model.safetensors").stat().st_size


def test_less_is_farther_from_the_exact_image(measured: tuple[Path, Record]) -> None:
    """These images are small enough for the oracle; the nearest to it is the one without a cut."""
    _, record = measured
    assert record.facts["exact"]["float64"] is True
    ladder = [
        point_of(record, f"renderer.alpha_min={value}").quality["psnr_exact"]
        for value in ("0", "0.0009765625", "0.0078125", "0.03125")
    ]
    assert ladder == sorted(ladder, reverse=True) and ladder[0] > 90
    sizes = [point_of(record, f"resolution={value}").quality["psnr_exact"] for value in ("0.75", "0.5", "0.25")]
    assert sizes == sorted(sizes, reverse=True)
    assert (
        point_of(record, "store.all=float16").bytes
        < point_of(record, "store.colour=float16").bytes
        < record.reference.bytes
    )


def test_where_the_oracle_takes_too_long_its_error_is_known(bare: Path) -> None:
    subject = load_subject(bare, (), 1)
    fast, slow = engine.exact_images(subject, 0.0), engine.exact_images(subject, 1e9)
    assert slow.float64 and slow.error is None and not fast.float64 and fast.checked == (24, 24)
    apart = psnr(fast.images[0], slow.images[0])
    assert fast.error is not None and 100 < fast.error <= apart + 1e-6
    found, _ = engine.look(
        subject,
        Models(subject),
        "alpha_min",
        RenderConfig(
            parse_render_config(
                ["renderer.alpha_min=0", "renderer.transmittance_min=0"], subject.config.renderer, subject.model
            ).settings
        ),
        fast,
    )
    assert found.quality["psnr_exact"] == fast.error, "equal images say no more than the exact one is known to"


def test_combinations_join_single_knobs(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    config, _, model, _ = load_run(run_dir)
    single = {point.words[0] for point in record.points if len(point.words) == 1}
    for point in record.points:
        if point.knob == "combined":
            assert len(point.words) > 1 and all(word in single or word == "store.all=float16" for word in point.words)
    reference = RenderConfig(config.renderer)
    parts = [
        parse_render_config([word], config.renderer, model)
        for word in ("renderer.alpha_min=0.25", "resolution=0.5", "store.means=float16", "colour.degree=1")
    ]
    words = ("renderer.alpha_min=0.25", "resolution=0.5", "colour.degree=1", "store.means=float16")
    assert joined(reference, parts).words(config.renderer) == words


def test_lpips_is_measured_with_weights(bare: Path, tmp_path: Path) -> None:
    run_dir = copied(bare, tmp_path / "run")
    vgg = written(tmp_path, weights("vgg"))
    record = tradeoff_run(Request(run_dir, views=1, repeats=1, knobs=["resolution"], lpips=vgg))
    assert "lpips" not in record.facts["not_measured"]
    assert all({"lpips", "lpips_3dgs"} <= point.quality.keys() for point in record.points)
    rows = list(csv.DictReader(io.StringIO((run_dir / "tradeoff" / "tradeoff.csv").read_text())))
    assert all(float(row["LPIPS"]) >= 0 for row in rows)


# ---------------------------------------------------------------- reproducing


def test_the_words_of_a_point_reproduce_its_images(measured: tuple[Path, Record], tmp_path: Path) -> None:
    """The printed command, run as it is, gives images with the point's own PSNR, to the bit."""
    run_dir, record = measured
    config, task, _, _ = load_run(run_dir)
    dataset = load_dataset(config, task)
    numbers = list(dict.fromkeys([*record.speed, *record.size]))
    assert numbers and any(record.points[i].knob == "combined" for i in numbers)
    for number in numbers:
        words = shlex.split(command(str(run_dir), record.points[number].words))
        assert words[0] == "neuprim"
        out = tmp_path / str(number)
        assert main([*words[1:], "--format", "npy", "--out", str(out)]) == 0
        drawn = [torch.from_numpy(np.load(path)) for path in sorted(out.iterdir())]
        found = [psnr(image, dataset.test.pixels(i).over(dataset.background)) for i, image in enumerate(drawn)]
        assert float(np.mean(found)) == record.points[number].quality["psnr"]


# ---------------------------------------------------------------- turns


def test_in_a_round_every_point_is_timed_once_a_view(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = load_subject(bare, (), 2)
    names = ("renderer.alpha_min=0.1", "renderer.alpha_min=0.2", "store.means=float16")
    points = [
        subject.reference,
        *(parse_render_config([name], subject.config.renderer, subject.model) for name in names),
    ]
    drawn: list[tuple[int, str]] = []
    draw = RenderConfig.draw

    def noted(self: RenderConfig, model: Any, view: Any, background: Any) -> Any:
        if view.camera.width == 24:  # not those that only warm up
            drawn.append((points.index(self), view.name))
        return draw(self, model, view, background)

    monkeypatch.setattr(RenderConfig, "draw", noted)
    pairs = [(point, Measured("", subject.words(point), {}, 0)) for point in points]
    take_turns(
        subject.truths, Models(subject).ready, pairs, lambda m: 4, 1e18, lambda number, count: None, lambda: None
    )
    assert all(len(m.ms) == 4 for _, m in pairs) and pairs[0][1].ratios == [1.0] * 4
    views = [truth.view.name for truth in subject.truths]
    assert sorted(drawn) == sorted((i, view) for i in range(4) for view in views for _ in range(8)), (
        "once to warm up, once to time"
    )
    rounds = [drawn[k : k + 8 : 2] for k in range(0, len(drawn), 8)]
    assert all({i for i, _ in one} == {0, 1, 2, 3} and len({view for _, view in one}) == 1 for one in rounds)
    assert len({tuple(i for i, _ in one) for one in rounds}) > 1, "the order changes"


def test_times_end_at_the_deadline_but_not_before_one_round(bare: Path) -> None:
    subject = load_subject(bare, (), 1)
    pairs = [(subject.reference, Measured("reference", (), {}, 0))]
    take_turns(
        subject.truths, Models(subject).ready, pairs, lambda m: 1000, 0.0, lambda number, count: None, lambda: None
    )
    assert len(pairs[0][1].ms) == 1


@pytest.mark.skipif(not memory._CLEAR.exists(), reason="needs Linux")
def test_memory_is_what_a_call_takes_at_its_peak(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def call() -> int:
        block = np.ones(40_000_000, np.uint8)
        return int(block[0])

    result, peak = memory.peak_bytes(call)
    assert result == 1 and peak is not None and 38e6 < peak < 60e6
    assert (memory.peak_bytes(lambda: 2)[1] or 0) < 5e6
    monkeypatch.setattr(memory, "_CLEAR", tmp_path / "gone" / "clear_refs")
    assert memory.peak_bytes(lambda: 3) == (3, None)


# ---------------------------------------------------------------- what is kept


def test_a_record_is_read_back_as_it_was(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    path = run_dir / "tradeoff" / "tradeoff.json"
    data = json.loads(path.read_text(), parse_constant=pytest.fail)
    again = read_record(path)
    assert again is not None and again.to_dict() == data == json.loads(json.dumps(record.to_dict()))
    assert again.points == record.points and again.left_out == record.left_out and again.speed == record.speed


def test_infinite_and_missing_numbers_survive() -> None:
    point = Measured("x", ("resolution=0.5",), {"psnr": float("inf"), "ssim": 1.0}, 3, None, [1.0], [1.0], 2)
    assert Measured.from_dict(json.loads(json.dumps(point.to_dict(), allow_nan=False))) == point


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"format": 1, "points": 3}', '{"format": 9}', '{"format": 1, "points": [{}]}']
)
def test_a_damaged_record_is_refused(bare: Path, text: str, tmp_path: Path) -> None:
    run_dir = copied(bare, tmp_path / "run")
    path = run_dir / "tradeoff" / "tradeoff.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(DataError, match="delete it to measure anew") as refused:
        tradeoff_run(Request(run_dir))
    assert str(path) in str(refused.value) and path.read_text() == text


def test_what_is_measured_is_not_measured_again(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = copied(bare, tmp_path / "run")
    request = Request(run_dir, views=1, repeats=2, knobs=["alpha_min"], budget=60.0)
    looked: list[tuple[str, ...]] = []
    turns: list[int] = []
    look, times = engine.look, engine.take_turns

    def counted(subject: Any, models: Any, knob: str, point: RenderConfig, exact: Any) -> Any:
        if len(looked) == stop:
            raise KeyboardInterrupt
        looked.append(subject.words(point))
        return look(subject, models, knob, point, exact)

    def timed(*args: Any) -> None:
        turns.append(1)
        times(*args)

    monkeypatch.setattr(engine, "look", counted)
    monkeypatch.setattr(engine, "take_turns", timed)
    stop = 3
    with pytest.raises(KeyboardInterrupt):
        tradeoff_run(request)
    stop, first = -1, list(looked)
    said: list[str] = []
    whole = tradeoff_run(request, said.append)
    assert looked[:3] == first and len(set(looked)) == len(looked) == len(whole.points) and turns
    assert any("3 points measured already are kept" in line for line in said)

    looked.clear(), turns.clear()
    again = tradeoff_run(request)
    assert looked == [] and turns == [] and again.to_dict() == whole.to_dict()
    more = tradeoff_run(Request(run_dir, views=1, repeats=4, knobs=["alpha_min", "resolution"], budget=60.0))
    assert {words[0].partition("=")[0] for words in looked if len(words) == 1} == {"resolution"}
    assert (
        all(len(point.ms) >= 4 for point in more.points)
        and more.points[: len(whole.points)][3].ms[:2] == whole.points[3].ms
    )

    header, tensors = checkpoint.read(run_dir / "model.safetensors", "model")
    tensors["means"] = tensors["means"] + 0.01
    checkpoint.write(
        run_dir / "model.safetensors",
        "model",
        tensors,
        {k: v for k, v in header.items() if k not in ("format", "kind")},
    )
    looked.clear(), said.clear()
    tradeoff_run(request, said.append)
    assert len(looked) >= 8 and any("model of before; all is measured anew" in line for line in said)


def test_what_does_not_fit_the_budget_is_left_out_and_said(bare: Path, tmp_path: Path) -> None:
    run_dir = copied(bare, tmp_path / "run")
    record = tradeoff_run(Request(run_dir, views=1, repeats=50, knobs=["alpha_min", "backend", "threads"], budget=1e-3))
    assert [point.knob for point in record.points] == ["reference"] and len(record.reference.ms) >= 1
    reasons = {" ".join(one.words): one.reason for one in record.left_out}
    assert reasons["renderer.alpha_min=0"] == "no time left of the budget of 0.001 s"
    assert "cannot run here" in reasons["renderer.backend=cuda"] or torch.cuda.is_available()
    assert (run_dir / "tradeoff" / "tradeoff.html").is_file()


def test_the_oracle_is_not_waited_for(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = copied(bare, tmp_path / "run")
    exact = engine.exact_images

    def slow(*args: Any) -> Any:
        found = exact(*args)
        return type(found)(found.images, found.float64, found.error, found.checked, found.seconds, 1e6)

    monkeypatch.setattr(engine, "exact_images", slow)
    record = tradeoff_run(Request(run_dir, views=1, repeats=1, knobs=["backend"]))
    reasons = {" ".join(one.words): one.reason for one in record.left_out}
    assert reasons["renderer.backend=reference"].startswith("its images would take about 1000000 s")


# ---------------------------------------------------------------- what is written


def test_the_table_has_the_columns_of_the_survey(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    rows = list(csv.reader(io.StringIO((run_dir / "tradeoff" / "tradeoff.csv").read_text(encoding="utf-8"))))
    assert tuple(rows[0][:6]) == COLUMNS == ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")
    assert len(rows) == len(record.points) + 1 and {len(row) for row in rows} == {len(rows[0])}
    first, quality = dict(zip(rows[0], rows[1], strict=True)), record.reference.quality
    assert first["Submethod"] == "as the run draws" and first["LPIPS"] == "" and first["#Gaussians"] == "40"
    assert float(first["PSNR"]) == pytest.approx(quality["psnr"], 1e-5) and float(first["SSIM"]) == pytest.approx(
        quality["ssim_3dgs"], 1e-5
    )
    assert int(first["Size [Bytes]"]) == record.reference.bytes
    assert [i for i, row in enumerate(rows[1:]) if row[-1] == "1"] == sorted(record.size)


def test_the_page_stands_alone_with_the_pictures_of_both_fronts(measured: tuple[Path, Record]) -> None:
    run_dir, record = measured
    page = (run_dir / "tradeoff" / "tradeoff.html").read_text(encoding="utf-8")
    assert "$" not in re.sub(r'"data:[^"]*"', "", page)
    assert not re.search(r'(?:src|href)="(?!data:|#)', page) and page.count("<svg") >= 3
    shown = re.findall(r'<img src="data:image/png;base64,[^"]+" width="24" height="24"', page)
    # on each front ground truth and reference, alone, and every other point with its difference
    points = [len({0, *front}) - 1 for front in (record.speed, record.size)]
    assert len(shown) == sum(2 + 2 * count for count in points)
    commands = [html.unescape(line) for line in re.findall(r"<code>(.*?)</code>", page)]
    fronts = [[*([] if 0 in front else [0]), *front] for front in (record.speed, record.size)]
    assert commands == [command(str(run_dir), record.points[i].words) for front in fronts for i in front]
    assert all(html.escape(point.name) in page for point in record.points)
    assert "Not measured" not in page or record.left_out
    with Image.open(run_dir / "tradeoff" / "front.png") as picture:
        assert picture.format == "PNG" and picture.width > 1000
    assert not [path for path in (run_dir / "tradeoff").iterdir() if path.name.startswith(".")]


def test_the_command_prints_the_fronts_and_their_commands(
    measured: tuple[Path, Record], capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir, record = measured
    assert main(["tradeoff", str(run_dir), "--views", "2", "--repeats", "3", "--budget", "2m", "--knobs", *QUICK]) == 0
    out, err = capsys.readouterr()
    assert f"{len(record.points)} points measured already are kept" in err
    lines = [line.rpartition("  # ")[0] for line in out.splitlines() if line.startswith("neuprim render ")]
    assert lines == [command(str(run_dir), record.points[i].words) for i in (*record.speed, *record.size)]
    assert out.index("front of speed") < out.index("front of size") and "ref." in out
    assert out.splitlines()[-4:] == [
        str(run_dir / "tradeoff" / name) for name in ("tradeoff.json", "tradeoff.csv", "tradeoff.html", "front.png")
    ]


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--knobs", "alpha_mi"], "--knobs alpha_mi: no such knob of this run; did you mean 'alpha_min'"),
        (["--knobs", "density.edge"], "--knobs density.edge: no such knob of this run; did you mean 'density.neurons'"),
        (["--budget", "5"], "--budget 5: expected a time such as 90s, 5m or 1h"),
        (["--budget", "0s"], "--budget 0s: expected a time such as 90s, 5m or 1h"),
        (["--views", "0"], "argument --views: '0': expected a positive count"),
        (["renderer.sor=entry"], "renderer.sor: no such setting; did you mean 'renderer.sort'"),
        (
            ["--knobs", "sort", "--", "renderer.sor=entry"],
            "renderer.sor: no such setting; did you mean 'renderer.sort'",
        ),
        (["--knobs", "sort", "renderer.sor=entry"], "renderer.sor: no such setting; did you mean 'renderer.sort'"),
        (["renderer.backend=cuda"], "renderer.backend=cuda cannot run here"),
        (["--knob", "sort"], "--knob: no such argument of `neuprim tradeoff`; did you mean '--knobs'"),
    ],
)
def test_wrong_words_are_one_line(bare: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "cuda" in text and torch.cuda.is_available():
        pytest.skip("there is a card")
    assert main(["tradeoff", str(bare), *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"neuprim: error: {text}") and err.count("\n") == 1
    assert not (bare / "tradeoff").exists()


def test_no_run_and_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tradeoff", str(tmp_path / "gone")]) == 2
    assert capsys.readouterr().err == f"neuprim: error: {tmp_path / 'gone'}: no such run directory\n"
    assert main(["tradeoff", str(tmp_path)]) == 2
    assert "config.yaml: missing" in capsys.readouterr().err


def test_no_held_out_views(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Nothing(ViewSet):
        def __len__(self) -> int:
            return 0

        view = pixels = None  # type: ignore[assignment]

    loaded = load_dataset(*load_run(bare)[:2])
    members = {name: getattr(loaded, name) for name in Dataset.__dataclass_fields__}
    monkeypatch.setattr(
        "neuprim.search.tradeoff.subject.load_dataset", lambda *args, **more: Dataset(**{**members, "test": Nothing()})
    )
    with pytest.raises(DataError, match="has no held-out views; expected some to measure on"):
        tradeoff_run(Request(bare))


def test_an_interruption_says_what_goes_on(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = copied(bare, tmp_path / "run")

    def stop(*args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(engine, "take_turns", stop)
    assert main(["tradeoff", str(run_dir), "--views", "1", "--knobs", "resolution"]) == 130
    assert (
        f"; {run_dir / 'tradeoff' / 'tradeoff.json'} has the points up to here; the same command goes on"
        in capsys.readouterr().err
    )
    kept = read_record(run_dir / "tradeoff" / "tradeoff.json")
    assert kept is not None and len(kept.points) == 4


def test_budgets() -> None:
    assert [seconds_of(text) for text in ("90s", "5m", "1.5h")] == [90.0, 300.0, 5400.0]
    with pytest.raises(ConfigError):
        seconds_of("5 m")


def test_other_words_are_another_reference(bare: Path, tmp_path: Path) -> None:
    run_dir = copied(bare, tmp_path / "run")
    record = tradeoff_run(
        Request(
            run_dir, views=1, repeats=1, knobs=["alpha_min"], words=["resolution=0.5", "renderer.alpha_min=0.03125"]
        )
    )
    assert record.reference.words == ("renderer.alpha_min=0.03125", "resolution=0.5")
    assert point_of(record, "renderer.alpha_min=0", "resolution=0.5").knob == "alpha_min"
    assert all("resolution=0.5" in point.words for point in record.points)
