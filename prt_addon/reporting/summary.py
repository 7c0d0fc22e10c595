# SPDX-License-Identifier: GPL-3.0-or-later
"""A report in a few short lines, for a panel: where the time went, how large each error is, what was left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from .basis_words import basis_line, diffuse_words
from .headline import PARTS
from .svg_plots import percent
from .wording import ERRORS, HIGHLIGHT_ERRORS, LOCAL_ERRORS, LOCAL_HIGHLIGHT_ERRORS, STAGES, duration, memory

WORDS = {"errors": ERRORS, "highlight_errors": HIGHLIGHT_ERRORS, "local_errors": LOCAL_ERRORS,
         "local_highlight_errors": LOCAL_HIGHLIGHT_ERRORS}

MOST_LEFT_OUT = 6  # lines: the page has all
SMALL_SHARE = 0.01  # of the time: stages below it are not told
TITLES = {"diffuse": "diffuse light"}
KINDS = ("fact", "stage", "heading", "error", "left_out")


@dataclass(frozen=True)
class SummaryLine:
    """kind: one of KINDS; text; share: 0..1, of the time of a stage, of the largest error of its part, else 0."""

    kind: str
    text: str
    share: float = 0.0


def summary(report: dict[str, Any]) -> list[SummaryLine]:
    """The lines, in the order in which they are read."""
    seconds = max(report["seconds"] or 0.0, 1e-9)
    lines = [SummaryLine("fact", f"{duration(report['seconds'])}, {(report['rays'] or 0) / 1e6:.3g} million rays, "
                                 f"{memory(report['peak_bytes'])} of memory")]
    if basis_line(report):
        lines.append(SummaryLine("fact", basis_line(report)))
    for stage in report["stages"]:
        share = (stage["seconds"] or 0.0) / seconds  # what was not finite is None
        if share >= SMALL_SHARE:
            name = STAGES.get(stage["name"], (stage["name"], ""))[0]
            lines.append(SummaryLine("stage", f"{name}  {duration(stage['seconds'])}", min(share, 1.0)))
    lines += _errors(report)
    left_out = report["left_out"]
    lines += [SummaryLine("left_out", f"Left out: {item['what']}, because {item['why']}")
              for item in left_out[:MOST_LEFT_OUT]]
    if len(left_out) > MOST_LEFT_OUT:
        lines.append(SummaryLine("left_out", f"and {len(left_out) - MOST_LEFT_OUT} more, in the report"))
    return lines


def _errors(report: dict[str, Any]) -> Iterator[SummaryLine]:
    """Each part's errors, the total first, as shares of the largest."""
    for part, key in PARTS.items():
        entries = report.get(key) or {}
        values = {name: float(entry["relative_rms"]) for name, entry in entries.items()
                  if entry.get("relative_rms") is not None}
        if not values:
            continue
        largest = max(*values.values(), 1e-12)
        local = key == "errors" and (report.get("settings") or {}).get("lighting") == "local"
        yield SummaryLine("heading", f"Error of {'bounced light of lamps' if local else TITLES.get(part, part)}")
        for name in sorted(values, key=lambda n: (n != "total", -values[n])):
            words = (diffuse_words(report) if key == "errors" else WORDS[key]).get(name, (name, ""))[0]
            yield SummaryLine("error", f"{words}  {percent(values[name])}", values[name] / largest)
