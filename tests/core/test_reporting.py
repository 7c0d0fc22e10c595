# SPDX-License-Identifier: GPL-3.0-or-later
"""Stage timer, report file and page: what they promise to scripts and to a reader."""

from __future__ import annotations

import copy
import json
import re
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from prt_addon.errors import StorageError
from prt_addon.reporting import svg_plots, wording
from prt_addon.reporting.headline import headline
from prt_addon.reporting.html_report import render
from prt_addon.reporting.report_file import HIGHLIGHT_ERROR_NAMES, problem_of, read_report, write_report
from prt_addon.reporting.stages import StageTimer, reset_peak_bytes
from prt_addon.reporting.summary import summary


def made_up_report() -> dict[str, Any]:
    """A whole report of the kind a bake of two objects writes."""
    entry = {"relative_rms": 0.012, "interval": [0.009, 0.015], "receivers": 64, "reference_rays": 852380}
    return {
        "schema": 1,
        "scene": {"objects": ["Suzanne", "Ground <1> & co"], "receivers": 28307, "triangles": 54068,
                  "warnings": ["Pillar: refined from 384 to 2562 receivers"]},
        "settings": {"order": 5, "directions": 1024, "encoder": "iterative", "fit_order_to_light": False,
                     "compression_error": 0.002},
        "seconds": 41.3, "peak_bytes": 374_000_000, "rays": 24_100_000, "rays_per_second": 583_000.0,
        "stages": [{"name": "direct", "seconds": 30.0, "rays": 24_000_000, "peak_bytes": 374_000_000},
                   {"name": "encode", "seconds": 10.0, "rays": 0, "peak_bytes": 300_000_000},
                   {"name": "polish", "seconds": 1.3, "rays": 100_000, "peak_bytes": 1_000}],
        "left_out": [{"what": "two colour channels", "why": "every albedo is grey", "saved": "2/3 of the bases"}],
        "hints": ["order 3 would do"],
        "errors": {name: copy.deepcopy(entry) for name in ("sampling", "basis", "compression", "total")},
        "error_metric": "relative RMS of exit radiance",
        "clusters": {"count": 90, "vectors_mean": 7.4, "squared_error": 0.22, "overdraw": 1.4, "objects": {
            "Suzanne": {"count": 64, "vectors_mean": 7.9, "squared_error": 0.2, "relative_error": 4e-6, "overdraw": 1.7,
                        "receivers": 7958, "history": [[0.5, "2 vectors", 1.0], [1.0, "8", 0.3], [1.5, "done", 0.2]]},
        }},
        "bounces": {"method": "series", "count": 3, "products": 3, "history": [0.1, 0.02, 0.005]},
        "stability": [{"check": "values that are not finite", "value": 0.0, "limit": 0.0, "verdict": "ok"},
                      {"check": "brightest", "value": 1.3, "limit": 1.02, "verdict": "raise gather_directions"}],
        "resumed": [],
    }


def with_highlights() -> dict[str, Any]:
    """The same with two measured objects, highlights and coherence."""
    report = made_up_report()
    entry = {"relative_rms": 0.031, "interval": [0.02, 0.04], "receivers": 64, "reference_rays": 1_000_000}
    report["highlight_errors"] = {name: copy.deepcopy(entry) for name in HIGHLIGHT_ERROR_NAMES}
    report["errors"]["total"]["objects"] = {
        name: {"relative_rms": value, "interval": [0.0, 0.1], "receivers": 20}
        for name, value in (("Suzanne", 0.008), ("Ground <1> & co", 0.016))}
    report["highlight_errors"]["total"]["objects"] = {
        "Suzanne": {"relative_rms": 0.052, "interval": [0.0, 0.1], "receivers": 20}}
    report["covers"] = ["Light through translucent bodies is not part of it"]
    report["clusters"]["objects"]["Suzanne"]["coherence"] = {
        "before": 1.93, "reclassified": 1.72, "superclustered": 1.61, "both": 1.48, "squared_error_before": 0.2,
        "squared_error_after": 0.21, "moved": 321, "superclusters": 12}
    return report


def test_headline_says_what_it_covers_and_names_the_worst_object() -> None:
    assert headline(made_up_report()) == "Total error 1.2 % (diffuse)"
    assert headline(with_highlights()) == (
        "Total error 1.2 % (diffuse), 3.1 % (highlights); worst: Suzanne, 5.2 % (highlights)")
    metal = with_highlights() | {"errors": {}}
    assert headline(metal) == "Total error 3.1 % (highlights)"
    assert headline(made_up_report() | {"errors": {}}) == "The error was not measured"


def with_lamps(lighting: str) -> dict[str, Any]:
    """A bake with a light cloud; of lamps alone the budget of their light is the only one."""
    report = with_highlights()
    report["settings"]["lighting"] = lighting
    report["local"] = {"lights": 216, "spacing": 0.25, "inside_bodies": 12, "near_surfaces": 34, "emission_order": 2,
                       "zones": 3, "merged": [80, 64, 96], "columns": 384, "merged_response": "arithmetic",
                       "warnings": []}
    names = ("baked", "bounces", "compression", "total", "direct")
    report["local_highlight_errors"] = dict.fromkeys(names, report["highlight_errors"]["total"])
    if lighting == "local":
        report["local_errors"], report["highlight_errors"] = {}, {}
    else:
        report["local_errors"] = copy.deepcopy(report["errors"])
    return report


@pytest.mark.parametrize("lighting", ["local", "environment,local"])
def test_page_and_headline_tell_of_lamps_and_their_cloud(lighting: str) -> None:
    report = with_lamps(lighting)
    text = headline(report)
    both = lighting != "local"
    assert ("(diffuse)" in text) == both and "(bounced light of lamps)" in text and "(highlights of lamps)" in text
    page = render(report)
    for told in ("216, 0.25 m apart", "12 inside of bodies, 34 too near", "64 to 96 in a zone, 80 on average",
                 "384, 4 for each light", "Bounced light of lamps", "Highlights under lamps", "The lamp itself"):
        assert told in page, told
    assert ("<h3>Diffuse light</h3>" in page) == both
    assert ">Lamps</th>" in page and (">Diffuse</th>" in page) == both
    assert "Lights that stand for lamps" not in render(with_highlights())


def test_page_shows_highlights_objects_and_coherence(tmp_path: Path) -> None:
    report = with_highlights()
    write_report(tmp_path / "report.json", report)
    text = render(read_report(tmp_path / "report.json"))
    page = _Page()
    page.feed(text)
    page.close()
    assert page.open == []
    for told in ("3.1 % (highlights)", "worst: Suzanne", "more glossy_rows", "Reflections in reflections",
                 "Object by object", "5.2 %", "1.93", "1.72", "1.61", "1.48", "321", "5.0 %", "translucent bodies"):
        assert told in text, told
    assert "Coherence" not in render(made_up_report())


def test_a_report_whose_highlight_errors_lack_a_part_is_refused() -> None:
    report = with_highlights()
    del report["highlight_errors"]["rows"]
    assert problem_of(report) == "highlight_errors.rows: missing"


class _Page(HTMLParser):
    """Tags that stay open, and all addresses and scripts."""

    VOID = {"meta", "br", "link", "img"}

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()


def test_stage_timer_records_seconds_rays_and_order() -> None:
    rays = [100]
    timer = StageTimer(lambda: rays[0])
    with timer.stage("direct"):
        rays[0] += 7
        time.sleep(0.05)
    with timer.stage("encode"):
        pass
    with timer.stage("direct"):
        rays[0] += 5
    assert [entry["name"] for entry in timer.stages] == ["direct", "encode"]
    assert [entry["rays"] for entry in timer.stages] == [12, 0]
    assert 0.05 <= timer.stages[0]["seconds"] < 5.0


def test_stage_timer_records_a_stage_that_is_cancelled() -> None:
    timer = StageTimer()
    with pytest.raises(KeyboardInterrupt), timer.stage("direct"):
        raise KeyboardInterrupt
    assert [entry["name"] for entry in timer.stages] == ["direct"]


def test_peak_memory_belongs_to_its_stage() -> None:
    timer, size = StageTimer(), 200_000_000
    with timer.stage("before"):
        pass
    with timer.stage("large"):
        block = np.ones(size, np.uint8)
    assert block.all()
    del block
    with timer.stage("after"):
        pass
    before, large, after = (entry["peak_bytes"] for entry in timer.stages)
    assert large - before > 0.8 * size
    if reset_peak_bytes():  # elsewhere the peak is the process's and can only grow
        assert large - after > 0.8 * size


def test_summary_tells_time_errors_and_what_was_left_out() -> None:
    """In this order; shares of stages add up to the bake's time, the largest error of a part fills its bar."""
    report = with_highlights()
    lines = summary(report)
    assert [line.kind for line in lines] == sorted((line.kind for line in lines), key=lambda kind: {
        "fact": 0, "stage": 1, "heading": 2, "error": 2, "left_out": 3}[kind])
    stages = [line for line in lines if line.kind == "stage"]
    told = [stage for stage in report["stages"] if stage["seconds"] >= 0.01 * report["seconds"]]
    assert [line.share for line in stages] == [stage["seconds"] / report["seconds"] for stage in told]
    headings = [n for n, line in enumerate(lines) if line.kind == "heading"]
    for start in headings:
        errors = [line.share for line in lines[start + 1:] if line.kind == "error"][:2]
        assert 0.0 < errors[0] <= 1.0 and lines[start + 1].text.startswith("All together")
    assert sum(line.kind == "error" for line in lines) == len(report["errors"]) + len(report["highlight_errors"])
    for item in report["left_out"]:
        assert any(item["what"] in line.text and item["why"] in line.text for line in lines)
    assert not any("\t" in line.text or "\n" in line.text for line in lines)


def test_summary_of_numbers_that_were_not_finite() -> None:
    report = made_up_report()
    report["seconds"], report["rays"], report["stages"][0]["seconds"] = None, None, None
    report["errors"]["basis"]["relative_rms"] = None
    texts = [line.text for line in summary(report)]
    assert texts[0].startswith("unknown") and not any("None" in text for text in texts)


def test_written_report_reads_back(tmp_path: Path) -> None:
    report = made_up_report()
    write_report(tmp_path / "report.json", report)
    assert read_report(tmp_path / "report.json") == report
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    report = made_up_report()
    report["errors"]["total"].update(relative_rms=float("nan"), interval=[0.0, float("inf")])
    write_report(tmp_path / "report.json", report)
    text = (tmp_path / "report.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert json.loads(text)["errors"]["total"] == {"relative_rms": None, "interval": [0.0, None], "receivers": 64,
                                                   "reference_rays": 852380}
    render(read_report(tmp_path / "report.json"))


@pytest.mark.parametrize("place", [
    "schema", "scene", "scene.receivers", "settings", "seconds", "peak_bytes", "rays", "rays_per_second", "stages",
    "stages.1.rays", "left_out.0.saved", "errors", "errors.basis", "errors.total.interval",
    "errors.total.reference_rays", "clusters.overdraw", "stability.0.verdict",
])
def test_a_report_without_a_promised_key_is_refused(place: str, tmp_path: Path) -> None:
    report = made_up_report()
    *path, last = place.split(".")
    inside: Any = report
    for step in path:
        inside = inside[int(step)] if step.isdigit() else inside[step]
    del inside[last]
    assert problem_of(report) == f"{place}: missing"
    with pytest.raises(ValueError, match=re.escape(place)):
        write_report(tmp_path / "report.json", report)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"schema": 1}', "\x00\x01", "[" * 100000])
def test_files_that_are_no_report_are_refused_in_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(text)
    with pytest.raises(StorageError) as raised:
        read_report(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


def test_a_missing_file_and_a_newer_schema_say_so(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="can't be read"):
        read_report(tmp_path / "absent.json")
    newer = made_up_report() | {"schema": 2}
    (tmp_path / "newer.json").write_text(json.dumps(newer))
    with pytest.raises(StorageError, match="newer version"):
        read_report(tmp_path / "newer.json")


def test_page_is_well_formed_self_contained_and_escaped() -> None:
    text = render(made_up_report())
    page = _Page()
    page.feed(text)
    page.close()
    assert page.open == []
    assert page.addresses == [] and "script" not in page.tags and "http" not in text and "url(" not in text
    assert "Ground &lt;1&gt; &amp; co" in text and "Ground <1>" not in text


def test_page_tells_the_main_things() -> None:
    text = render(made_up_report())
    for told in ("1.2 %", "41 s", "24.1 million", "374 MB", "every albedo is grey", "raise gather_directions",
                 "refined from 384", "order 3 would do", "Needs a look", "1 of 2 need a look", "polish", "0.20 %"):
        assert told in text, told
    calm = made_up_report()
    calm["stability"][1]["verdict"] = "ok"
    assert "Checks: all fine" in render(calm) and "Needs a look" not in render(calm)


def test_page_of_a_bare_report() -> None:
    """Only what the contract promises, and as little of it as possible: no errors, no stage, nothing left out."""
    report = made_up_report()
    for optional in ("hints", "error_metric", "bounces", "resumed"):
        del report[optional]
    del report["scene"]["warnings"], report["clusters"]["objects"]
    report |= {"errors": {}, "stages": [], "left_out": [], "stability": []}
    assert problem_of(report) is None
    assert "Not measured" in render(report)


@pytest.mark.parametrize(("low", "high"), [(1e-6, 3.0), (0.0, 0.0), (0.5, 0.5)])
def test_interval_marks_stay_inside_the_plot(low: float, high: float) -> None:
    plot = svg_plots.intervals([svg_plots.Interval("all", (low + high) / 2, low, high)], wording.ZONES, "title")
    root = ElementTree.fromstring(plot)
    line = next(e for e in root.iter("line") if e.get("class") == "whisker")
    ends = [float(line.get(name, "nan")) for name in ("x1", "x2")]
    assert svg_plots.LABEL <= ends[0] <= ends[1] <= svg_plots.WIDTH - 110


def test_logarithmic_axis_spaces_decades_evenly() -> None:
    """Three points a decade apart lie on a straight line, falling ones fall on the page."""
    plot = svg_plots.curves([svg_plots.Curve("c", [(0.0, 0.1), (1.0, 0.01), (2.0, 0.001)])], "x", "y", "title")
    points = next(e for e in ElementTree.fromstring(plot).iter("polyline")).get("points", "").split()
    (x0, y0), (x1, y1), (x2, y2) = ([float(v) for v in p.split(",")] for p in points)
    assert y1 - y0 == pytest.approx(y2 - y1, abs=0.2) and y2 > y1 > y0
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    assert svg_plots.curves([svg_plots.Curve("c", [(0.0, 0.0), (1.0, 0.0)])], "x", "y", "title") == ""


def test_logarithmic_x_axis_and_close_ticks() -> None:
    """Doublings are evenly spaced on a logarithmic x axis, and two values within a decade stand between close ticks."""
    plot = svg_plots.curves([svg_plots.Curve("c", [(32.0, 30.0), (64.0, 40.0), (128.0, 90.0)])], "x", "y", "title",
                            as_percent=False, log_x=True)
    root = ElementTree.fromstring(plot)
    points = next(e for e in root.iter("polyline")).get("points", "").split()
    (x0, _), (x1, _), (x2, _) = ([float(v) for v in p.split(",")] for p in points)
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2) and x1 - x0 > 50
    assert {"20", "50", "100", "200"} <= {e.text for e in root.iter("text")}
    assert "10" not in {e.text for e in root.iter("text")}


@pytest.mark.parametrize(("value", "text"), [
    (0.0, "0 %"), (0.012, "1.2 %"), (0.00021, "0.021 %"), (1.0, "100 %"), (0.5, "50 %"), (0.0996, "10 %"),
])
def test_percent(value: float, text: str) -> None:
    assert svg_plots.percent(value) == text


def test_numbers_as_words() -> None:
    assert [wording.duration(s) for s in (0.0, 0.243, 12.4, 200.0, 7500.0, None)] == [
        "0 s", "0.24 s", "12 s", "3 min 20 s", "2 h 5 min", "unknown"]
    assert [wording.memory(s) for s in (12, 2_500, 374_000_000, 1.24e9)] == ["12 bytes", "2.5 kB", "374 MB", "1.2 GB"]
    assert [wording.count(n) for n in (0, 999, 28307, 24_100_000, 3.2e9)] == [
        "0", "999", "28\u202f307", "24.1 million", "3.2 billion"]
    assert wording.plural(1, "object", "objects") == "1 object"
