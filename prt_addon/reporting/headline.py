# SPDX-License-Identifier: GPL-3.0-or-later
"""The one line that says how right a bake is: the same on the console, in files and in the panel."""

from __future__ import annotations

from typing import Any

from .svg_plots import percent

Report = dict[str, Any]
# What is measured -> the key of its entries in a report.
PARTS = {"diffuse": "errors", "highlights": "highlight_errors", "bounced light of lamps": "local_errors",
         "highlights of lamps": "local_highlight_errors"}


def headline(report: Report) -> str:
    """"Total error 0.7 % (diffuse), 3.1 % (highlights); worst: Teapot, 5.2 % (highlights)".

    The worst object is named where several were measured. Diffuse light and highlights each count against their own
    brightness: a faint highlight's large error may not show.
    """
    totals = {part: total_of(report, part) for part in PARTS}
    names = {part: part for part in PARTS}
    if (report.get("settings") or {}).get("lighting") == "local":
        names["diffuse"] = "bounced light of lamps"
    told = [f"{percent(value)} ({names[part]})" for part, value in totals.items() if value is not None]
    if not told:
        return "The error was not measured"
    text = f"Total error {', '.join(told)}"
    found = {(name, part): value for part in PARTS for name, value in object_errors(report, part).items()}
    if len({name for name, _ in found}) > 1:
        name, part = max(found, key=lambda key: found[key])
        text += f"; worst: {name}, {percent(found[name, part])} ({names[part]})"
    return text


def total_of(report: Report, part: str) -> float | None:
    """The relative RMS of all together; None where it was not measured."""
    entry = (report.get(PARTS[part]) or {}).get("total")
    return None if entry is None else entry["relative_rms"]


def object_errors(report: Report, part: str) -> dict[str, float]:
    """The relative RMS of each object for which there are enough points to say."""
    entry = (report.get(PARTS[part]) or {}).get("total") or {}
    return {name: own["relative_rms"] for name, own in (entry.get("objects") or {}).items()
            if own["relative_rms"] is not None}
