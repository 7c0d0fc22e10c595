// SPDX-License-Identifier: GPL-3.0-or-later
// A baked surface: the point's exit radiance for unit albedo is found by the vertex number, and so
// is the direct light of lamps, where some shine.
void main()
{
  unit_radiance = texelFetch(exit_values, texel(gl_VertexID), 0).rgb;
  if (direct_share > 0.0) {
    unit_radiance += texelFetch(direct_values, texel(gl_VertexID), 0).rgb;
  }
  surface_albedo = albedo;
  gl_Position = transform * vec4(position, 1.0);
}
