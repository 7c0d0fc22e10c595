// SPDX-License-Identifier: GPL-3.0-or-later
// A baked surface: the point's exit radiance for unit albedo is found by the vertex number, and so
// is the direct light of lamps, where some shine. With TEXTURED, a point has a vertex for each of its
// places in the texture, and brings its number along.
void main()
{
#ifdef TEXTURED
  int point = int(receiver + 0.5);
  texture_place = place;
#else
  int point = gl_VertexID;
  surface_albedo = albedo;
#endif
  unit_radiance = texelFetch(exit_values, texel(point), 0).rgb;
  if (direct_share > 0.0) {
    unit_radiance += texelFetch(direct_values, texel(point), 0).rgb;
  }
  gl_Position = transform * vec4(position, 1.0);
}
