// SPDX-License-Identifier: GPL-3.0-or-later
// A baked surface: the point's exit radiance for unit albedo is found by the vertex number.
void main()
{
  unit_radiance = texelFetch(exit_values, texel(gl_VertexID), 0).rgb;
  surface_albedo = albedo;
  gl_Position = transform * vec4(position, 1.0);
}
