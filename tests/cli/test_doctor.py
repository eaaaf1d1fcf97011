from dataclasses import replace
from importlib import metadata
from typing import Any

import pytest

import neuprim.core.render as rendering
from neuprim.cli import install_commands as doctor
from neuprim.core.compute import device
from neuprim.core.render import backends
from neuprim.core.render.backends import Backend


@pytest.mark.parametrize("works", [True, False])
def test_report(works: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(
        doctor, "_probe_doctor_backend", lambda name: None if works and name == "reference" else "no such luck"
    )
    assert doctor.print_doctor_report() == (0 if works else 1)
    text = capsys.readouterr().out
    for word in (
        "python",
        "simd",
        "hydra-core",
        metadata.version("torch"),
        "pycolmap",
        "CUDA",
        "numba",
        "used by runs",
    ):
        assert word in text
    assert "does not work: no such luck" in text and ("no renderer backend works" in text) == (not works)
    assert "pytest" not in text and "mkdocs" not in text, "extras for developers are not shown"


def test_what_is_missing_or_too_old_says_how_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [
        "numpy>=999",
        "not-there>=1",
        "also-not>=2; extra == 'colmap'",
        "skipped; extra == 'dev'",
        "skipped; sys_platform == 'none'",
    ]
    monkeypatch.setattr(metadata, "requires", lambda name: needs)
    rows = dict(doctor._list_doctor_packages())
    assert "needs >=999: pip install 'numpy>=999'" in rows["numpy"]
    assert rows["not-there"] == "not installed: pip install 'not-there>=1'"
    assert rows["also-not"] == "not installed: pip install 'neuprim[colmap]'"
    assert "skipped" not in rows


@pytest.mark.parametrize("backend", [backend.name for backend in backends.available_backends()])
def test_a_backend_that_is_a_thousandth_off_does_not_work(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._probe_doctor_backend(backend) is None
    genuine = rendering.render_lowered

    def dimmer(*args: Any) -> Any:
        output = genuine(*args)
        return replace(output, rgb=0.999 * output.rgb)

    monkeypatch.setattr(rendering, "render_lowered", dimmer)
    reason = doctor._probe_doctor_backend(backend)
    assert reason is not None and reason.startswith("drew 0.86")


def test_it_says_whether_runs_use_a_card_and_why_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "cuda_unavailable", lambda: "torch finds no CUDA device")
    assert dict(doctor._list_doctor_devices())["used by runs"] == "no: torch finds no CUDA device"
    monkeypatch.setattr(device, "cuda_unavailable", lambda: None)
    row = Backend(
        "card", lambda: pytest.fail("loaded"), missing=lambda: "pip install 'neuprim[cuda]'", devices=("cuda",)
    )
    monkeypatch.setattr(backends, "TABLE", (row, *backends.TABLE[-1:]))
    assert dict(doctor._list_doctor_devices())["used by runs"] == "no: pip install 'neuprim[cuda]'"
    monkeypatch.setattr(backends, "TABLE", (replace(row, missing=lambda: None), *backends.TABLE[-1:]))
    assert dict(doctor._list_doctor_devices())["used by runs"] == "yes"
