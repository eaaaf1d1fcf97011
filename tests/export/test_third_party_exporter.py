"""Tasks, exporters and inspectors of other packages: conditions in every command, options, and no file overwritten."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.core.errors import ConfigError
from neuprim.core.io.vdb import read_grid
from neuprim.plugins.registry import PluginError
from neuprim.runs.export import export_run, import_run_directory
from neuprim.runs.inspect import InspectRequest, inspect_run
from tests.plugins.strangers import EXPORTER, INSPECTOR, add, run_dir, site

__all__ = ["run_dir", "site"]

SPELLINGS = [["--wavelength-shift", "X"], ["--wavelength_shift=X"]]


def call(*words: str | Path) -> int:
    return main([str(word) for word in words])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    error = capsys.readouterr().err
    assert error.startswith("neuprim: error: ") and error.count("\n") == 1 and "Traceback" not in error
    return error


def entries(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


# ---------------------------------------------------------------- conditions


@pytest.mark.parametrize("spelling", SPELLINGS, ids=lambda words: " ".join(words))
def test_one_spelling_of_a_condition_serves_every_command(spelling: list[str], run_dir: Path, tmp_path: Path) -> None:
    def words(text: str) -> list[str]:
        return [word.replace("X", text) for word in spelling]

    size = ["--camera", "orbit", "--frames", "1", "--size", "16x16", "--format", "png"]
    for i, text in enumerate(("0.2", "1", "0.2,1")):
        assert call("render", run_dir, *words(text), *size, "--out", tmp_path / f"r{i}") == 0
    alone = [next((tmp_path / f"r{i}").iterdir()).read_bytes() for i in (0, 1)]
    assert alone[0] != alone[1]
    assert [p.read_bytes() for p in sorted((tmp_path / "r2").iterdir())] == alone
    assert call("inspect", run_dir, "--grid", "8", "--out", tmp_path / "i.vdb", *words("0:1:3")) == 0
    assert call("export", run_dir, "--format", "vdb", *words("0:1:3"), "grid=8", "--out", tmp_path / "e") == 0
    inspected = [
        read_grid(tmp_path / f"i_{n:04d}.vdb", "extinction").metadata["neuprim_condition_wavelength_shift"]
        for n in range(3)
    ]
    exported = [
        read_grid(tmp_path / "e" / f"density_{n:04d}.vdb", "density").metadata["neuprim_wavelength_shift"]
        for n in range(3)
    ]
    assert inspected == exported == [0.0, 0.5, 1.0]


def test_words_that_mean_nothing_are_refused(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, text in (
        (
            ["--format", "vdb", "--wavelngth-shift", "1"],
            "--wavelngth-shift: no such argument of `neuprim export` for task 'spectral'; did you",
        ),
        (["--format", "vdb", "--forc"], "did you mean '--force'"),
        (
            ["--format", "vdb", "wavelngth_shift=1"],
            "wavelngth_shift: no such option of --format vdb; did you mean '--wavelength-shift'",
        ),
        (["--format", "npz", "time"], "time: no such argument of `neuprim export`"),
        (["--format", "mesh", "grid=9", "grid=9"], "twice"),
        (
            ["--format", "npz", "--wavelength-shift", "1"],
            "--wavelength-shift: --format npz takes no conditions; leave out --wavelength-shift",
        ),
        (["--format", "vdb", "--wavelength-shift=1", "--wavelength-shift", "1"], "wavelength-shift: given twice"),
        (["--format", "vdb", "wavelength-shift=1"], "did you mean '--wavelength-shift'"),
        (["--format", "vdb", "--wavelength-shift"], "--wavelength-shift: expected a value after it"),
    ):
        assert call("export", run_dir, *words) == 2
        assert text in one_line(capsys)
    assert call("render", run_dir, "--camera", "orbit", "--wavelength-shft", "1") == 2
    assert "did you mean '--wavelength-shift'" in one_line(capsys)


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("out", [None, "mine.json"])
def test_an_exporter_that_calls_no_helper_replaces_nothing(
    out: str | None, site: Path, run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add(site, "exporter", EXPORTER.replace("write=write", "write=write, default='centres.json'"))
    path = run_dir / "export" / "centres.json" if out is None else tmp_path / out
    words: list[str | Path] = ["export", run_dir, "--format", "centres", *([] if out is None else ["--out", path])]
    assert call(*words) == 0
    assert capsys.readouterr().out.splitlines()[0] == str(path) and len(json.loads(path.read_text())) == 5
    path.write_text("precious")
    before = entries(tmp_path)
    assert call(*words) == 2
    assert f"{path}: already exists; pass --force to replace it" in one_line(capsys) and path.read_text() == "precious"
    assert call(*words, "--force") == 0 and len(json.loads(path.read_text())) == 5
    assert entries(tmp_path) == before


def test_an_exporter_that_fails_half_way_leaves_what_was_there(site: Path, run_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("precious")
    for failure, raised in (
        ("ConfigError(f'{path}: no')", ConfigError),
        ("KeyboardInterrupt", KeyboardInterrupt),
        ("ZeroDivisionError", PluginError),
    ):
        add(
            site,
            "exporter",
            f"from neuprim.core.errors import ConfigError\n{EXPORTER.replace('return ', f'raise {failure}; return ')}",
        )
        before = entries(tmp_path)
        with pytest.raises(raised) as caught:
            export_run(run_dir, "centres", path, overwrite=True)
        if raised is ConfigError:
            assert str(caught.value) == f"{path}: no"
        assert path.read_text() == "precious"
        assert entries(tmp_path) == before
        for name in os.listdir(site):
            if name.startswith("strange_exporter-"):
                for part in (site / name).iterdir():
                    part.unlink()
                (site / name).rmdir()


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("job.out or job.run", "job.run", "wrote {run}/centres.json instead of {out}"),
        ("ExportReport((path,), False)", "None", "write returned NoneType; expected an ExportReport"),
        ("path.write_text", "len", "reports {out}, which it did not write"),
    ],
)
def test_an_exporter_that_does_something_else_is_named(
    old: str, new: str, text: str, site: Path, run_dir: Path, tmp_path: Path
) -> None:
    add(site, "exporter", EXPORTER.replace(old, new))
    out = tmp_path / "a.json"
    with pytest.raises(PluginError) as caught:
        export_run(run_dir, "centres", out)
    assert str(caught.value).startswith(
        "exporter 'centres' of strange-exporter 0.3: " + text.format(run=run_dir, out=out)
    )
    assert not out.exists()


def test_suffixes_are_checked_before_anything_is_done(site: Path, run_dir: Path, tmp_path: Path) -> None:
    add(site, "exporter", EXPORTER.replace("write=write", "write=lambda job: 1 / 0, suffixes=('.json', '.tar.gz')"))
    (tmp_path / "folder.json").mkdir()
    for name in ("a.txt", "a", ".json", "folder.json"):
        with pytest.raises(ConfigError, match=r"expected a file name that ends in \.json or \.tar\.gz"):
            export_run(run_dir, "centres", tmp_path / name)
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        export_run(run_dir, "centres", tmp_path / "A.TAR.GZ")
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        export_run(run_dir, "centres")
    (run_dir / "export").mkdir()
    (run_dir / "export" / "centres.json").touch()
    with pytest.raises(ConfigError, match=r"export/centres\.json: already exists"):
        export_run(run_dir, "centres")


def test_pictures_of_inspect_are_not_replaced(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words: list[str | Path] = ["inspect", run_dir, "--grid", "8", "--out"]
    for name, taken, more in (
        ("a.vdb", "a.vdb", []),
        ("b.vdb", "b_0001.vdb", ["--wavelength-shift", "0:1:2"]),
        ("p.html", "p.html", []),
    ):
        (tmp_path / taken).write_text("precious")
        assert call(*words, tmp_path / name, *more) == 2
        assert f"{taken}: already exists; pass --force to replace it" in one_line(capsys)
        assert sorted(p.name for p in tmp_path.glob("*.*")) == [taken] and (tmp_path / taken).read_text() == "precious"
        assert call(*words, tmp_path / name, *more, "--force") == 0
        assert (tmp_path / taken).stat().st_size > 100
        capsys.readouterr()
        for path in tmp_path.glob("*.*"):
            path.unlink()


# ---------------------------------------------------------------- options


def test_help_shows_the_options_of_any_format(site: Path, run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add(
        site,
        "exporter",
        EXPORTER.replace(
            "write=write", "write=write, options={'digits': (6, 'decimal places'), 'pretty': (False, 'lines')}"
        ),
    )
    assert call("export", "--help") == 0
    assert "  centres  (strange-exporter 0.3)\n" in capsys.readouterr().out
    for words in (["export", run_dir, "--format", "centres", "--help"], ["export", "--format=centres", "-h"]):
        assert call(*words) == 0
        out = capsys.readouterr().out
        assert "--format centres  (strange-exporter 0.3): centres as JSON\n" in out
        assert "\n  digits=6      decimal places\n  pretty=false  lines\n" in out and "conditions" not in out
    assert call("export", "--format", "vdb", "--help") == 0
    out = capsys.readouterr().out
    assert (
        "\n  units=auto      source, world or scene" in out
        and "\n  voxel_size=     edge of a voxel" in out
        and "--time 0.5" in out
    )
    assert call("export", "--format", "npz", "--help") == 0
    assert "--format npz has no options" in capsys.readouterr().out
    assert call("export", "--format", "centers", "--help") == 2
    assert "did you mean 'centres'" in one_line(capsys)


def test_options_have_their_defaults_and_limits(site: Path, run_dir: Path, tmp_path: Path) -> None:
    body = (
        "path.write_text(repr((job.count('digits', 0, 9), job.number('scale'), job.flag('pretty'), "
        "job.choice('up', 'y', 'z'), job.frames())))"
    )
    options = "{'digits': (6, ''), 'scale': (None, ''), 'pretty': (False, ''), 'up': ('z', '')}"
    source = EXPORTER.replace('path.write_text(json.dumps(job.run.model.params["means"].tolist()))', body)
    add(site, "exporter", source.replace("write=write", f"write=write, conditions=True, options={options}"))
    shift = "--wavelength-shift=0.25"
    for i, (words, expected) in enumerate(
        [
            ([], "(6, None, False, 'z', [{'wavelength_shift': tensor(0.2500)}])"),
            (
                ["digits=2", "scale=0.5", "pretty=true", "up=y"],
                "(2, 0.5, True, 'y', [{'wavelength_shift': tensor(0.2500)}])",
            ),
        ]
    ):
        (path,) = export_run(run_dir, "centres", tmp_path / f"{i}", [shift, *words]).files
        assert path.read_text() == expected
    for word, text in (
        ("digits=10", "digits=10: expected a whole number from 0 to 9"),
        ("digits=1.5", "digits=1.5: expected a whole number from 0 to 9"),
        ("scale=nan", "scale=nan: expected a finite number"),
        ("pretty=1", "pretty=1: expected true or false"),
        ("up=x", "up=x: expected y or z"),
        ("--wavelength_shift=0,1", "given twice"),
        ("gigits=1", "gigits: no such option of --format centres; did you mean 'digits'"),
    ):
        with pytest.raises(ConfigError, match=text):
            export_run(run_dir, "centres", tmp_path / "x", [shift, word])
    with pytest.raises(ConfigError, match="2 values; expected one value"):
        export_run(run_dir, "centres", tmp_path / "x", ["--wavelength_shift=0,1"])


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize("kind", ["write", "read"])
def test_a_crash_of_an_exporter_names_its_package(kind: str, site: Path, run_dir: Path, tmp_path: Path) -> None:
    add(site, "exporter", EXPORTER.replace("write=write", "write=lambda job: {}[0], read=lambda path: {}[path]"))
    (tmp_path / "a.centres").touch()
    with pytest.raises(
        PluginError, match=r"^exporter 'centres' of strange-exporter 0\.3: KeyError: .*, in <lambda>\)$"
    ):
        if kind == "write":
            export_run(run_dir, "centres")
        else:
            import_run_directory(tmp_path / "a.centres", tmp_path / "back")
    assert not (run_dir / "export").exists() and not (tmp_path / "back").exists()


def test_a_full_disk_is_not_the_plugins_fault(
    site: Path, run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add(
        site,
        "exporter",
        EXPORTER.replace("return", "raise OSError(28, 'No space left on device', str(path))\n    return", 1),
    )
    assert call("export", run_dir, "--format", "centres", "--out", tmp_path / "a.json") == 2
    assert one_line(capsys) == f"neuprim: error: {tmp_path}/a.json: No space left on device\n"


def test_a_crash_of_an_inspector_names_its_package(site: Path, run_dir: Path, tmp_path: Path) -> None:
    add(site, "inspector", INSPECTOR.replace("frame.box", "frame.nowhere"))
    with pytest.raises(PluginError, match=r"^inspector 'crumbs' of strange-inspector 0\.3: AttributeError: "):
        inspect_run(InspectRequest(run_dir, ["crumbs"], grid=8, out=tmp_path / "a.html"))
    assert not (tmp_path / "a.html").exists()
