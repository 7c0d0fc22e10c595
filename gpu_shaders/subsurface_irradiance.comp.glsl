// SPDX-License-Identifier: GPL-3.0-or-later
// Pass one: the light that enters each texel of a translucent surface (Carr et al. 2003, section 4.2.2).
//
// place_values:    per texel of level 0 the number of its receiver (-1: no surface), the share of the light that enters
//                  (Fresnel's and the layers' transmission), and its area
// direct_values:   texel receiver * rows, light of lamps; bounced_values: texel receiver, what the scene sends back
// pyramid_values:  irradiance, and the area in the fourth number, of which the levels above are made
void main()
{
  int place = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (place >= places) {
    return;
  }
  vec4 own = texelFetch(place_values, texel(place), 0);
  vec4 value = vec4(0.0, 0.0, 0.0, own.z);
  if (own.x >= 0.0) {
    int receiver = int(own.x);
    value.rgb = texelFetch(direct_values, texel(receiver * rows), 0).rgb;
    value.rgb += bounced_share * texelFetch(bounced_values, texel(receiver), 0).rgb;
    value.rgb *= own.y;
  }
  imageStore(pyramid_values, texel(NODE_TEXELS * place), value);
}
