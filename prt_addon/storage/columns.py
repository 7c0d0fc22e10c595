# SPDX-License-Identifier: GPL-3.0-or-later
"""Which lighting basis the columns of baked transfer belong to, as a header states it.

Columns are those of distant light, in spherical harmonics or in texels of a cubemap, then those of local light: of the
lights of a cloud, or of the surfaces that lamps shine on; either part may be missing. A cloud's columns mean other
lights in every zone (Kristensen et al. 2005, 4.2); zones of fewer lights leave their last columns zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ..errors import StorageError

SPHERICAL_HARMONICS, LIGHT_CLOUD, JOINED = "spherical_harmonics", "light_cloud", "joined"
LIT_SURFACES, CUBEMAP = "lit_surfaces", "cubemap"
LOCAL = (LIGHT_CLOUD, LIT_SURFACES)


@dataclass(frozen=True)
class Columns:
    """order: of the distant light's spherical harmonics, 0 without that part; cloud: columns of local light; cubemap:
    texels along an edge of the distant light's cubemap, 0 where it is none."""

    order: int
    cloud: int = 0
    cubemap: int = 0

    @property
    def distant(self) -> int:
        """Columns of distant light: the first ones."""
        return self.order ** 2 + 6 * self.cubemap ** 2  # one of them is 0

    @property
    def total(self) -> int:
        """All columns."""
        return self.distant + self.cloud


def columns_entry(columns: Columns, emission_order: int = 1, spacing: float = 0.0, radius: float = 0.0,
                  lights: tuple[int, ...] = (), zones: tuple[int, ...] = ()) -> dict[str, Any]:
    """`columns` of a header. emission_order, spacing (m), radius (m): of the cloud; lights: in each of its zones;
    zones: of each of the object's clusters."""
    distant = distant_entry(columns)
    if not columns.cloud:
        return distant
    cloud = {"kind": LIGHT_CLOUD, "columns": columns.cloud, "emission_order": emission_order, "spacing": spacing,
             "radius": radius, "lights": [int(n) for n in lights], "cluster_zone": [int(z) for z in zones],
             "holds": "indirect light of 1 W/sr"}
    return {"kind": JOINED, "parts": [distant, cloud]} if columns.distant else cloud


def distant_entry(columns: Columns) -> dict[str, Any]:
    """The part of a header's `columns` that is distant light's."""
    if columns.cubemap:
        return {"kind": CUBEMAP, "size": columns.cubemap, "faces": "+X -X +Y -Y +Z -Z",
                "index": "(face * size + row) * size + column; face of axis a: u along a+1 (column), v along a+2 (row)",
                "holds": "response to radiance 1 from the texel: its solid angle is in it"}
    return {"kind": SPHERICAL_HARMONICS, "order": columns.order, "condon_shortley": False}


def surfaces_entry(columns: Columns, triangles: int, patches: int, clusters: int) -> dict[str, Any]:
    """`columns` of a header whose local part is lit surfaces. clusters: of the object."""
    distant = distant_entry(columns)
    lit = {"kind": LIT_SURFACES, "columns": columns.cloud, "triangles": triangles, "patches": patches,
           "cluster_zone": [0] * clusters, "holds": "indirect light; axes . mean E / pi of the patches"}
    return {"kind": JOINED, "parts": [distant, lit]} if columns.distant else lit


def parts_of(entry: Any) -> list[dict[str, Any]]:
    """The parts of a header's `columns`."""
    if not isinstance(entry, dict):
        return []
    parts = entry.get("parts") if entry.get("kind") == JOINED else [entry]
    return [part for part in parts if isinstance(part, dict)] if isinstance(parts, list) else []


def cloud_part(entry: Any) -> dict[str, Any] | None:
    """The part of a header's `columns` that is local light's; None without."""
    return next((part for part in parts_of(entry) if part.get("kind") in LOCAL), None)


def cubemap_size(entry: Any) -> int:
    """Texels along an edge of the cubemap of a header's `columns`; 0 where distant light is none."""
    part = next((part for part in parts_of(entry) if part.get("kind") == CUBEMAP), None)
    size = 0 if part is None else part.get("size")
    return size if type(size) is int and size > 0 else 0


def read_columns(header: dict[str, Any], subject: str, remedy: str) -> Columns:
    """The columns that a header states. Raises StorageError where they are of no known kind or do not fit the shape."""
    total = header["shape"][3]
    parts = parts_of(header.get("columns", {"kind": SPHERICAL_HARMONICS, "order": math.isqrt(total)}))
    kinds = [part.get("kind") for part in parts]
    distant = (SPHERICAL_HARMONICS, CUBEMAP)
    if kinds not in (*([one] for one in (*distant, *LOCAL)), *([one, local] for one in distant for local in LOCAL)):
        raise StorageError(subject, "the header of its baked data states no known lighting basis", remedy)
    cloud = parts[-1] if kinds[-1] in LOCAL else None
    if cloud is not None:
        _check_cloud(cloud, header["shape"][0], subject, remedy)
    order = math.isqrt(total - (cloud["columns"] if cloud else 0)) if kinds[0] == SPHERICAL_HARMONICS else 0
    found = Columns(order, cloud["columns"] if cloud else 0, cubemap_size(header.get("columns")))
    if found.total != total or (kinds[0] == CUBEMAP) != (found.cubemap > 0):
        raise StorageError(subject, "the header of its baked data states no valid shape", remedy)
    return found


def _check_cloud(cloud: dict[str, Any], clusters: int, subject: str, remedy: str) -> None:
    """Raise StorageError where a local part's numbers contradict each other."""
    if cloud["kind"] == LIT_SURFACES:
        counts = [cloud.get(name) for name in ("columns", "triangles", "patches")]
        if not (all(type(n) is int and n >= 0 for n in counts) and counts[0] > 0 and counts[2] > 0
                and cloud.get("cluster_zone") == [0] * clusters):
            raise StorageError(subject, "the header of its baked data states no valid lit surfaces", remedy)
        return
    numbers = [cloud.get(name) for name in ("columns", "emission_order")]
    lights, zones = cloud.get("lights"), cloud.get("cluster_zone")
    valid = all(type(n) is int and n > 0 for n in numbers) and all(
        isinstance(values, list) and all(type(n) is int and n >= 0 for n in values) for values in (lights, zones))
    lengths = all(type(cloud.get(n)) in (int, float) and 0.0 <= cloud[n] < math.inf for n in ("spacing", "radius"))
    if not (valid and lengths and lights and len(zones) == clusters and max(zones) < len(lights)
            and max(lights) * numbers[1] ** 2 == numbers[0]):
        raise StorageError(subject, "the header of its baked data states no valid light cloud", remedy)
