# SPDX-License-Identifier: GPL-3.0-or-later
"""The manifest against the rules of Blender's extension manager."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import pytest

from tests.rules.checkout import ROOT

REQUIRED = {"schema_version", "id", "version", "name", "tagline", "maintainer", "type", "blender_version_min",
            "license"}


@pytest.fixture(scope="module")
def manifest() -> dict[str, Any]:
    return tomllib.loads((ROOT / "blender_manifest.toml").read_text("utf-8"))


def test_required_keys(manifest: dict[str, Any]) -> None:
    assert set(manifest) >= REQUIRED
    assert manifest["schema_version"] == "1.0.0" and manifest["id"] == "prt" and manifest["type"] == "add-on"
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", manifest["version"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", manifest["blender_version_min"])


def test_tagline_and_reasons_fit(manifest: dict[str, Any]) -> None:
    reasons = manifest["permissions"]
    assert set(reasons) == {"files"}, "no network, no clipboard, no camera"
    for text in (manifest["tagline"], *reasons.values()):
        assert 0 < len(text) <= 64 and text[-1].isalnum(), text


def test_no_value_is_empty(manifest: dict[str, Any]) -> None:
    def empty(value: Any) -> bool:
        if isinstance(value, dict):
            return not value or any(map(empty, value.values()))
        return not value or (isinstance(value, list) and any(map(empty, value)))

    assert not empty(manifest)


def test_the_source_lists_no_wheels(manifest: dict[str, Any]) -> None:
    """They are written into each zip's manifest; a list here would make a checkout unloadable."""
    assert "wheels" not in manifest and "platforms" not in manifest
