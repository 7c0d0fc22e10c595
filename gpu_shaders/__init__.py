# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of baked objects on the GPU: the only folder that imports gpu.

Reading order is data order:

    render_data.py   pure numpy: a BakedTransfer as the arrays that go to the GPU, and the signatures that say when
                     they changed. Never imports gpu or bpy.
    hemisphere_glsl.py   pure text: the functions of the view as GLSL.
    compute_program.py  a compute program described once, for Blender and as plain GLSL
    programs.py      GLSL files -> the programs (cached; released by `programs.release`).
    image_textures.py   vertices that carry places in image textures, and the images as Blender holds them
    draw.py          GPU objects of one baked object (`ObjectDrawing`) and of a list of them (`DrawingCache`): built
                     when the data's signature changes, relit when the light's changes, else only drawn.
    overlay.py       marks over the picture: points, lines, triangles, and the legend of false colours
    occluders.py     depth of surfaces that are not ours, where Blender leaves none.
    ray_programs.py, ray_device.py, tracing_worker.py   rays on the GPU, in a child process (docs/ray_engine.md)
    viewport.py      the draw handlers: `enable(get_draw_list)`, `disable()`, `status()`.
    offscreen.py     `draw_camera` for background mode and the bpy wheel, `write_png`.

The GLSL:

    texel_layout.glsl          where value i of a long list lies in a 2D texture (prepended to readers of one)
    exit_radiance.comp.glsl    once per light change: exit radiance of every point and row, into a texture
    depth.vert/frag.glsl       surfaces that only hide others
    surface.vert.glsl          once per frame: fetches a point's exit radiance by gl_VertexID
    albedo.glsl                a fragment's albedo: from the image of its material, else interpolated
    surface.frag.glsl          multiplies the interpolated radiance by it
    view_surface.vert.glsl     the same for view-dependent transfer: all rows of the point, and its local view
    view_surface.frag.glsl     sums the interpolated rows times spherical harmonics of the local view

Method: clustered principal components (Sloan, Hall, Hart, Snyder 2003, "Clustered Principal Components for
Precomputed Radiance Transfer", section 6): the light meets only the clusters' bases, on the CPU
(`relighting.cluster_constants`), then each point sums its cluster's few products with its own weights. The paper draws
clusters in separate passes and blends triangles between clusters; here every vertex evaluates its own cluster before
interpolation, which gives the same picture in one pass and without overdraw. The sum runs once per light change, not
once per frame, so a frame costs as much as a coloured mesh whatever the number of vectors.

Diffuse bakes keep the cheap program. Where the view counts, every row is interpolated and the functions of the local
view are evaluated per fragment. Where the view comes from is found in the transform to clip space itself
(`render_data.viewer_of`), in the space of the bake: perspective, orthographic, and objects moved since, alike.

Colours are scene-linear from end to end; the view transform is Blender's own. False colours are drawn into the buffer
of the overlays, which it does not touch.
"""
