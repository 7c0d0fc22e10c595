// SPDX-License-Identifier: GPL-3.0-or-later
// Exit radiance of a place among texels: blended bilinearly from the four around it, *after* each was evaluated from its
// own cluster's constants, so that clusters never show. atlas_points holds the numbers of the four points around each
// square between texels, -1 where there is none: on the rim of a chart rounding may ask for the square beyond.
vec4 shares_around(out ivec4 around)
{
  vec2 low = floor(atlas_place);
  vec2 part = atlas_place - low;
  ivec2 size = textureSize(atlas_points, 0);
  vec4 found = texelFetch(atlas_points, clamp(ivec2(low), ivec2(0), size - 1), 0);
  around = ivec4(max(found, vec4(0.0)) + 0.5);
  vec4 shares = vec4((1.0 - part.x) * (1.0 - part.y), part.x * (1.0 - part.y), (1.0 - part.x) * part.y,
                     part.x * part.y);
  shares *= vec4(greaterThan(found, vec4(-0.5)));
  return shares / max(shares.x + shares.y + shares.z + shares.w, 1e-12);
}

vec3 row_around(ivec4 around, vec4 shares, int row)
{
  vec3 total = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    total += shares[k] * texelFetch(exit_values, texel(around[k] * ROWS + row), 0).rgb;
    if (direct_share > 0.0) {
      total += shares[k] * texelFetch(direct_values, texel(around[k] * ROWS + row), 0).rgb;
    }
  }
  return total;
}

void main()
{
  ivec4 around;
  vec4 shares = shares_around(around);
  vec3 reflectance = mix(vec3(1.0), fragment_albedo(), albedo_share);
  vec3 radiance = reflectance * row_around(around, shares, 0);
#ifdef HAS_ROWS
  vec3 view = vec3(0.0, 0.0, 1.0);
#ifdef SEES_VIEWER
  // The frame of texels, as their receivers had it (scene/tangents.py).
  vec3 up = normalize(frame_normal);
  vec3 across = normalize(frame_tangent - dot(frame_tangent, up) * up);
  view = normalize(vec3(dot(to_viewer, across), dot(to_viewer, cross(up, across)), dot(to_viewer, up)));
  view.z = abs(view.z);
#endif
  fetch_rows(around, shares);
  radiance += sum_rows(view);
#endif
  fragment_colour = vec4(max(radiance, vec3(0.0)) * exposure, 1.0);
}
