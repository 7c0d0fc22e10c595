// SPDX-License-Identifier: GPL-3.0-or-later
// A baked surface whose radiance depends on the view: the point's rows are found by its number, turned into the frame
// that its triangle shares, and that frame turns the direction to the viewer, left unnormalised so that its
// interpolation stays exact along flat triangles.
// Without SEES_VIEWER the constant function is the only one (subsurface light).
void main()
{
  int first_texel = int(receiver_and_turn.x + 0.5) * ROWS;
  diffuse_radiance = texelFetch(exit_values, texel(first_texel), 0).rgb;
  fetch_rows(first_texel);
  if (direct_share > 0.0) {
    diffuse_radiance += texelFetch(direct_values, texel(first_texel), 0).rgb;
    add_direct_rows(first_texel);
  }
  if (receiver_and_turn.y != 0.0) {
    turn_rows(receiver_and_turn.y);
  }
#ifdef TEXTURED
  texture_place = place;
#else
  surface_albedo = albedo;
#endif
#ifdef SEES_VIEWER
  vec3 to_viewer = viewer.xyz - viewer.w * position;
  local_view = vec3(dot(to_viewer, tangent), dot(to_viewer, cross(normal, tangent)), dot(to_viewer, normal));
#endif
  gl_Position = transform * vec4(position, 1.0);
}
