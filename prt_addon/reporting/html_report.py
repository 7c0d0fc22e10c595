# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as one self-contained page that explains itself: no script, no address, plots as inline SVG.

It needs the promised keys of a report (report_file) and shows the optional ones (warnings, hints, objects of clusters,
bounces, what was resumed) where they are there. Everything that came from the scene is escaped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from . import svg_plots, wording
from .basis_words import basis_line, candidate_rows, diffuse_words, uses_one_basis
from .headline import headline, object_errors
from .svg_plots import percent
from .wording import count, duration, memory, number, plural

Report = dict[str, Any]
MOST_CURVES = len(svg_plots.SERIES_CLASSES)


def render(report: Report) -> str:
    """The page of a valid report (see `report_file.problem_of`)."""
    style = Path(__file__).with_name("report.css").read_text("utf-8")
    sections = (_attention, _times, _errors, _sampling, _left_out, _basis, _cloud, _compression, _bounces, _checks,
                _settings, _glossary)
    body = "\n".join(section(report) for section in sections)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Bake report: {escape(_objects_text(report))}</title>\n<style>\n{style}</style></head>\n<body><main>\n"
        f"{_head(report)}\n{body}\n</main></body></html>\n"
    )


def _objects(report: Report) -> list[str]:
    return [str(o if not isinstance(o, dict) else o.get("name", "")) for o in report["scene"]["objects"]]


def _objects_text(report: Report) -> str:
    names = _objects(report)
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _section(title: str, *parts: str, style: str = "") -> str:
    attribute = f' class="{style}"' if style else ""
    return f"<section{attribute}><h2>{escape(title)}</h2>{''.join(parts)}</section>"


def _table(headings: Sequence[tuple[str, bool]], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells that are HTML already. headings: (text, whether the column holds numbers)."""
    kinds = [' class="number"' if is_number else "" for _, is_number in headings]
    head = "".join(f"<th{kind}>{escape(text)}</th>" for kind, (text, _) in zip(kinds, headings, strict=True))
    lines = ("".join(f"<td{kind}>{cell}</td>" for kind, cell in zip(kinds, row, strict=True)) for row in rows)
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _head(report: Report) -> str:
    """One sentence that says how it went, and the main numbers."""
    scene = report["scene"]
    objects = plural(len(scene["objects"]), "object", "objects")
    lead = f"Baked {objects} with {plural(scene['receivers'], 'point', 'points')} in {duration(report['seconds'])}."
    if report["errors"] or report.get("highlight_errors"):
        lead += f" {headline(report)}."
    else:
        lead += " The error was not measured (error_receivers is 0)."
    cards = (
        (duration(report["seconds"]), "for the whole bake"),
        (count(report["rays"]), f"rays, {count(report['rays_per_second'])} per second"),
        (memory(report["peak_bytes"]), "memory at the most"),
        (count(scene["triangles"]), "triangles cast shadows and bounce light"),
    )
    boxes = "".join(f'<div class="card"><b>{escape(value)}</b><span>{escape(text)}</span></div>'
                    for value, text in cards)
    return (f"<h1>Bake report: {escape(_objects_text(report))}</h1>"
            f'<p class="lead">{escape(lead)}</p><div class="cards">{boxes}</div>')


def _failed(report: Report) -> list[dict[str, Any]]:
    return [entry for entry in report["stability"] if entry["verdict"] != "ok"]


def _attention(report: Report) -> str:
    """Warnings, failed checks and hints; nothing where there are none."""
    lines = [f"{entry['check']}: {number(entry['value'])} (limit {number(entry['limit'])}). {entry['verdict']}"
             for entry in _failed(report)]
    lines += [str(warning) for warning in report["scene"].get("warnings", [])]
    hints = [str(hint) for hint in report.get("hints", [])]
    if not lines and not hints:
        return ""
    failed = bool(_failed(report))
    items = "".join(f"<li>{escape(line)}</li>" for line in [*lines, *hints])
    return _section("Needs a look" if failed else "Notes", f"<ul>{items}</ul>", style="attention" if failed else "")


def _times(report: Report) -> str:
    """Stage bars, and what each stage does."""
    rows, words = [], []
    for stage in report["stages"]:
        name, meaning = wording.STAGES.get(stage["name"], (stage["name"], ""))
        note = duration(stage["seconds"])
        if stage["rays"]:
            note += f", {count(stage['rays'])} rays"
        rows.append((name, stage["seconds"] or 0.0, note))
        if meaning:
            words.append(f"<dt>{escape(name)}</dt><dd>{escape(meaning)}; up to {memory(stage['peak_bytes'])}</dd>")
    resumed = report.get("resumed") or []
    note = ""
    if resumed:
        names = ", ".join(wording.STAGES.get(name, (name,))[0].lower() for name in resumed)
        note = f'<p class="why">Taken over from an interrupted bake, without their time: {escape(names)}.</p>'
    plot = svg_plots.bars(rows, "Seconds of each stage")
    return _section("Where the time went", plot, f"<dl>{''.join(words)}</dl>", note)


def _errors(report: Report) -> str:
    """The error budgets: plots with intervals and what to do about each part, objects, and what is not in them."""
    parts = []
    of_lamps = ("Bounced light of lamps", wording.LOCAL_ERRORS)
    diffuse = of_lamps if report["settings"].get("lighting") == "local" else ("Diffuse light", diffuse_words(report))
    for (title, words), key in ((diffuse, "errors"), (("Highlights", wording.HIGHLIGHT_ERRORS), "highlight_errors"),
                                (of_lamps, "local_errors"),
                                (("Highlights under lamps", wording.LOCAL_HIGHLIGHT_ERRORS), "local_highlight_errors")):
        if report.get(key):
            parts += [f"<h3>{title}</h3>", *_budget(report[key], words, title)]
    if not parts:
        return _section("How right is the picture?", "<p>Not measured: the bake was asked for no reference rays.</p>")
    metric = report.get("error_metric")
    metric_line = f'<p class="why below">Each number: {escape(str(metric))}.</p>' if metric else ""
    covers = "".join(f"<li>{escape(str(line))}</li>" for line in report.get("covers") or [])
    return _section("How right is the picture?", *parts, _errors_of_objects(report), metric_line,
                    f'<ul class="why">{covers}</ul>' if covers else "")


def _budget(errors: dict[str, Any], wording_of: dict[str, tuple[str, str, str]], title: str) -> list[str]:
    """One budget: how it was measured, its plot, and what each cause is."""
    rows, words = [], []
    for name, (label, meaning, remedy) in wording_of.items():
        entry = errors.get(name)
        if entry is None or entry["relative_rms"] is None:
            continue
        low, high = (entry["relative_rms"] if end is None else end for end in entry["interval"])
        rows.append(svg_plots.Interval(label, entry["relative_rms"], low, high))
        advice = f" Smaller with {remedy}." if remedy else ""
        words.append(f"<dt>{escape(label)}</dt><dd>{escape(meaning)}.{escape(advice)}</dd>")
    largest = errors["total"]
    measured = (f"Measured at {plural(largest['receivers'], 'random point', 'random points')} with "
                f"{count(largest['reference_rays'])} independent rays. Dot: measured value; line: its 95 % interval.")
    plot = svg_plots.intervals(rows, wording.ZONES, f"{title}: relative error by cause with 95 % intervals") \
        if rows else ""
    return [f'<p class="why">{escape(measured)}</p>', plot, f"<dl>{''.join(words)}</dl>"]


def _errors_of_objects(report: Report) -> str:
    """A table of objects, where several were measured."""
    only_lamps = report["settings"].get("lighting") == "local"
    found = {"Lamps" if only_lamps else "Diffuse": object_errors(report, "diffuse"),
             "Highlights": object_errors(report, "highlights")}
    if report.get("local_errors"):
        found["Lamps"] = object_errors(report, "bounced light of lamps")
    if report.get("local_highlight_errors"):
        found["Highlights under lamps"] = object_errors(report, "highlights of lamps")
    names = list(dict.fromkeys(name for errors in found.values() for name in errors))
    if len(names) < 2:
        return ""
    names.sort(key=lambda name: -max(errors.get(name, 0.0) for errors in found.values()))
    rows = [[escape(name), *(percent(errors[name]) if name in errors else "" for errors in found.values())]
            for name in names]
    return "<h3>Object by object</h3>" + _table((("Object", False), *((part, True) for part in found)), rows)


def _sampling(report: Report) -> str:
    """Which part of a cubemap's direct light was traced; nothing where all of it was."""
    facts = report.get("sampling")
    if not facts:
        return ""
    text = (f"Shadows of {percent(facts['traced'])} of all pairs of a point and a texel were traced, and those of the "
            f"others woven from points near by; {percent(facts['dense'])} of the points were looked at closely. At "
            f"{plural(facts['checked'], 'random point', 'random points')} all of them were traced: single ones are off "
            f"by {percent(facts['element_error'])}, the light by {percent(facts['light_error'])}.")
    return _section("Sparse sampling", f"<p>{escape(text)}</p>")


def _left_out(report: Report) -> str:
    rows = [[escape(str(entry[key])) for key in ("what", "why", "saved")] for entry in report["left_out"]]
    if not rows:
        return _section("What was left out", "<p>Nothing: this scene needs every step of the bake.</p>")
    intro = '<p class="why">Work this scene does not need. Leaving it out makes no visible difference.</p>'
    return _section("What was left out", intro, _table((("What", False), ("Why", False), ("Saved", False)), rows))


def _basis(report: Report) -> str:
    """What the sky is held in, and what else an automatic choice weighed."""
    line, rows = basis_line(report), candidate_rows(report, percent)
    if not line:
        return ""
    heads = (("Sky by", False), ("Predicted error", True), ("Data", True), ("Time", True))
    table = _table(heads, [[escape(cell) for cell in row] for row in rows]) if rows else ""
    probe = (report.get("choice") or {}).get("probe")
    told = f'<p class="why">Measured with {count(probe["rays"])} rays from ' \
           f'{plural(probe["receivers"], "random point", "random points")} under the light of the bake: what of the ' \
           "shadows each would lose, and what compressing it should add.</p>" if probe else ""
    return _section("What the sky is held in", f"<p>{escape(line)}.</p>", told, table)


def _cloud(report: Report) -> str:
    """The light cloud that stands for lamps, where the bake has one."""
    local = report.get("local")
    if not local:
        return ""
    if local.get("basis") == "surfaces":
        return _lit_surfaces(local)
    merged, zones = local["merged"], local["zones"]
    each = local["columns"] / max(1, max(merged))
    intro = ('<p class="why">Lamps that move are put together from the lights of a cloud around them. The points of '
             "the scene are split into zones; within a zone, lights that do much the same are merged.</p>")
    rows = [("Lights of the cloud", f"{count(local['lights'])}, {number(float(local['spacing']))} m apart"),
            ("Places left out", f"{count(local['inside_bodies'])} inside of bodies, "
             f"{count(local['near_surfaces'])} too near to surfaces"),
            ("Zones", count(zones)),
            ("Lights left after merging", count(merged[0]) if len(set(merged)) == 1 else
             f"{count(min(merged))} to {count(max(merged))} in a zone, {count(sum(merged) / len(merged))} on average"),
            ("Columns of a point's matrix", f"{count(local['columns'])}, {number(each)} for each light")]
    table = _table((("Light cloud", False), ("", False)), [[escape(name), escape(text)] for name, text in rows])
    return _section("Lights that stand for lamps", intro, table)


def _lit_surfaces(local: dict[str, Any]) -> str:
    """The surfaces that lamps shine on."""
    intro = ('<p class="why">The light that lamps give to patches of surface is found by shadow rays when relighting,'
             " whatever the lamp and wherever it is; what the patches send on is baked. Zones and merging, which a "
             "cloud of lights needs, are left out: a column means the same at every point.</p>")
    rows = [("Patches of surface", f"{count(local['patches'])}, by {count(local['triangles'])} triangles"),
            ("Columns of a point's matrix", count(local["columns"])),
            ("Learnt from", f"{count(local['lamps'])} lamps in the open, near to surfaces and outside"),
            ("Of their light left out", f"{100.0 * float(local['left']):.2g} %")]
    table = _table((("Lit surfaces", False), ("", False)), [[escape(name), escape(text)] for name, text in rows])
    return _section("Surfaces that lamps shine on", intro, table)


def _compression(report: Report) -> str:
    """Clusters in numbers, and each object's error while its encoder ran."""
    clusters = report["clusters"]
    objects: dict[str, dict[str, Any]] = clusters.get("objects") or {}
    grouped = "All points of an object share one set of vectors; each point then needs only a few numbers" \
        if uses_one_basis(report) else \
        "The points of an object are grouped into clusters; each point then needs only a few numbers"
    intro = (f'<p class="why">{grouped}. '
             f"{plural(clusters['count'], 'cluster', 'clusters')} with {number(clusters['vectors_mean'])} vectors "
             f"on average, total squared error {number(clusters['squared_error'])}, "
             f"overdraw {number(clusters['overdraw'])}.</p>")
    rows = [[escape(name), count(o.get("receivers")), count(o.get("count")), number(o.get("vectors_mean")),
             "unknown" if o.get("relative_error") is None else percent(_relative_rms(o)), number(o.get("overdraw"))]
            for name, o in objects.items()]
    numbers = [(name, True) for name in ("Points", "Clusters", "Vectors", "Error", "Overdraw")]
    table = _table([("Object", False), *numbers], rows) if rows else ""
    # The largest objects tell the most; more lines than colours could not be told apart.
    largest = sorted(objects, key=lambda name: -int(objects[name].get("receivers") or 0))[:MOST_CURVES]
    plot = svg_plots.curves([svg_plots.Curve(_short(name), _history(objects[name])) for name in largest],
                            "seconds of compressing the object", "relative error of the compressed data",
                            "Error of the compression over time")
    heading = "<h3>Error while compressing</h3>" if plot else ""
    return _section("Compression", intro, table, _coherence(objects), heading, plot)


def _coherence(objects: dict[str, dict[str, Any]]) -> str:
    """What reclassification and superclusters brought, where the bake was asked for coherence."""
    told = {name: o["coherence"] for name, o in objects.items() if o.get("coherence")}
    if not told:
        return ""
    intro = ('<p class="why">Points at the borders of clusters were moved to a neighbouring one so that fewer '
             "triangles lie in more than one. The preview draws all clusters in one pass and gains nothing; export and "
             "renderers that draw cluster by cluster do. Overdraw:</p>")
    rows = [[escape(name), *(number(c[key]) for key in ("before", "reclassified", "superclustered", "both")),
             count(c["moved"]), percent(_spent(c))] for name, c in told.items()]
    heads = [("Object", False), *((text, True) for text in ("Before", "Points moved", "Superclusters", "Both",
                                                            "Moved", "Error spent"))]
    return f"<h3>Coherence</h3>{intro}{_table(heads, rows)}"


def _spent(coherence: dict[str, Any]) -> float:
    """Share of the squared error that was added; none where there was no error to begin with."""
    before = coherence["squared_error_before"]
    return max(coherence["squared_error_after"] / before - 1.0, 0.0) if before else 0.0


def _short(name: str) -> str:
    return name if len(name) <= 20 else f"{name[:19]}\u2026"


def _relative_rms(encoded: dict[str, Any]) -> float:
    """The encoder's relative error is of squares (compression.encoding); a person reads its root."""
    return math.sqrt(max(encoded.get("relative_error") or 0.0, 0.0))


def _history(encoded: dict[str, Any]) -> list[tuple[float, float]]:
    """(seconds, relative error): the recorded squared errors, scaled so that the last is the final relative error."""
    entries = [entry for entry in encoded.get("history") or [] if None not in entry]
    final = entries[-1][2] if entries else 0.0
    relative = _relative_rms(encoded)
    if final <= 0.0 or relative <= 0.0:
        return []
    return [(float(at), relative * math.sqrt(max(squared, 0.0) / final)) for at, _, squared in entries]


def _bounces(report: Report) -> str:
    """How the bounced light died away, where the report tells."""
    bounces = report.get("bounces")
    if not bounces:
        return ""
    left = [entry for entry in bounces.get("history") or [] if entry is not None]
    curve = svg_plots.Curve("light left", list(enumerate(left, 1)))
    plot = svg_plots.curves([curve], "step", "share of the light left", "Light left after each bounce")
    if not plot:
        return ""
    intro = ('<p class="why">Each step passes the light on from surface to surface once. The bake stops when too '
             "little is left to matter.</p>")
    return _section("Bounced light", intro, plot)


def _checks(report: Report) -> str:
    """The stability table."""
    if not report["stability"]:
        return ""
    rows = []
    for entry in report["stability"]:
        style = "good" if entry["verdict"] == "ok" else "warn"
        rows.append([escape(entry["check"]), number(entry["value"]), number(entry["limit"]),
                     f'<span class="{style}">{escape(entry["verdict"])}</span>'])
    failed = len(_failed(report))
    title = "Checks: all fine" if not failed else f"Checks: {failed} of {len(rows)} need a look"
    intro = '<p class="why">Things that hold for every physically possible result, whatever the scene.</p>'
    heads = (("Check", False), ("Value", True), ("Limit", True), ("Verdict", False))
    return _section(title, intro, _table(heads, rows))


def _settings(report: Report) -> str:
    rows = [[escape(name.replace("_", " ")), escape(number(value))] for name, value in report["settings"].items()]
    table = _table((("Setting", False), ("Value", True)), rows)
    return f"<section><details><summary>Settings of this bake</summary>{table}</details></section>"


def _glossary(_report: Report) -> str:
    words = "".join(f"<dt>{escape(name)}</dt><dd>{escape(meaning)}</dd>" for name, meaning in wording.GLOSSARY)
    return f"<section><details><summary>What do the words mean?</summary><dl>{words}</dl></details></section>"
