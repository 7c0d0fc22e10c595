# SPDX-License-Identifier: GPL-3.0-or-later
"""Saving replaces a file completely or not at all."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import bpy
import pytest

from prt_addon.blender.save import save_blend
from prt_addon.errors import StorageError
from tests.blender.scenes import add_cube


def test_saves_and_replaces_without_leftovers(scene: bpy.types.Scene, tmp_path: Path) -> None:
    path = tmp_path / "scene.blend"
    save_blend(path)
    add_cube("Added")
    save_blend(path)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.blend"]
    assert bpy.data.filepath == ""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert "Added" in bpy.data.objects


def test_relative_paths_still_lead_to_their_files(scene: bpy.types.Scene, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "in" / "a.blend"))
    image = bpy.data.images.new("I", 1, 1)
    image.source, image.filepath = "FILE", "//texture.png"
    image.use_fake_user = True
    save_blend(tmp_path / "out" / "b.blend")
    assert bpy.data.images["I"].filepath == "//texture.png"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / "b.blend"))
    assert Path(bpy.path.abspath(bpy.data.images["I"].filepath)).resolve() == tmp_path / "in" / "texture.png"


@pytest.mark.parametrize("case", ["missing folder", "folder of that name", "wrong ending", "read-only file",
                                  "read-only folder"])
def test_refused_with_one_line(scene: bpy.types.Scene, tmp_path: Path, case: str) -> None:
    path = tmp_path / "out" / "scene.blend"
    path.parent.mkdir()
    if case == "missing folder":
        path = tmp_path / "gone" / "scene.blend"
    elif case == "folder of that name":
        path.mkdir()
    elif case == "wrong ending":
        path = path.with_suffix(".txt")
    elif case == "read-only file":
        path.write_bytes(b"precious")
        path.chmod(stat.S_IREAD)
    else:
        path.parent.chmod(stat.S_IREAD | stat.S_IEXEC)
    with pytest.raises(StorageError) as caught:
        save_blend(path)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)
    if case == "read-only file":
        assert path.read_bytes() == b"precious"
    path.parent.chmod(stat.S_IRWXU) if path.parent.exists() else None


def test_full_disk_keeps_the_previous_file(scene: bpy.types.Scene, tmp_path: Path,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.blend"
    path.write_bytes(b"previous")

    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(StorageError, match="No space left"):
        save_blend(path)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.blend"]
    assert path.read_bytes() == b"previous"
