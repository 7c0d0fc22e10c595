# SPDX-License-Identifier: GPL-3.0-or-later
"""What the user sets (saved with the scene) and what panels show of this session (never saved, never undone)."""

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..prt_addon.baking.settings import HIGHEST_ORDER, MOST_CLOUD_LIGHTS, PRESETS

# Explicit numbers: files store them, so that a preset inserted later changes no old file.
PRESET_ITEMS = (
    ("draft", "Draft", "Seconds: soft shadows, a few per cent of error. To see whether the scene works", 0),
    ("standard", "Standard", "A minute or so: what most scenes need", 1),
    ("high", "High", "Several minutes and more memory: sharper shadows, errors below one per cent", 2),
)
LIGHTING_ITEMS = (
    ("environment", "Environment", "World and Suns. Costs what order and shadows cost", 0),
    ("local", "Local Lights", "Point, Spot and Area lamps that move after the bake, with the light that they bounce. "
                              "Costs one more solution for each light of the cloud", 1),
    ("both", "Both", "World, Suns and lamps that move. Costs both bakes, and one set of data holds both", 2),
)
LAMP_BASIS_ITEMS = (
    ("surfaces", "Lit Surfaces", "The surfaces that lamps shine on, found by shadow rays when relighting: right for "
                                 "lamps of all kinds at any place. Costs shadow rays for each lamp that moves", 0),
    ("cloud", "Light Cloud", "Lights of a cloud, between which a lamp is interpolated: a little faster to relight, "
                             "less exact near to surfaces, and without bounced light outside of the cloud", 1),
)
DISPLAY_ITEMS = (
    ("relit", "Light", "The objects as World, Suns and lamps light them", 0),
    ("clusters", "Clusters", "A colour for each cluster of receivers that share their basis vectors. Costs nothing; "
                             "the view transform does not touch these colours", 1),
    ("error", "Error", "How far compression is off at each receiver, relative to the object's mean transfer. Costs "
                       "nothing, but needs a bake that kept its errors", 2),
    ("vectors", "Vectors", "How many basis vectors each cluster has. Costs nothing; they differ with the adaptive "
                           "encoder, or where less is enough", 3),
)
LIGHTINGS = {"environment": "environment", "local": "local", "both": "environment,local"}
GLOSSY_ROWS_ITEMS = (
    ("0", "None", "Only diffuse light: metal is black. The fastest, and the least data", 0),
    ("4", "4 Functions", "A soft sheen. Costs as much as 4 diffuse bakes of the shiny objects", 1),
    ("9", "9 Functions", "Rough metal and satin. Costs as much as 9 diffuse bakes of the shiny objects", 2),
    ("16", "16 Functions", "Most plastics and metals. Costs as much as 16 diffuse bakes of the shiny objects", 3),
    ("24", "24 Functions", "Sharper highlights. Costs as much as 24 diffuse bakes of the shiny objects", 4),
    ("25", "25 Functions", "One function more than 24, for next to nothing gained: to compare with published data", 5),
)
ENCODER_ITEMS = (
    ("static", "Static", "Clusters first, vectors afterwards. The fastest, with a third more error than iterative", 0),
    ("iterative", "Iterative", "Clusters follow as vectors are added. Costs some seconds more than static", 1),
    ("adaptive", "Adaptive", "Clusters that need more vectors get them. The least error for the same data, at up to "
                             "twice the time", 2),
    ("eigentransport", "Eigentransport", "One basis for all receivers, with more vectors. Relights fast; needs about a "
                                         "hundred vectors, and blurs or rings in hard shadows", 3),
    ("auto", "Automatic", "Clusters; of a cubemap eigentransport where that shows the present light as exactly for "
                          "less time and data. Analyze tells which", 4),
)
DISTANT_BASIS_ITEMS = (
    ("sh", "Spherical Harmonics", "Smooth functions: small, fast, with highlights and translucency. A sun's shadows "
                                  "are as soft as the order says", 0),
    ("cubemap", "Cubemap", "The texels of a cubemap: shadows of suns as sharp as a texel. Costs several times the time "
                           "and memory; highlights several times as much again", 1),
    ("auto", "Automatic", "Harmonics or a cubemap, as large as the present light needs for the asked error. Costs a "
                          "second; a sharper light that comes later is shown blurred. Analyze tells what and why", 2),
)
SAMPLING_ITEMS = (
    ("automatic", "Automatic", "All texels, unless fewer are surely faster and exact enough. The report says why", 0),
    ("every", "Every Element", "Rays for all texels at all receivers. No error, and mostly the fastest", 1),
    ("sparse", "Sparse", "Rays for about an eighth of them; the rest is woven from neighbours. Shadows take about as "
                         "long, compression less than half, as it starts from fewer points. Adds up to about 1 % of "
                         "error; the report states it", 2),
)
RECEIVERS_ITEMS = (
    ("vertices", "Vertices", "Light is kept at the mesh's vertices, and between them on faces longer than Longest "
                             "Edge. The least data for fine meshes", 0),
    ("texels", "Texels", "Light is kept in a picture laid over each object, Longest Edge apart: walls of two triangles "
                         "get fine shadows, and the light can be exported as textures. Costs a little more data, and "
                         "many small texels on fine or faceted meshes", 1),
    ("auto", "Automatic", "Texels on objects whose faces are much longer than Longest Edge, vertices on all others", 2),
)
TARGET_ITEMS = (
    ("selected", "Selected Objects", "The selected meshes; all that renders show when none is selected", 0),
    ("collection", "Collection", "The meshes of a collection, whatever is selected", 1),
)
# What presets differ in, and so fill in; the rest belongs to the scene rather than to the quality, and stays.
QUALITY = ("order", "directions", "gather_directions", "bounce_error", "spacing", "encoder", "clusters", "vectors",
           "compression_error", "error_receivers", "error_paths", "glossy_rows", "glossy_albedo", "light_error",
           "surface_patches",
           "surface_columns", "cloud_lights", "merge_response")
# What goes into a bake under its own name.
OWN_NAMES = (*QUALITY, "glossy_window", "subsurface", "subsurface_links", "coherence", "lamp_basis", "cloud_spacing",
             "cloud_emission", "distant_basis", "cubemap_size", "sampling", "memory_budget", "receivers", "atlas_size",
             "zone_receivers", "fit_order_to_light", "live_editing", "live_entries", "threads", "seed")
ROUNDING = 1e-6  # of single precision


def _take_preset(settings: PRTSettings, _context: bpy.types.Context) -> None:
    """Choosing a preset fills in what presets differ in."""
    preset = PRESETS[settings.preset]
    for name in QUALITY:
        value = getattr(preset, name)
        setattr(settings, name, str(value) if name == "glossy_rows" else value)


def _may_bound(_settings: PRTSettings, candidate: bpy.types.Object) -> bool:
    """Whether an object can bound a region of lights; the bake says what is wrong with one that does not."""
    return candidate.type in ("EMPTY", "MESH")


def _redraw(_settings: PRTSettings, _context: bpy.types.Context) -> None:
    """What the viewport shows depends on this setting; Blender does not know."""
    redraw("WINDOW")


def _light_changed(_settings: PRTSettings, _context: bpy.types.Context) -> None:
    """The preview's light depends on this setting."""
    from .live_preview import light_changed  # it needs this module to be loaded

    light_changed()


class PRTSettings(bpy.types.PropertyGroup):
    """Settings of the bake and of the preview: Scene.prt."""

    targets: EnumProperty(
        name="Bake", items=TARGET_ITEMS, default="selected",
        description="Which meshes get light transfer, and so can be relit. Each costs time and data by its vertices; "
                    "everything else that renders show casts shadows and bounces light all the same",
    )
    target_collection: PointerProperty(
        name="Collection", type=bpy.types.Collection,
        description="Its meshes, and those of collections in it, are baked. What renders do not show is left out",
    )
    preset: EnumProperty(
        name="Preset", items=PRESET_ITEMS, default="standard", update=_take_preset,
        description="How much time a bake may cost and how exact it gets",
    )
    order: IntProperty(
        name="Order", min=1, max=HIGHEST_ORDER, default=PRESETS["standard"].order,
        description="Bands of the lighting. Higher buys sharper shadows; memory and relighting cost grow with the "
                    "square",
    )
    distant_basis: EnumProperty(
        name="Sky By", items=DISTANT_BASIS_ITEMS, default=PRESETS["standard"].distant_basis,
        description="What World and Suns are baked in",
    )
    light_error: FloatProperty(
        name="Light Error", min=1e-3, max=1.0, soft_max=0.3, precision=3, step=0.5,
        default=PRESETS["standard"].light_error,
        description="Share of the shadows of the present light that an automatic sky may lose (relative RMS). Lower "
                    "buys sharper shadows; time and data grow, under a sun many times",
    )
    cubemap_size: IntProperty(
        name="Texels", min=2, max=32, default=PRESETS["standard"].cubemap_size,
        description="Along each edge of the cubemap. Twice as many show shadows twice as sharp; time, memory and disk "
                    "grow with the square",
    )
    sampling: EnumProperty(
        name="Sampling", items=SAMPLING_ITEMS, default=PRESETS["standard"].sampling,
        description="Of a cubemap's texels, which get rays from which receivers",
    )
    memory_budget: FloatProperty(
        name="Memory", min=0.0, soft_max=64.0, precision=1, default=PRESETS["standard"].memory_budget,
        description="Gigabytes of transfer kept in memory while a cubemap is baked; more goes to a file, which costs "
                    "time. 0 is no limit",
    )
    bounces: BoolProperty(
        name="Bounced Light", default=True,
        description="Light from surface to surface: colours bleed, corners brighten. Costs about as long again as "
                    "the shadows",
    )
    exposure: FloatProperty(
        name="Exposure", update=_redraw, default=0.0, soft_min=-5.0, soft_max=5.0, step=10, precision=2,
        description="Brightens the preview alone, in stops. Costs nothing and changes no baked data",
    )

    display: EnumProperty(
        name="Show", items=DISPLAY_ITEMS, default="relit", update=_redraw,
        description="What the preview shows of baked objects: their light, or how they are compressed",
    )
    show_cloud: BoolProperty(
        name="Show Light Cloud", update=_redraw, default=False,
        description="Marks the lights of the light cloud (grey; merged ones in their zone's colour), or the patches of "
                    "the surfaces that lamps shine on. Costs some drawing while on, nothing while off",
    )
    lamps_by_directions: BoolProperty(
        name="Lamps from Afar", update=_light_changed, default=False,
        description="Point, Spot and Area lamps light bakes made without local lights, by the directions nearest to "
                    "them. Only lamps outside the hull of the scene: from 3 radii of the object on as exact as a Sun, "
                    "at 1.5 radii 14 % off beside a ground. Costs some milliseconds a lamp",
    )
    window: BoolProperty(
        name="Soften Ringing", update=_light_changed, default=False,
        description="Takes dark ripples around very bright, small lights away. Costs some of the light's detail, and "
                    "nothing where nothing rings",
    )

    directions: IntProperty(
        name="Shadow Rays", min=16, max=2 ** 20, soft_max=16384, default=PRESETS["standard"].directions,
        description="Rays around each receiver that find what shadows it. Twice as many take twice as long and halve "
                    "the noise of sharp shadows",
    )
    gather_directions: IntProperty(
        name="Bounce Rays", min=16, max=2 ** 16, soft_max=4096, default=PRESETS["standard"].gather_directions,
        description="Rays around each receiver that find the surfaces which light it. More buys smoother bounced light "
                    "in corners, at the cost of time and memory in proportion",
    )
    bounce_error: FloatProperty(
        name="Bounces Until", min=1e-7, max=1.0, precision=5, step=0.01, default=PRESETS["standard"].bounce_error,
        description="Share of the light that further bounces may leave out. Lower follows more bounces in bright, "
                    "closed rooms, and costs a fraction of a second for each",
    )
    spacing: FloatProperty(
        name="Longest Edge", min=0.0, max=1.0, precision=4, step=0.1, default=PRESETS["standard"].spacing,
        description="Longest triangle edge as a share of the scene's size; larger triangles get receivers in "
                    "between, on a hidden mesh. Half as long shows sharper shadows on large faces for up to four "
                    "times the cost. 0 leaves meshes as they are",
    )
    receivers: EnumProperty(
        name="Receivers", items=RECEIVERS_ITEMS, default=PRESETS["standard"].receivers,
        description="Where the baked light is kept",
    )
    atlas_size: IntProperty(
        name="Most Texels", min=8, max=4096, default=PRESETS["standard"].atlas_size,
        description="Along a side of each object's picture. Where Longest Edge asks for more, texels get coarser. "
                    "Twice as many cost up to four times the time, memory and data",
    )
    fit_order_to_light: BoolProperty(
        name="Fit Order to Light", default=PRESETS["standard"].fit_order_to_light,
        description="Lower the order to what the light of this moment needs. Saves time and data under soft skies; "
                    "sharper light that comes later is shown blurred",
    )
    threads: IntProperty(
        name="Threads", min=0, max=1024, soft_max=64, default=PRESETS["standard"].threads,
        description="Processor threads of the bake. Fewer leave more of the machine to other work; results stay the "
                    "same. 0 uses every core",
    )
    seed: IntProperty(
        name="Seed", min=0, default=PRESETS["standard"].seed,
        description="Of all random choices. The same seed bakes the same data; another one shows what is noise. Costs "
                    "nothing",
    )

    encoder: EnumProperty(
        name="Encoder", items=ENCODER_ITEMS, default=PRESETS["standard"].encoder,
        description="How clusters and their vectors are found",
    )
    clusters: IntProperty(
        name="Most Clusters", min=1, max=4096, default=PRESETS["standard"].clusters,
        description="Groups of receivers that share basis vectors. More buys less error; data grows, and each change "
                    "of light costs a little more",
    )
    vectors: IntProperty(
        name="Most Vectors", min=0, max=192, soft_max=24, default=PRESETS["standard"].vectors,
        description="Basis vectors of each cluster. More buys less error; every receiver stores one number for each. "
                    "Up to 24, with Eigentransport up to 192",
    )
    compression_error: FloatProperty(
        name="Error Goal", min=0.0, max=1.0, precision=4, step=0.1, default=PRESETS["standard"].compression_error,
        description="Relative error at which compression stops adding clusters and vectors. Higher buys less data. 0 "
                    "uses all of them",
    )
    error_receivers: IntProperty(
        name="Receivers", min=0, max=4096, default=PRESETS["standard"].error_receivers,
        description="Random receivers at which the finished bake is measured against independent path tracing. More "
                    "buys a surer figure for some seconds; 0 measures nothing",
    )
    error_paths: IntProperty(
        name="Paths", min=64, max=2 ** 20, default=PRESETS["standard"].error_paths,
        description="Paths from each of those receivers. More buys a measurement with less noise of its own, and "
                    "costs time in proportion",
    )

    lighting: EnumProperty(
        name="Lighting", items=LIGHTING_ITEMS, default="environment",
        description="What will light the scene after the bake",
    )

    glossy_rows: EnumProperty(
        name="Functions", items=GLOSSY_ROWS_ITEMS, default=str(PRESETS["standard"].glossy_rows),
        description="Most functions of the view that a highlight gets; soft ones get fewer. More buys sharper "
                    "highlights; time and data grow in proportion",
    )
    glossy_albedo: FloatProperty(
        name="Least Share", min=0.0, max=1.0, precision=3, default=PRESETS["standard"].glossy_albedo,
        description="Share of the light that a highlight must return to be baked; plastic returns 0.05 to 0.09, metal "
                    "most of it. Lower buys fainter highlights, and makes their objects cost as much as shiny ones",
    )
    glossy_window: BoolProperty(
        name="Soften Sharp Ones", default=PRESETS["standard"].glossy_window,
        description="Highlights sharper than the light's order, or with a cubemap than their functions, reflect a "
                    "softer light. Buys highlights without dark rings, costs some of their sharpness and no time",
    )
    subsurface: BoolProperty(
        name="Translucency", default=PRESETS["standard"].subsurface,
        description="Light that travels through skin, wax and marble. Costs seconds and three colour channels where a "
                    "material has subsurface light, and nothing elsewhere",
    )
    subsurface_links: IntProperty(
        name="Lamp Links", min=0, max=256, default=PRESETS["standard"].subsurface_links,
        description="Lets the light of lamps travel through skin, wax and marble while they move. Each point of such a "
                    "material gathers from so many patches of its surface: 16 show blocks, 64 are smooth. Costs 16 "
                    "bytes per point and link in the file and on the graphics card: 64 links of 50,000 points are "
                    "51 MB and 10 seconds of the bake. 0 is off",
    )
    live_editing: BoolProperty(
        name="Live Materials", default=PRESETS["standard"].live_editing,
        description="Bounced light in the preview follows base colours and emission that you change later, without a "
                    "new bake. Costs half a MB of data for 1,000 receivers at 64 Entries, hardly any time, and a "
                    "separate mesh for objects of several materials",
    )
    live_entries: IntProperty(
        name="Entries", min=8, max=1024, soft_max=256, default=PRESETS["standard"].live_entries,
        description="What each receiver remembers of the surfaces that it sees. More follow edits more exactly; each "
                    "costs 8 bytes, and time at every edit",
    )
    coherence: FloatProperty(
        name="Coherence", min=0.0, max=0.5, precision=3, default=PRESETS["standard"].coherence,
        description="Share of the squared error that may be added so that fewer triangles lie in several clusters. "
                    "Serves exports to renderers that draw cluster by cluster; the preview does not need it. 0 is off",
    )

    lamp_basis: EnumProperty(
        name="Lamps By", items=LAMP_BASIS_ITEMS, default=PRESETS["standard"].lamp_basis,
        description="What stands for lamps in the bake",
    )
    surface_patches: IntProperty(
        name="Patches", min=1, max=2 ** 14, default=PRESETS["standard"].surface_patches,
        description="Most patches that lit surfaces are divided into. More follow small spots and lamps near to "
                    "surfaces; each costs one more solution of the bounced light",
    )
    surface_columns: IntProperty(
        name="Columns", min=1, max=1024, default=PRESETS["standard"].surface_columns,
        description="Ways in which the light of lamps can differ after a bounce. More follow lamps near to surfaces "
                    "and behind openings; every cluster holds them, so data and time grow with them",
    )
    cloud_region: PointerProperty(
        name="Region", type=bpy.types.Object, poll=_may_bound,
        description="A cube empty, or a mesh hidden in renders, within which lamps will move. A small region buys a "
                    "denser cloud at the same cost; empty takes the scene's free space",
    )
    cloud_collection: PointerProperty(
        name="Regions", type=bpy.types.Collection,
        description="Several regions: a collection of cube empties, or of meshes hidden in renders. Used where no "
                    "single region is chosen",
    )
    cloud_lights: IntProperty(
        name="Lights", min=1, max=MOST_CLOUD_LIGHTS, soft_max=1000, default=PRESETS["standard"].cloud_lights,
        description="Most lights of the cloud. More follow a moving lamp more closely; each costs one more solution "
                    "of the bounced light, and room on disk while baking",
    )
    cloud_spacing: FloatProperty(
        name="Spacing", min=0.0, soft_max=10.0, precision=3, unit="LENGTH", default=PRESETS["standard"].cloud_spacing,
        description="Distance between the lights of the cloud, in place of their number. Smaller follows a moving lamp "
                    "more closely; half of it costs eight times as much. 0 is as Lights allow",
    )
    cloud_emission: IntProperty(
        name="Emission Order", min=0, max=4, default=PRESETS["standard"].cloud_emission,
        description="How sharply lights of the cloud can shine in one direction, for Spot and Area lamps. Columns and "
                    "data grow with its square. 0 chooses by the scene's lamps",
    )
    merge_response: FloatProperty(
        name="Merge Below", min=0.0, soft_max=1.0, precision=3, default=PRESETS["standard"].merge_response,
        description="Lights merge whose light differs less than this share of the brightest. Higher buys less data and "
                    "faster relighting, at the price of less exact bounced light. 0 merges none",
    )
    zone_receivers: IntProperty(
        name="Zone Size", min=0, soft_max=100_000, default=PRESETS["standard"].zone_receivers,
        description="Most receivers of a zone; lights merge zone by zone. Smaller zones merge more lights far away and "
                    "need less memory, but hold more bases. 0 is one zone",
    )

    compare_samples: IntProperty(
        name="Samples", min=2, max=2 ** 16, soft_max=4096, default=64,
        description="Samples of Cycles in each pixel. Four times as many halve its noise and cost four times the time",
    )
    compare_percentage: FloatProperty(
        name="Size", min=1.0, max=100.0, default=50.0, precision=0, subtype="PERCENTAGE",
        description="Of the output resolution. Half of it costs a quarter of the time; which pixels differ is seen "
                    "less finely",
    )

    def overrides(self) -> dict[str, str]:
        """What these settings change in their preset, by name, as `make_settings` takes it."""
        preset = PRESETS[self.preset]
        # Files of older versions lack newer settings: what was never set is the preset's, not the default.
        changed = {name: _text(getattr(self, name)) for name in OWN_NAMES
                   if self.is_property_set(name) and _differ(getattr(self, name), getattr(preset, name))}
        if not self.bounces:
            changed["bounces"] = "0"
        if LIGHTINGS[self.lighting] != preset.lighting:
            changed["lighting"] = LIGHTINGS[self.lighting]
        region = self.cloud_region or self.cloud_collection
        if region is not None:
            changed["cloud_region"] = region.name
        return changed


def _differ(value: float | str, other: float | str) -> bool:
    """Whether a setting is another one than a preset's; Blender keeps floats in single precision."""
    if isinstance(other, str):
        return value != other
    return abs(float(value) - float(other)) > ROUNDING * abs(float(other)) + 1e-12


def _text(value: float | str) -> str:
    """A number, switch or word as on a command line; single precision has seven digits."""
    return f"{value:.7g}" if isinstance(value, float) else str(value)


class PRTBakedObject(bpy.types.PropertyGroup):
    """A line of the panel's results. `name` is the object's name."""

    clusters: IntProperty()
    points: IntProperty()
    error: FloatProperty(default=-1.0)
    highlight_error: FloatProperty(default=-1.0)
    lamp_error: FloatProperty(default=-1.0)
    lamp_highlight_error: FloatProperty(default=-1.0)
    overdraw: FloatProperty()
    overdraw_before: FloatProperty()
    error_spent: FloatProperty()
    receiver_errors: BoolProperty()
    stale: StringProperty()


class PRTSession(bpy.types.PropertyGroup):
    """What panels show of this session: WindowManager.prt. Written by operators and handlers, never by panels."""

    running: BoolProperty()
    title: StringProperty()
    waiting: StringProperty()
    ended: StringProperty()
    interrupted: StringProperty()
    stage: StringProperty()
    fraction: FloatProperty()
    seconds_left: FloatProperty(default=-1.0)
    message: StringProperty()
    failed: BoolProperty()
    preview: BoolProperty()
    preview_message: StringProperty()
    live_materials: StringProperty()
    viewport_message: StringProperty()
    objects: CollectionProperty(type=PRTBakedObject)
    cloud: StringProperty()
    analysis: StringProperty()
    last_bake: StringProperty()
    comparison: StringProperty()


def session(context: bpy.types.Context | None = None) -> PRTSession:
    """The session's state."""
    return (context or bpy.context).window_manager.prt


def assign(owner: bpy.types.PropertyGroup, **values: object) -> None:
    """Write properties that change, and have the sidebars drawn anew if any did."""
    changed = {name: value for name, value in values.items() if getattr(owner, name) != value}
    for name, value in changed.items():
        setattr(owner, name, value)
    if changed:
        redraw("UI")


def redraw(kind: str) -> None:
    """Have a kind of region (UI: the sidebar, WINDOW: the picture) of every 3D viewport drawn anew."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == kind:
                        region.tag_redraw()


def register() -> None:
    """Attach both groups; their classes are registered by the root."""
    bpy.types.Scene.prt = PointerProperty(type=PRTSettings)
    bpy.types.WindowManager.prt = PointerProperty(type=PRTSession)


def unregister() -> None:
    """Detach both groups. Values in scenes stay as plain data and return with the extension."""
    del bpy.types.WindowManager.prt
    del bpy.types.Scene.prt
