# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings in the panel: what they change of a preset, that each says what it costs, and that each can be reached."""

from __future__ import annotations

import itertools
import sys
import types
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import bpy
import pytest

ROOT = Path(__file__).parents[2]

if "prt" not in sys.modules:  # the checkout as a package, as tools/prt.py loads it, without registering anything
    sys.modules["prt"] = types.ModuleType("prt")
    sys.modules["prt"].__path__ = [str(ROOT)]

# Of the preview alone, or turned into a field of another name.
NO_FIELDS = {"preset", "exposure", "window", "cloud_collection", "targets", "target_collection",
              "compare_samples", "compare_percentage", "display", "show_cloud", "lamps_by_directions"}


@pytest.fixture
def settings() -> Iterator[bpy.types.PropertyGroup]:
    """Scene.prt of a new file, with the classes that it needs."""
    from prt.operators import properties

    bpy.ops.wm.read_homefile(use_empty=True)
    classes = (properties.PRTSettings, properties.PRTBakedObject, properties.PRTSession)
    for cls in classes:
        bpy.utils.register_class(cls)
    properties.register()
    yield bpy.context.scene.prt
    properties.unregister()
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)


def names(settings: bpy.types.PropertyGroup) -> list[str]:
    return [p.identifier for p in settings.bl_rna.properties if p.identifier not in ("rna_type", "name")]


def test_a_chosen_preset_changes_nothing_of_itself(settings: bpy.types.PropertyGroup) -> None:
    from prt.prt_addon.baking.settings import PRESETS

    assert settings.overrides() == {}  # of a new file
    for preset in ("high", "draft", "standard"):
        assert preset in PRESETS
        settings.preset = preset
        assert settings.overrides() == {}, preset


@pytest.mark.parametrize(("name", "value", "field", "expected"), [
    ("order", 6, "order", 6), ("bounces", False, "bounces", 0), ("lighting", "local", "lighting", "local"),
    ("lighting", "both", "lighting", "environment,local"), ("glossy_rows", "25", "glossy_rows", 25),
    ("glossy_rows", "0", "glossy_rows", 0), ("glossy_albedo", 0.07, "glossy_albedo", 0.07),
    ("glossy_window", False, "glossy_window", False), ("subsurface", False, "subsurface", False),
    ("coherence", 0.05, "coherence", 0.05), ("cloud_lights", 4096, "cloud_lights", 4096),
    ("cloud_spacing", 0.25, "cloud_spacing", 0.25), ("merge_response", 0.0, "merge_response", 0.0),
    ("zone_receivers", 100_000, "zone_receivers", 100_000), ("directions", 512, "directions", 512),
    ("gather_directions", 64, "gather_directions", 64), ("bounce_error", 3e-6, "bounce_error", 3e-6),
    ("spacing", 0.3, "spacing", 0.3), ("fit_order_to_light", True, "fit_order_to_light", True),
    ("threads", 3, "threads", 3), ("seed", 12345, "seed", 12345), ("clusters", 33, "clusters", 33),
    ("vectors", 11, "vectors", 11), ("compression_error", 0.25, "compression_error", 0.25),
    ("error_receivers", 7, "error_receivers", 7), ("error_paths", 100, "error_paths", 100),
    ("surface_patches", 77, "surface_patches", 77), ("cloud_emission", 3, "cloud_emission", 3),
    ("lamp_basis", "cloud", "lamp_basis", "cloud"), ("distant_basis", "cubemap", "distant_basis", "cubemap"),
    ("cubemap_size", 8, "cubemap_size", 8), ("sampling", "sparse", "sampling", "sparse"),
    ("memory_budget", 0.5, "memory_budget", 0.5), ("light_error", 0.2, "light_error", 0.2),
    ("receivers", "texels", "receivers", "texels"), ("atlas_size", 128, "atlas_size", 128),
    ("subsurface_links", 32, "subsurface_links", 32), ("live_editing", True, "live_editing", True),
    ("live_entries", 32, "live_entries", 32),
    ("encoder", "eigentransport", "encoder", "eigentransport")])
@pytest.mark.parametrize("preset", ["draft", "standard", "high"])
def test_each_control_changes_its_setting_and_no_other(preset: str, name: str, value: object, field: str,
                                                       expected: object, settings: bpy.types.PropertyGroup) -> None:
    from prt.prt_addon.baking.settings import PRESETS, make_settings

    settings.preset = preset
    setattr(settings, name, value)
    assert list(settings.overrides()) == [field]
    found = make_settings(preset, settings.overrides())
    assert getattr(found, field) == pytest.approx(expected)
    assert replace(found, **{field: getattr(PRESETS[preset], field)}) == PRESETS[preset]


def test_a_region_is_told_by_name(settings: bpy.types.PropertyGroup) -> None:
    """An object before a collection; a name may hold what a command line could not."""
    from prt.prt_addon.baking.settings import make_settings

    collection = bpy.data.collections.new("Rooms, all = 3")
    settings.cloud_collection = collection
    assert settings.overrides() == {"cloud_region": "Rooms, all = 3"}
    assert make_settings("standard", settings.overrides()).cloud_region == "Rooms, all = 3"
    settings.cloud_region = bpy.data.objects.new("Room", None)
    assert settings.overrides() == {"cloud_region": "Room"}


def test_what_a_preset_does_not_differ_in_stays(settings: bpy.types.PropertyGroup) -> None:
    settings.lighting, settings.cloud_spacing, settings.bounces = "both", 0.5, False
    settings.order, settings.glossy_rows = 2, "4"
    settings.preset = "high"
    assert settings.overrides() == {"lighting": "environment,local", "cloud_spacing": "0.5", "bounces": "0"}


def test_controls_are_of_real_settings_and_say_what_they_cost(settings: bpy.types.PropertyGroup) -> None:
    from prt.prt_addon.baking.settings import BakeSettings

    assert set(names(settings)) - NO_FIELDS <= {field.name for field in fields(BakeSettings)}
    for name in names(settings):
        found = settings.bl_rna.properties[name]
        told = [found.description, *(item.description for item in getattr(found, "enum_items", ()))]
        assert len(" ".join(told)) > 40 and not any(text.endswith(".") for text in told), name


def test_every_setting_can_be_written_on_a_command_line() -> None:
    from prt.operators.commands import _parser
    from prt.prt_addon.baking.settings import PRESETS, BakeSettings, make_settings

    for preset, values in PRESETS.items():
        written = [f"{field.name}={getattr(values, field.name)}" for field in fields(BakeSettings)]
        parsed = _parser().parse_args(["analyze", "--input", "a.blend", *(x for w in written for x in ("--set", w))])
        assert make_settings("standard", dict(parsed.overrides)) == values, preset


class Drawn:
    """Stands in for a layout: keeps which properties and operators are drawn."""

    def __init__(self, found: set[str]) -> None:
        self.found = found

    def prop(self, owner: object, name: str, **_options: object) -> None:
        assert hasattr(owner, name), name
        self.found.add(name)

    def operator(self, name: str, **_options: object) -> None:
        self.found.add(name)

    def label(self, **_options: object) -> None:
        """Texts are not looked at."""

    def column(self, **_options: object) -> Drawn:
        return Drawn(self.found)

    row = box = column


@pytest.mark.parametrize(("lighting", "basis"), [("environment", None), ("local", "cloud"), ("both", "surfaces")])
def test_panels_draw_every_setting(lighting: str, basis: str | None, settings: bpy.types.PropertyGroup) -> None:
    from prt.panels import bake, check, live_materials, preview
    from prt.panels import settings as expert

    settings.lighting, settings.targets = lighting, "collection"
    if basis is not None:
        settings.lamp_basis = basis
    found: set[str] = set()
    context = types.SimpleNamespace(scene=bpy.context.scene, window_manager=bpy.context.window_manager,
                                    selected_objects=[], region=types.SimpleNamespace(width=300),
                                    preferences=types.SimpleNamespace(system=types.SimpleNamespace(ui_scale=1.0)))
    panels = (bake.PRT_PT_bake, expert.PRT_PT_rays, expert.PRT_PT_highlights, expert.PRT_PT_local_lights,
              expert.PRT_PT_compression, live_materials.PRT_PT_live_materials, preview.PRT_PT_preview,
              check.PRT_PT_check)
    for sky, panel in itertools.product(("cubemap", "sh", "auto"), panels):
        settings.distant_basis = sky
        if "poll" not in vars(panel) or panel.poll(context):
            drawing = types.SimpleNamespace(layout=Drawn(found))
            drawing.column = lambda context, panel=panel, drawing=drawing: panel.column(drawing, context)
            if "draw_header" in vars(panel):
                panel.draw_header(drawing, context)
            panel.draw(drawing, context)
    lamps = {"lamp_basis", "cloud_region", "cloud_collection", "cloud_lights", "cloud_spacing"}
    own = {"cloud": {"merge_response", "zone_receivers", "cloud_emission"},
           "surfaces": {"surface_patches", "surface_columns"}}
    every = lamps | own["cloud"] | own["surfaces"]
    assert found & every == (set() if basis is None else lamps | own[basis])
    assert set(names(settings)) - every <= found


def test_a_collection_is_baked_whatever_is_selected(settings: bpy.types.PropertyGroup) -> None:
    """With those of collections in it; what renders do not show is left out, and an empty one says so."""
    from prt.operators.bake_session import chosen_targets
    from prt.prt_addon.errors import BadScene

    assert chosen_targets(bpy.context.scene) is None
    settings.targets = "collection"
    with pytest.raises(BadScene, match="no collection is chosen"):
        chosen_targets(bpy.context.scene)
    outer, inner = (bpy.data.collections.new(name) for name in ("Outer", "Inner"))
    bpy.context.scene.collection.children.link(outer)
    outer.children.link(inner)
    settings.target_collection = outer
    with pytest.raises(BadScene, match="Outer"):
        chosen_targets(bpy.context.scene)
    for collection, name in ((outer, "A"), (inner, "B"), (inner, "Hidden"), (bpy.context.scene.collection, "Other")):
        bpy.ops.mesh.primitive_cube_add()
        cube = bpy.context.object
        cube.name, cube.hide_render = name, name == "Hidden"
        bpy.context.collection.objects.unlink(cube)
        collection.objects.link(cube)
    assert sorted(chosen_targets(bpy.context.scene)) == ["A", "B"]
