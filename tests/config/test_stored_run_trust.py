"""What a stored configuration may reach without the user's word."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.config import RunConfig, compose, read_stored_config
from neuprim.config.stored_run import refuse_untrusted_run_links, refuse_untrusted_settings
from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.io.trust import ENVIRONMENT, trusting
from neuprim.runs.open import make_run_scene_context

VOLUMES = ["task=dynamic", "scene=vdb", "scene.vdb=/data/fire"]


def stored(folder: Path, *words: str) -> RunConfig:
    """Of a run that somebody else made."""
    folder.mkdir()
    (folder / "config.yaml").write_text(compose([*words, f"output_dir={folder}"]).to_yaml())
    return read_stored_config(folder)


@pytest.mark.parametrize(
    "address",
    ["ftp://user:pw@127.0.0.1:1/x", "s3://bucket/x", "simplecache::s3://b/x", r"\\\\host\\share", "/tmp/other/cache"],
)
def test_caches_elsewhere_need_the_users_word(tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = stored(tmp_path / "run", *VOLUMES)
    config.scene["cache"] = address
    with pytest.raises(
        ConfigError,
        match=r"config\.yaml: scene\.cache is .*; to allow it, add --trust or, for all runs, set NEUPRIM_TRUST=1",
    ):
        make_run_scene_context(config, lambda text, fraction: None)
    with trusting(True):
        refuse_untrusted_settings(config)
    refuse_untrusted_settings(replace(config, source=None))  # of the user's own words
    new = f"output_dir={tmp_path / 'new'}"
    with pytest.raises(ConfigError, match=r"to allow it, add scene\.cache=\.\.\. to the command or"):
        compose([new], stored=config)
    assert compose(["scene.cache=null", new], stored=config).scene["cache"] is None
    monkeypatch.setenv(ENVIRONMENT, "1")
    refuse_untrusted_settings(config)


def test_a_users_own_run_is_opened_again_without_a_word(tmp_path: Path) -> None:
    config = stored(
        tmp_path / "run", *VOLUMES, f"scene.cache={tmp_path / 'run' / 'cache'}", f"metrics.lpips={tmp_path / 'weights'}"
    )
    refuse_untrusted_settings(config)
    assert config.scene["vdb"] == "/data/fire"


def test_any_setting_that_is_an_address_is_named(tmp_path: Path) -> None:
    config = stored(tmp_path / "run", *VOLUMES)
    config.model.init["points"] = "https://host/points.ply" + "x" * 10**5
    with pytest.raises(
        ConfigError, match=r"model\.init\.points is 'https://host/points\.plyx+\.\.\.', a network address"
    ) as refused:
        refuse_untrusted_settings(config)
    assert len(str(refused.value)) < 400


def test_stored_text_is_data_and_typed_text_may_refer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "leaked")
    config = stored(tmp_path / "run", "task=static", "scene=solids")
    for text in ("x-${oc.env:SECRET}", "${seed}", "$${x", "\\${oc.env:SECRET}"):
        config.metrics = type(config.metrics)(f"/{text}")
        again = compose([f"output_dir={tmp_path / 'new'}"], stored=config)
        assert again.metrics.lpips == f"/{text}"
    assert (
        compose(["metrics.lpips=/${oc.env:SECRET}", f"output_dir={tmp_path / 'new'}"], stored=config).metrics.lpips
        == "/leaked"
    )


def test_a_bomb_of_aliases_is_one_line_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored(tmp_path / "run", "task=static", "scene=solids")
    file = tmp_path / "run" / "config.yaml"
    bomb = "&A0 [1,1]"
    for n in range(1, 40):
        bomb = f"&A{n} [{bomb},*A{n - 1}]"
    file.write_text(file.read_text().replace("seed: 0", f"seed: {bomb}"))
    with pytest.raises(
        CheckpointError, match=r"config\.yaml line \d+: damaged configuration \(anchors and aliases are not read\)"
    ):
        RunConfig.from_yaml(file)
    assert main(["eval", str(tmp_path / "run")]) == 2 and capsys.readouterr().err.count("\n") == 1


def test_folders_that_are_links_out_of_the_run_are_refused(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "own").mkdir(parents=True)
    (run / "inside").symlink_to(run / "own")
    refuse_untrusted_run_links(run)
    (run / "renders").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match=r"run/renders: is a link to .*, outside of the run"):
        refuse_untrusted_run_links(run)
    with trusting(True):
        refuse_untrusted_run_links(run)
