// SPDX-License-Identifier: GPL-3.0-or-later
// Exit radiance towards the viewer: albedo times the diffuse row, plus the other rows times their functions of the view.
// A view from below the horizon is mirrored to the front, as in relighting.hemisphere_values. Truncated lighting can
// ring below zero, and a view transform of negative values is undefined: clip at black.
void main()
{
#ifdef SEES_VIEWER
  vec3 view = normalize(local_view);
  view.z = abs(view.z);
#else
  vec3 view = vec3(0.0, 0.0, 1.0);
#endif
  vec3 reflectance = mix(vec3(1.0), fragment_albedo(), albedo_share);
  vec3 radiance = reflectance * diffuse_radiance + sum_rows(view);
  fragment_colour = vec4(max(radiance, vec3(0.0)) * exposure, 1.0);
}
