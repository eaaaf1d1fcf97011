"""What ``neuprim export`` prints: numbers of one thing line by line, of several in a table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neuprim.cli.export_command import print_report
from neuprim.core.extensions import ExportReport


def printed(capsys: pytest.CaptureFixture[str], errors: dict[str, float], as_json: bool = False) -> str:
    print_report(ExportReport((Path("a.vdb"),), False, errors, ("a note",)), as_json)
    return capsys.readouterr().out


def test_frames_have_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"frame_0001.relative_l2": 0.25, "frame_0001.psnr_active": 23.5, "frame_0012.relative_l2": 0.125}
    lines = printed(capsys, errors).splitlines()
    assert lines[0] == "a.vdb" and lines[1] == "lossy" and lines[-1] == "note: a note"
    assert [line.split() for line in lines[2:5]] == [
        ["relative_l2", "psnr_active"],
        ["frame_0001", "0.2500", "23.5000"],
        ["frame_0012", "0.1250"],
    ]
    assert (
        len(
            {
                line.index(word) + len(word)
                for line, word in zip(lines[2:5], ("relative_l2", "0.2500", "0.1250"), strict=True)
            }
        )
        == 1
    )


@pytest.mark.parametrize(
    "errors", [{}, {"psnr": 31.25}, {"iou": 0.5, "front.iou": 0.75}, {"frame_0001.relative_l2": 0.25}]
)
def test_other_numbers_have_a_line_each(capsys: pytest.CaptureFixture[str], errors: dict[str, float]) -> None:
    lines = printed(capsys, errors).splitlines()
    assert [line.split() for line in lines[2:-1]] == [[name, f"{value:.4f}"] for name, value in errors.items()]


def test_programs_get_every_number_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"frame_0001.relative_l2": 0.25, "frame_0002.relative_l2": float("inf")}
    assert json.loads(printed(capsys, errors, True))["errors"] == {
        "frame_0001.relative_l2": 0.25,
        "frame_0002.relative_l2": None,
    }
