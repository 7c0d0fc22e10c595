// SPDX-License-Identifier: GPL-3.0-or-later
// A surface whose exit radiance lies in texels: its vertices only say where in the atlas they are.
void main()
{
  atlas_place = place_in_atlas;
#ifdef TEXTURED
  texture_place = place;
#else
  surface_albedo = albedo;
#endif
#ifdef SEES_VIEWER
  to_viewer = viewer.xyz - viewer.w * position;
  frame_normal = normal;
  frame_tangent = tangent;
#endif
  gl_Position = transform * vec4(position, 1.0);
}
