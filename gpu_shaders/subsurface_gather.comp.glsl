// SPDX-License-Identifier: GPL-3.0-or-later
// Pass two: each texel gathers from the nodes that it is linked to (Carr et al. 2003, section 4.2.3, eq. 9).
//
// link_values:      texel k * places + i: the number of the k-th node of texel i, and the throughput factors of the
//                   three channels; neighbours read neighbours
// scattered_values: radiosity of texel i
void main()
{
  int place = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (place >= places) {
    return;
  }
  vec3 sum = vec3(0.0);
  for (int k = 0; k < links; k++) {
    vec4 link = texelFetch(link_values, texel(k * places + place), 0);
    sum += link.gba * texelFetch(pyramid_values, texel(int(link.r)), 0).rgb;
  }
  imageStore(scattered_values, texel(place), vec4(sum, 1.0));
}
