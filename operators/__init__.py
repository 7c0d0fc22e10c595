# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators and commands. Rule: each gathers its input, calls one function, and maps PRTError to a report.

    properties.py      what the user sets (Scene.prt) and what panels show of this session (WindowManager.prt)
    bake_session.py    one bake from a scene to stored data, around the child process: for the operator and the command
    bake_request.py    what was asked for, until its turn comes; place.py: its scene and view layer
    job_mixin.py       the queue, and the one place that knows modal timers, Esc, status text and progress
    interrupted.py     prt.resume, prt.discard_interrupted: bakes that a crash or a load ended
    bake.py            prt.bake, prt.cancel, prt.cancel_all
    clear.py           prt.clear                   analyze.py  prt.analyze
    preview.py         prt.toggle_preview          relight.py  prt.relight
    light_presets.py   prt.light_preset_add, _apply, _update, _remove, prt.light_solo, prt.light_switch: over
                       light_design.py (storing, recalling, solo) and light_properties.py (Scene.prt_light)
    keyframe_light.py  prt.keyframe_light          follow_frames.py the colour attribute frame by frame
    lit_picture.py     thumbnails; light_icons.py: as text and as icons
    scene_lamps.py     lamps on bakes, step by step; relit.py: a scene's bakes under its light, all at once
    live_preview.py    what the viewport draws, and the handlers that make it follow the scene and its light
    commands.py        the command line: `main(arguments) -> int`; verbs.py: what each verb does
    compare.py         prt.compare, around compare_session.py: the preview beside Cycles, in the same queue as bakes
    tracing_choice.py  who traces a bake; measure_tracing.py: prt.measure_tracing, in the same queue as bakes
    export.py          prt.export      report.py    prt.write_report, prt.show_report
    draw_camera.py     prt.draw_camera arguments.py what commands and operators take alike, as text
"""
