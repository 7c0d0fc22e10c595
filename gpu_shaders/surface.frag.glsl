// SPDX-License-Identifier: GPL-3.0-or-later
// Radiance and albedo are interpolated apart and multiplied here, so a texture's edge stays sharp under smooth light.
// Truncated lighting can ring below zero, and a view transform of negative values is undefined: clip at black.
void main()
{
  vec3 reflectance = mix(vec3(1.0), fragment_albedo(), albedo_share);
  fragment_colour = vec4(max(unit_radiance, vec3(0.0)) * reflectance * exposure, 1.0);
}
