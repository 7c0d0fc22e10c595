// SPDX-License-Identifier: GPL-3.0-or-later
// Pass three: what lamps add to the exit radiance of each receiver, with the light that went through the body in the
// row of the constant function of the view, and only the rest in the diffuse row (Carr et al. 2003, section 4.2.4).
//
// leaving_values: two texels per receiver. Its own of scattered_values (-1: not translucent), the row that what was
//                 scattered is added to, and the share of the diffuse light that goes through the body instead; then
//                 the factors on what was scattered
// bounced_values: per receiver what the scene sends back of the lamps' light, which is drawn already
void main()
{
  int index = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (index >= points * rows) {
    return;
  }
  int receiver = index / rows;
  int row = index % rows;
  vec4 value = texelFetch(direct_values, texel(index), 0);
  vec4 leaving = texelFetch(leaving_values, texel(2 * receiver), 0);
  if (leaving.x >= 0.0) {
    if (row == 0) {
      vec3 bounced = bounced_share * texelFetch(bounced_values, texel(receiver), 0).rgb;
      value.rgb -= leaving.z * (value.rgb + bounced);
    }
    if (row == int(leaving.y + 0.5)) {
      vec3 factor = texelFetch(leaving_values, texel(2 * receiver + 1), 0).rgb;
      value.rgb += factor * texelFetch(scattered_values, texel(int(leaving.x)), 0).rgb;
    }
  }
  imageStore(shaded_values, texel(index), value);
}
