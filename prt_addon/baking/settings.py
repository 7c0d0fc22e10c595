# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake is asked for: presets for artists, every number by name for scripts."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ..compression.eigentransport import MOST_VECTORS
from ..compression.settings import METHODS
from ..errors import BadArguments
from ..scene.texel_receivers import RECEIVERS, TexelChoice
from ..scene.unwrapping import METHODS as METHODS_OF_CHARTS

HIGHEST_ORDER = 10
GLOSSY_ROWS = (0, 4, 9, 16, 24, 25)
LIGHTINGS = ("environment", "local", "environment,local")
LAMP_BASES = ("surfaces", "cloud")
MERGED_RESPONSES = ("arithmetic", "harmonic", "solution")
MOST_CLOUD_LIGHTS = 4096
SAMPLINGS = ("automatic", "every", "sparse")
AUTO = "auto"
DISTANT_BASES = ("sh", "cubemap", AUTO)
EIGENTRANSPORT = "eigentransport"
ENCODERS = (*METHODS, EIGENTRANSPORT, AUTO)
# Vectors of a cluster: more than this only where there is but one cluster.
MOST_CLUSTER_VECTORS = 24


@dataclass(frozen=True)
class BakeSettings:
    """Settings of a bake. What each buys and costs.

    order: of the spherical harmonics (order^2 coefficients per receiver); higher = sharper shadows, more memory.
    directions: shadow rays per receiver over the whole sphere (half of them are traced).
    gather_directions: rays over the sphere that carry bounced light.
    bounces: of light; -1 = until less than bounce_error of the energy is left.
    bounce_error: relative energy that may be left out of the bounces.
    clusters, vectors: most clusters, and vectors per cluster, of the encoding (fewer where the signal needs fewer).
    encoder: "static", "iterative" or "adaptive" (Sloan 2003, 4.1-4.3), or "eigentransport" (Nowrouzezahrai 2007): one
        cluster for all receivers, with up to 192 vectors. "auto": clusters or eigentransport, whichever keeps a
        cubemap's light_error for less (basis_choice.py); clusters for harmonics.
    compression_error: relative RMS error of the encoding at which it stops; 0 uses all clusters and vectors.
    coherence: share of the squared error that may be added to the encoding so that fewer triangles lie in more than one
        cluster (Sloan 2003, section 5; the paper spent 0.05 to 0.1). 0 = off, because drawing does not need it: each
        vertex blends its own cluster in one pass. It serves export and renderers that draw cluster by cluster.
    spacing: longest triangle edge as a fraction of the baked objects' diagonal; coarser triangles are refined; 0 = off.
    receivers: "vertices", or "texels" of an atlas, spacing apart: on walls of few triangles, whose light then is as
        fine as the atlas and not as the mesh, and is a picture for game engines; "auto" = texels on objects of coarse
        triangles. atlas_size: most texels along a side of an object's atlas; with a spacing of 0 as many as fit.
    atlas_charts: what lays surfaces flat: "projection", "xatlas" (fewer charts on curved surfaces; not in every Python,
        and slow on meshes with errors) or "auto", which tries that first.
    rotation_group: receivers that share one random rotation of the directions; 0 = all share one set, unrotated.
    error_receivers, error_paths: receivers, and paths from each, of the reference that measures the error; 0 = none.
    glossy_rows: most functions of the view direction that a highlight gets (4, 9, 16, 24 or 25); 0 = none: only
        diffuse light is drawn, metals are black. Each row costs as much as the whole diffuse transfer.
    glossy_albedo: share of the light that a highlight must return to get rows (a plastic's returns 5 to 9 %, a metal's
        most); below, its light stays in the diffuse layer.
    glossy_window: whether highlights sharper than the light's order (with a cubemap, than their rows) reflect a softer
        light, which has no dark rings.
    subsurface: whether light travels through translucent materials.
    subsurface_links: links that each receiver of a translucent material keeps for the light of lamps, so that it
        travels through the body as they move; 64 serve, 0 = none. 16 bytes each, in the file and on the graphics card.
    distant_basis: what World and Suns are baked in. "sh": spherical harmonics of `order`. "cubemap": the texels of a
        cubemap, cubemap_size along an edge (2 to 32; 16 has 1,536 columns): shadows as sharp as a texel, where
        harmonics blur them. Costs memory and time with the texels' number, highlights with that of their rows too.
        "auto": the order, or the cubemap, that keeps light_error under the scene's present light for least
        (basis_choice.py); a million rays find out. A later light that is sharper is shown blurred.
    light_error: relative RMS of shadowed irradiance that may be lost, with what an automatic choice can't hold of the
        light. Order 5 loses 2 to 5 % under most HDRIs, 10 to 30 % under a hard sun.
    sampling: which elements of a cubemap's direct light are traced. "every": all. "sparse": about an eighth of them,
        from which the rest is woven (Huang 2010): as fast or slower on several cores, but clustered PCA starts from a
        part of the points then and takes less than half as long. Adds about 1 % of error, which is measured; not with
        highlights. "automatic": sparse where that is surely faster and its error no more than compression_error.
    memory_budget: GB of transfer kept in memory while a cubemap is baked; what is more goes to a file; 0 = no limit.
    fit_order_to_light: lower the order to what the scene's present light carries.
    lighting: "environment" (World and Suns), "local" (lamps that move within a light cloud), or both with a comma.
    lamp_basis: what the columns of lamps stand for. "surfaces": the surfaces that lamps shine on, found by shadow rays
        when relighting; right for lamps of all kinds at any place. "cloud": lights of a cloud, between which a lamp is
        interpolated (Kristensen 2005).
    surface_patches: most patches that surfaces are divided into. surface_columns: most columns: ways in which the light
        of lamps can differ after a bounce.
    cloud_region: name of a box empty, of a mesh that bounds a region, or of a collection of these, in which local
        lights will move; "" = the scene's free space.
    cloud_lights: most lights of the dense cloud (Kristensen 2005, section 4); each is one more global illumination
        solution. Of surfaces: places in the open from which their columns are learnt. cloud_spacing: metres between
        them instead; 0 = as cloud_lights allow.
    cloud_emission: order of the spherical harmonics of a light's directional emission, for spots and area lights
        (columns grow with its square); 0 = 1 where the scene has only Point lights, else 2.
    cloud_radius: metres; lights are diffuse spheres of this radius; 0 = points.
    zone_receivers: most receivers of a zone, in which lights merge for themselves (4.2); 0 = one zone.
    merge_distance: as a fraction of the scene's diagonal, above which two lights never merge (the inverse of w1).
    merge_response: as a fraction of the zone's brightest response, above which difference they never do (the inverse of
        w2); 0 = no merging.
    merged_response: "arithmetic" = the mean of the merged lights' responses: what a response that is linear in position
        would be at their mean place; "harmonic" = as published (4.1), which is darker; "solution" = a new solution at
        the merged place, which costs as much again as the cloud, once for every zone.
    live_editing: whether the bake keeps its form factors, so that bounced light in the preview follows base colours and
        emission that are edited later. Costs 8 bytes per receiver and entry.
    live_entries: most form factors kept per receiver; fewer cost less data and time, and make edits less exact.
    threads: 0 = one per core. seed: of all random choices.
    """

    order: int = 5
    directions: int = 2048
    gather_directions: int = 256
    bounces: int = -1
    bounce_error: float = 1e-3
    clusters: int = 256
    vectors: int = 8
    encoder: str = "iterative"
    compression_error: float = 2e-3
    coherence: float = 0.0
    spacing: float = 1.0 / 64.0
    receivers: str = "vertices"
    atlas_size: int = 512
    atlas_charts: str = "projection"
    rotation_group: int = 0
    error_receivers: int = 64
    error_paths: int = 8192
    glossy_rows: int = 16
    glossy_albedo: float = 0.15
    glossy_window: bool = True
    subsurface: bool = True
    subsurface_links: int = 0
    distant_basis: str = "sh"
    light_error: float = 0.05
    cubemap_size: int = 16
    sampling: str = "automatic"
    memory_budget: float = 2.0
    fit_order_to_light: bool = False
    lighting: str = "environment"
    lamp_basis: str = "surfaces"
    surface_patches: int = 2048
    surface_columns: int = 384
    cloud_region: str = ""
    cloud_lights: int = 216
    cloud_spacing: float = 0.0
    cloud_emission: int = 0
    cloud_radius: float = 0.0
    zone_receivers: int = 4096
    merge_distance: float = 0.5
    merge_response: float = 0.05
    merged_response: str = "arithmetic"
    live_editing: bool = False
    live_entries: int = 64
    threads: int = 0
    seed: int = 1

    @property
    def distant_light(self) -> bool:
        """Whether World and Suns are baked."""
        return "environment" in self.lighting.split(",")

    @property
    def local_light(self) -> bool:
        """Whether lamps within a light cloud are baked."""
        return "local" in self.lighting.split(",")

    @property
    def texels(self) -> TexelChoice | None:
        """Which objects get texels as receivers; None where none does."""
        return None if self.receivers == "vertices" else TexelChoice(self.receivers, self.atlas_size, self.atlas_charts)

    def as_dict(self) -> dict[str, Any]:
        """All settings by name, as stored in report and header."""
        return asdict(self)


PRESETS: dict[str, BakeSettings] = {
    "draft": BakeSettings(order=4, directions=256, gather_directions=128, bounce_error=1e-2, clusters=64, vectors=6,
                          surface_patches=1024, surface_columns=128, cloud_lights=64, encoder="static",
                          compression_error=1e-2, spacing=1.0 / 32.0,
                          error_receivers=32, error_paths=4096, glossy_rows=9, glossy_albedo=0.3,
                          light_error=0.1),
    "standard": BakeSettings(),
    "high": BakeSettings(order=7, directions=4096, gather_directions=1024, bounce_error=2e-4, clusters=1024, vectors=20,
                         surface_patches=4096, surface_columns=512, cloud_lights=512, merge_response=0.02,
                         encoder="adaptive", compression_error=5e-4,
                         spacing=1.0 / 128.0, error_receivers=128, error_paths=16384, glossy_rows=24,
                         glossy_albedo=0.03, light_error=0.025),
}

# Inclusive limits of each number, and why there is a limit at all.
_LIMITS: dict[str, tuple[float, float, str]] = {
    "order": (1, HIGHEST_ORDER, "the conventions are tested to order 10"),
    "directions": (16, 2 ** 20, "fewer see no shadow"),
    "gather_directions": (16, 2 ** 16, "fewer see no bounce"),
    "bounces": (-1, 1000, "-1 means as many as it takes"),
    "bounce_error": (1e-7, 1.0, "single precision ends at 1e-7"),
    "clusters": (1, 4096, "the shader's cluster table"),
    "vectors": (0, MOST_VECTORS, "48 FLOAT4 attributes"),
    "cubemap_size": (2, 32, "6,144 columns"),
    "light_error": (1e-3, 1.0, "the choice is measured at few receivers"),
    "memory_budget": (0.0, 1e6, "0 means no limit"),
    "compression_error": (0.0, 1.0, "it is relative"),
    "coherence": (0.0, 0.5, "the encoder's work would be undone"),
    "spacing": (0.0, 1.0, "it is a fraction of the diagonal"),
    "atlas_size": (8, 4096, "an atlas of more does not fit every graphics card's memory"),
    "rotation_group": (0, 2 ** 20, "0 means one set for all"),
    "error_receivers": (0, 4096, "the reference is slow"),
    "error_paths": (64, 2 ** 20, "fewer say nothing"),
    "glossy_rows": (0, 25, "order 5 of the hemisphere"),
    "glossy_albedo": (0.0, 1.0, "it is a share of the light"),
    "subsurface_links": (0, 256, "more than the sum over all receivers needs"),
    "surface_patches": (1, 2 ** 14, "each is one more solution"),
    "surface_columns": (1, 1024, "each is carried by every cluster"),
    "cloud_lights": (1, MOST_CLOUD_LIGHTS, "each is a global illumination solution"),
    "cloud_spacing": (0.0, 1e9, "0 means as cloud_lights allow"),
    "cloud_emission": (0, 4, "columns grow with its square"),
    "cloud_radius": (0.0, 1e9, "0 means points"),
    "zone_receivers": (0, 2 ** 31 - 1, "0 means one zone"),
    "merge_distance": (0.0, 1e6, "it is a fraction of the scene"),
    "merge_response": (0.0, 1e6, "it is a fraction of the brightest response"),
    "live_entries": (8, 1024, "eight see too little, and few rows are longer"),
    "threads": (0, 1024, "0 means one per core"),
    "seed": (0, 2 ** 31 - 1, "a non-negative number"),
}


def make_settings(preset: str, overrides: dict[str, str] | None = None) -> BakeSettings:
    """Settings of a preset with overrides by name (texts, as on a command line). Raises BadArguments."""
    if preset not in PRESETS:
        raise BadArguments(f"preset {preset}", "there is no such preset", f"Use one of {', '.join(PRESETS)}")
    known = {field.name: field.type for field in fields(BakeSettings)}
    values: dict[str, Any] = {}
    for name, text in (overrides or {}).items():
        if name not in known:
            raise BadArguments(f"setting {name}", "there is no such setting", f"Use one of {', '.join(known)}")
        values[name] = _parsed(name, known[name], str(text))
    return check(replace(PRESETS[preset], **values))


def parse_overrides(text: str) -> dict[str, str]:
    """Overrides for `make_settings` from "name=value, name=value". Raises BadArguments."""
    found = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = item.partition("=")
        if not (name.strip() and equals):
            raise BadArguments(f"overrides {item!r}", "it is not NAME=VALUE", "Write name=value, name=value")
        found[name.strip()] = value.strip()
    return found


def _parsed(name: str, kind: Any, text: str) -> Any:
    """A setting's value from its text."""
    try:
        if kind == "bool":
            return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}[text.lower()]
        return {"int": int, "float": float, "str": str}[kind](text)
    except (ValueError, KeyError) as error:
        expected = {"bool": "true or false", "int": "a whole number", "float": "a number", "str": "a word"}[kind]
        raise BadArguments(f"setting {name}", f"{text!r} is not {expected}", f"Write {name}=VALUE") from error


def check(settings: BakeSettings) -> BakeSettings:
    """The settings themselves where all are within limits. Raises BadArguments."""
    for name, (low, high, why) in _LIMITS.items():
        value = getattr(settings, name)
        if not low <= value <= high:  # also catches NaN
            raise BadArguments(f"setting {name}", f"{value} is outside {low:g} to {high:g} ({why})",
                               "Choose a value inside")
    if settings.glossy_rows not in GLOSSY_ROWS:
        raise BadArguments("setting glossy_rows", f"{settings.glossy_rows} is no set of functions of the hemisphere",
                           f"Use one of {', '.join(map(str, GLOSSY_ROWS))}")
    for name, words in (("lighting", LIGHTINGS), ("merged_response", MERGED_RESPONSES), ("lamp_basis", LAMP_BASES),
                        ("distant_basis", DISTANT_BASES), ("sampling", SAMPLINGS), ("receivers", RECEIVERS),
                        ("atlas_charts", METHODS_OF_CHARTS)):
        if getattr(settings, name) not in words:
            raise BadArguments(f"setting {name}", f"{getattr(settings, name)!r} is unknown",
                               f"Use one of {' or '.join(words)}")
    if settings.encoder not in ENCODERS:
        raise BadArguments("setting encoder", f"{settings.encoder!r} is not an encoder",
                           f"Use one of {', '.join(ENCODERS)}")
    if settings.vectors > MOST_CLUSTER_VECTORS and settings.encoder != EIGENTRANSPORT:
        raise BadArguments("setting vectors", f"{settings.vectors} is outside 0 to {MOST_CLUSTER_VECTORS} (six FLOAT4 "
                           "attributes)", "Choose a value inside, or encoder=eigentransport")
    return settings
