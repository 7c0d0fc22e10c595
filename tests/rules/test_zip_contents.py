# SPDX-License-Identifier: GPL-3.0-or-later
"""The built zips: exactly the product, exactly this platform's pinned wheels, and Blender takes them."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.rules.checkout import PRODUCT, ROOT, repository_files

FOLDER = ROOT / "build" / "extension"
EXTRA = {"blender_manifest.toml", "LICENSE", "README.md", "THIRD_PARTY.md"}
PLATFORMS = ("linux-x64", "windows-x64", "macos-arm64")
TAGS = {"linux-x64": "manylinux", "windows-x64": "win_amd64", "macos-arm64": "macosx"}


def product_files() -> set[str]:
    names = {path.relative_to(ROOT) for path in repository_files()}
    return {str(name) for name in names if name.parts[0] in PRODUCT}


def find_zip(platform: str) -> Path:
    """The platform's zip; a test without one is skipped, except where the build has to have made it (CI)."""
    found = list(FOLDER.glob(f"prt-*-{platform}.zip"))
    if len(found) != 1:
        why = f"{len(found)} zips for {platform} in build/extension: run `make extension`"
        pytest.fail(why) if os.environ.get("PRT_REQUIRE_ZIPS") else pytest.skip(why)
    return found[0]


@pytest.fixture(params=PLATFORMS)
def built(request: pytest.FixtureRequest) -> Iterator[tuple[str, zipfile.ZipFile]]:
    """A platform and its zip."""
    with zipfile.ZipFile(find_zip(request.param)) as archive:
        yield request.param, archive


def manifest_of(archive: zipfile.ZipFile) -> dict[str, Any]:
    return tomllib.loads(archive.read("blender_manifest.toml").decode())


def test_holds_the_product_and_nothing_else(built: tuple[str, zipfile.ZipFile]) -> None:
    _, archive = built
    inside = {name for name in archive.namelist() if not name.startswith("wheels/") and not name.endswith("/")}
    expected = product_files() | EXTRA
    changed = [name for name in sorted(product_files() & inside) if archive.read(name) != (ROOT / name).read_bytes()]
    if (changed or inside != expected) and not os.environ.get("PRT_REQUIRE_ZIPS"):
        example = (changed or sorted(inside ^ expected))[0]
        pytest.skip(f"the zip is older than the checkout ({example}): run `make extension`")
    assert changed == []
    assert inside == expected


def test_manifest_lists_exactly_its_platforms_pinned_wheels(built: tuple[str, zipfile.ZipFile]) -> None:
    platform, archive = built
    pinned = [entry for entry in tomllib.loads((ROOT / "requirements" / "wheels.toml").read_text("utf-8"))["wheel"]
              if entry["platform"] == platform]
    manifest = manifest_of(archive)
    assert manifest["platforms"] == [platform]
    inside = {name for name in archive.namelist() if name.startswith("wheels/") and not name.endswith("/")}
    assert {f"./{name}" for name in inside} == set(manifest["wheels"]) == {f"./wheels/{e['file']}" for e in pinned}
    assert len(manifest["wheels"]) == len(inside)
    for entry in pinned:
        assert TAGS[platform] in entry["file"] and f"cp{entry['python'].replace('.', '')}" in entry["file"]
        with archive.open(f"wheels/{entry['file']}") as stream:
            assert hashlib.file_digest(stream, "sha256").hexdigest() == entry["sha256"], entry["file"]


def test_numpy_is_not_bundled_and_licences_are(built: tuple[str, zipfile.ZipFile]) -> None:
    _, archive = built
    wheels = [Path(name).name.lower() for name in archive.namelist() if name.startswith("wheels/")]
    assert not any(name.startswith("numpy") for name in wheels)
    notices = archive.read("THIRD_PARTY.md").decode()
    for name in ("embreex", "OpenEXR", "scipy", "xatlas"):
        assert f"## {name} " in notices
    # The texts themselves: the GCC runtime's exception (scipy), Embree's Apache 2.0, xatlas's and OpenEXR's own.
    for text in ("GCC RUNTIME LIBRARY EXCEPTION", "Apache License", "Contributors to the OpenEXR Project", "Scopatz"):
        assert text.lower() in notices.lower(), text


INSTALL = """
import pathlib, sys
import bpy
assert bpy.ops.extensions.package_install_files(repo="user_default", filepath=sys.argv[1], enable_on_install=True) == {
    "FINISHED"}
name = "bl_ext.user_default.prt"
assert name in bpy.context.preferences.addons, list(bpy.context.preferences.addons.keys())
assert hasattr(bpy.types.Scene, "prt")
unpacked = [str(path) for path in pathlib.Path(sys.argv[2]).rglob("*")]
for wheel in ("embreex/__init__.py", "scipy/__init__.py", "/OpenEXR.", "/xatlas."):
    assert any(wheel in path for path in unpacked), wheel
bpy.ops.preferences.addon_disable(module=name)
assert not hasattr(bpy.types.Scene, "prt")
print("INSTALLED")
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="installs the Linux zip")
def test_installs_and_enables_in_the_wheel(tmp_path: Path) -> None:
    """bpy.ops.extensions.package_install_files in a process and a user folder of its own."""
    archive = find_zip("linux-x64")
    script = tmp_path / "install.py"
    script.write_text(INSTALL)
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    done = subprocess.run([sys.executable, str(script), str(archive), str(tmp_path)], env=environment,
                          capture_output=True, text=True, timeout=240, check=False)
    assert "INSTALLED" in done.stdout, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
