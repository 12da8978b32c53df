from pathlib import Path

import pytest

from seal_gym.core import paths


def test_the_checkouts_assets_come_first():
    expected = Path(__file__).resolve().parents[3] / "assets" / "ur5_sealgun" / "cell.toml"
    assert paths.asset("ur5_sealgun", "cell.toml") == expected


def test_an_installed_package_finds_its_own(monkeypatch, tmp_path):
    package = tmp_path / "site-packages" / "seal_gym"
    (package / "assets").mkdir(parents=True)
    (package / "assets" / "a.toml").write_text("")
    monkeypatch.setattr(paths, "_PACKAGE", package)
    assert paths.asset("a.toml") == package / "assets" / "a.toml"
    (package.parent / "assets").mkdir()
    (package.parent / "assets" / "a.toml").write_text("")
    assert paths.asset("a.toml") == package.parent / "assets" / "a.toml"


def test_a_missing_asset_says_what_to_do():
    with pytest.raises(FileNotFoundError, match=r"ur5_sealgun/none\.xml not found.*reinstall"):
        paths.asset("ur5_sealgun", "none.xml")
