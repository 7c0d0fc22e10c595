# SPDX-License-Identifier: GPL-3.0-or-later
"""What scripts do with operators is what they do with commands: the same bakes, light, pictures and files.

One process with the extension registered, as a script in `blender --background` has it; and the examples, each run as
its own text says.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.gpu_support import require_gpu
from tests.blender.test_commands import ROOT, make_scene

# Run by tools/run_script.py in a process of its own, where the extension is registered: FOLDER SCENE.
SCRIPT = """
import json, sys
from pathlib import Path
import bpy
folder, scene = sys.argv[sys.argv.index("--") + 1:][:2]
folder = Path(folder)
FAST = "directions=64, gather_directions=32, spacing=0, error_receivers=8"
told = {}
bpy.ops.wm.open_mainfile(filepath=scene)
told["before"] = [o.name for o in bpy.context.selected_objects]
assert bpy.ops.prt.analyze(preset="draft", objects="Ball", overrides=FAST) == {"FINISHED"}
told["analysis"] = bpy.context.window_manager.prt.analysis
assert bpy.ops.prt.bake(preset="draft", lighting="environment", objects="Ball,Floor", overrides=FAST) == {"FINISHED"}
told["after"] = [o.name for o in bpy.context.selected_objects]
for number in range(2):
    bpy.ops.prt.write_report(filepath=str(folder / ("report.json", "report.html")[number]))
bpy.ops.prt.export(directory=str(folder / "operators"))
bpy.ops.prt.show_report()
bpy.ops.prt.relight(rotate=35.0, filepath=str(folder / "turned.npz"))
bpy.ops.prt.relight(rotate=35.0)
attribute = bpy.data.objects["Ball"].data.color_attributes.get("PRT Light")
told["attribute"] = [list(v.color) for v in attribute.data] if attribute else None
bpy.ops.prt.draw_camera(filepath=str(folder / "operators.png"), size="64x40", rotate=35.0, window=False)
bpy.ops.prt.compare(samples=2, size="64x40", filepath=str(folder / "compared.png"), report_path=str(folder / "c.json"))
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "operators.blend"), copy=True)
bad = {}
for name, arguments in (("bake", {"preset": "best"}), ("bake", {"lighting": "moon"}), ("bake", {"objects": "Nobody"}),
                        ("bake", {"overrides": "orders=3"}), ("analyze", {"preset": "best"}),
                        ("relight", {"environment": "missing.exr"}), ("draw_camera", {"filepath": "x.gif"}),
                        ("draw_camera", {"filepath": "x.png", "size": "wide"}), ("export", {}),
                        ("write_report", {"filepath": "x.txt"}), ("clear", {"objects": "Nobody"}),
                        ("compare", {"size": "0x0"})):
    try:
        bad[f"{name} {arguments}"] = str(getattr(bpy.ops.prt, name)(**arguments))
    except RuntimeError as error:
        bad[f"{name} {arguments}"] = f"refused: {error}"
told["bad"] = bad
assert bpy.ops.prt.clear(objects="Floor") == {"FINISHED"}
told["left"] = [o.name for o in map(bpy.data.objects.get, ("Ball", "Floor"))
                if "prt_header" in (o.get("prt_receiver") or o.data)]
told["report kept"] = bpy.ops.prt.write_report.poll()
assert bpy.ops.prt.clear(objects="Ball") == {"FINISHED"}
told["report dropped"] = not bpy.ops.prt.write_report.poll()
(folder / "told.json").write_text(json.dumps(told))
"""


def script(path: Path | str, *arguments: object, file: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A script in a process of its own with the extension registered."""
    files = [] if file is None else [str(file)]
    return subprocess.run([sys.executable, str(ROOT / "tools" / "run_script.py"), *files, str(path), "--",
                           *map(str, arguments)], capture_output=True, text=True, timeout=150, check=False)


def command(*arguments: object) -> None:
    done = subprocess.run([sys.executable, str(ROOT / "tools" / "prt.py"), *map(str, arguments)], capture_output=True,
                          text=True, timeout=150, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the operators left, as SCRIPT names it, and told.json; and the same by the commands."""
    require_gpu()
    folder = tmp_path_factory.mktemp("scripting")
    scene = make_scene(folder / "scene.blend")
    (folder / "script.py").write_text(SCRIPT)
    done = script(folder / "script.py", folder, scene)
    assert (folder / "told.json").is_file(), done.stderr
    command("bake", "--input", scene, "--output", folder / "commands.blend", "--objects", "Ball,Floor", "--preset",
            "draft", "--set", "directions=64", "--set", "gather_directions=32", "--set", "spacing=0", "--set",
            "error_receivers=8", "--report", folder / "command_report.json")
    return folder


def told(folder: Path) -> dict:
    return json.loads((folder / "told.json").read_text())


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as found:
        return dict(found)


def headers_of(path: Path) -> dict[str, dict]:
    return {entry["name"]: entry["header"] for entry in json.loads(path.read_text())["objects"]}


def test_bakes_and_exports_are_the_same(folder: Path) -> None:
    command("export", "--input", folder / "commands.blend", "--output", folder / "commands")
    by_operators, by_commands = (headers_of(folder / name / "baked.json") for name in ("operators", "commands"))
    assert set(by_operators) == {"Ball", "Floor"} == set(by_commands)
    for name, header in by_operators.items():
        assert header["digests"] == by_commands[name]["digests"] and header["settings"] == by_commands[name]["settings"]
    files = sorted(path.name for path in (folder / "operators").iterdir())
    assert files == sorted(path.name for path in (folder / "commands").iterdir())
    for name in (name for name in files if name.endswith(".npz")):
        first, second = arrays_of(folder / "operators" / name), arrays_of(folder / "commands" / name)
        assert first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


def test_light_is_the_same(folder: Path) -> None:
    """As arrays, and as the colour attribute of the mesh that carries its own bake."""
    command("relight", "--input", folder / "commands.blend", "--output", folder / "c.npz", "--rotate", "35",
            "--use-scene-lights")
    ours, theirs = arrays_of(folder / "turned.npz"), arrays_of(folder / "c.npz")
    assert all(np.array_equal(ours[key], theirs[key]) for key in theirs) and ours.keys() == theirs.keys()
    attribute = told(folder)["attribute"]
    assert np.allclose(np.array(attribute)[:, :3], theirs["radiance"][theirs["object"] == "Ball"], rtol=1e-5)


def test_pictures_are_the_same(folder: Path) -> None:
    command("preview", "--input", folder / "commands.blend", "--output", folder / "commands.png", "--size", "64x40",
            "--rotate", "35")
    assert (folder / "commands.png").read_bytes() == (folder / "operators.png").read_bytes()


def test_a_comparison_leaves_its_picture_and_numbers(folder: Path) -> None:
    result = json.loads((folder / "c.json").read_text())
    assert result["size"] == [64, 40] and result["compared"] > 200 and (folder / "compared.png").stat().st_size > 1000


def test_reports_are_kept_with_the_scene(folder: Path) -> None:
    """The operator's is the command's but for what time measures; it is there after loading, gone after clearing."""
    ours, theirs = (json.loads((folder / name).read_text()) for name in ("report.json", "command_report.json"))
    for key in ("scene", "settings", "errors", "left_out"):
        assert ours[key] == theirs[key], key
    assert (folder / "report.html").read_text().lstrip().lower().startswith("<!doctype html")
    from prt.prt_addon.blender.stored_report import stored_report

    for name, report in (("operators", ours), ("commands", theirs)):
        bpy.ops.wm.open_mainfile(filepath=str(folder / f"{name}.blend"), load_ui=False)
        assert stored_report(bpy.context.scene)["errors"] == report["errors"]
    assert told(folder)["report kept"] and told(folder)["report dropped"]


def test_arguments_are_checked_and_nothing_else_is_touched(folder: Path) -> None:
    found = told(folder)
    assert found["before"] == found["after"]
    assert found["analysis"].startswith("About ")
    assert found["left"] == ["Ball"]  # after clearing the floor's
    for call, answer in found["bad"].items():
        assert answer.startswith("refused: Error: ") and "Traceback" not in answer, (call, answer)


def test_batch_bake_goes_on_where_it_stopped_and_names_what_fails(folder: Path, tmp_path: Path) -> None:
    scenes, baked = tmp_path / "scenes", tmp_path / "baked"
    scenes.mkdir()
    make_scene(scenes / "one.blend")
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(scenes / "empty.blend"))
    first = script(ROOT / "examples" / "batch_bake_folder.py", scenes, baked, "--preset", "draft")
    assert first.returncode == 1 and "empty.blend: " in first.stderr and "Traceback" not in first.stderr, first.stderr
    assert sorted(path.name for path in baked.iterdir()) == ["one.blend", "one.html"]
    before = (baked / "one.blend").stat().st_mtime_ns
    again = script(ROOT / "examples" / "batch_bake_folder.py", scenes, baked, "--preset", "draft")
    assert "baked already" in again.stdout and (baked / "one.blend").stat().st_mtime_ns == before


def test_turntable_and_contact_sheet_draw(folder: Path, tmp_path: Path) -> None:
    from prt.prt_addon.blender.pictures import read_picture

    file = folder / "operators.blend"
    done = script(ROOT / "examples" / "turntable_of_relightings.py", tmp_path / "turn", "--frames", "2", "--size",
                  "48x30", file=file)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert sorted(path.name for path in (tmp_path / "turn").iterdir()) == ["0001.png", "0002.png"]
    sheet = tmp_path / "sheet.png"
    done = script(ROOT / "examples" / "lighting_contact_sheet.py", sheet, "--size", "120x80", "--columns", "3",
                  "--turns", "0", file=file)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    picture = read_picture(sheet)
    assert picture.shape[1] == 12 + 3 * (120 + 12)
    captions = picture[12 + 80:12 + 80 + 30, 12:132]
    assert captions.max() > 200 and captions.min() == 24  # letters on the sheet
