# SPDX-License-Identifier: GPL-3.0-or-later
"""Which lighting basis the columns of baked transfer belong to, as a header states it.

Columns are those of distant light in spherical harmonics, then those of the lights of a local light cloud; either part
may be missing. A cloud's columns mean other lights in every zone (Kristensen et al. 2005, 4.2); zones of fewer lights
leave their last columns zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ..errors import StorageError

SPHERICAL_HARMONICS, LIGHT_CLOUD, JOINED = "spherical_harmonics", "light_cloud", "joined"


@dataclass(frozen=True)
class Columns:
    """order: of the distant light's spherical harmonics, 0 without that part; cloud: columns of the light cloud."""

    order: int
    cloud: int = 0

    @property
    def distant(self) -> int:
        """Columns of distant light: the first ones."""
        return self.order ** 2

    @property
    def total(self) -> int:
        """All columns."""
        return self.distant + self.cloud


def columns_entry(columns: Columns, emission_order: int = 1, spacing: float = 0.0, radius: float = 0.0,
                  lights: tuple[int, ...] = (), zones: tuple[int, ...] = ()) -> dict[str, Any]:
    """`columns` of a header. emission_order, spacing (m), radius (m): of the cloud; lights: in each of its zones;
    zones: of each of the object's clusters."""
    distant = {"kind": SPHERICAL_HARMONICS, "order": columns.order, "condon_shortley": False}
    if not columns.cloud:
        return distant
    cloud = {"kind": LIGHT_CLOUD, "columns": columns.cloud, "emission_order": emission_order, "spacing": spacing,
             "radius": radius, "lights": [int(n) for n in lights], "cluster_zone": [int(z) for z in zones],
             "holds": "indirect light of 1 W/sr"}
    return {"kind": JOINED, "parts": [distant, cloud]} if columns.order else cloud


def parts_of(entry: Any) -> list[dict[str, Any]]:
    """The parts of a header's `columns`."""
    if not isinstance(entry, dict):
        return []
    parts = entry.get("parts") if entry.get("kind") == JOINED else [entry]
    return [part for part in parts if isinstance(part, dict)] if isinstance(parts, list) else []


def cloud_part(entry: Any) -> dict[str, Any] | None:
    """The part of a header's `columns` that is a light cloud's; None without."""
    return next((part for part in parts_of(entry) if part.get("kind") == LIGHT_CLOUD), None)


def read_columns(header: dict[str, Any], subject: str, remedy: str) -> Columns:
    """The columns that a header states. Raises StorageError where they are of no known kind or do not fit the shape."""
    total = header["shape"][3]
    parts = parts_of(header.get("columns", {"kind": SPHERICAL_HARMONICS, "order": math.isqrt(total)}))
    kinds = [part.get("kind") for part in parts]
    if kinds not in ([SPHERICAL_HARMONICS], [LIGHT_CLOUD], [SPHERICAL_HARMONICS, LIGHT_CLOUD]):
        raise StorageError(subject, "the header of its baked data states no known lighting basis", remedy)
    cloud = parts[-1] if kinds[-1] == LIGHT_CLOUD else None
    if cloud is not None:
        _check_cloud(cloud, header["shape"][0], subject, remedy)
    order = math.isqrt(total - (cloud["columns"] if cloud else 0)) if kinds[0] == SPHERICAL_HARMONICS else 0
    found = Columns(order, cloud["columns"] if cloud else 0)
    if found.total != total:
        raise StorageError(subject, "the header of its baked data states no valid shape", remedy)
    return found


def _check_cloud(cloud: dict[str, Any], clusters: int, subject: str, remedy: str) -> None:
    """Raise StorageError where a cloud's numbers contradict each other."""
    numbers = [cloud.get(name) for name in ("columns", "emission_order")]
    lights, zones = cloud.get("lights"), cloud.get("cluster_zone")
    valid = all(type(n) is int and n > 0 for n in numbers) and all(
        isinstance(values, list) and all(type(n) is int and n >= 0 for n in values) for values in (lights, zones))
    lengths = all(type(cloud.get(n)) in (int, float) and 0.0 <= cloud[n] < math.inf for n in ("spacing", "radius"))
    if not (valid and lengths and lights and len(zones) == clusters and max(zones) < len(lights)
            and max(lights) * numbers[1] ** 2 == numbers[0]):
        raise StorageError(subject, "the header of its baked data states no valid light cloud", remedy)
