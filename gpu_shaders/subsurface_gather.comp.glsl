// SPDX-License-Identifier: GPL-3.0-or-later
// Pass two: each texel gathers from the nodes that it is linked to (Carr et al. 2003, section 4.2.3, eq. 9).
//
// link_values:      texel k * places + i: the k-th link of texel i (neighbours read neighbours). Its node, and in half
//                   precision the throughput factors of the three channels and where in the node the light comes from
//                   (`subsurface_texels.link_texels`)
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
    int node = NODE_TEXELS * int(link.r);
    vec2 red_green = unpackHalf2x16(floatBitsToUint(link.g));
    vec2 blue_x = unpackHalf2x16(floatBitsToUint(link.b));
    vec3 light = texelFetch(pyramid_values, texel(node), 0).rgb;
#ifdef MOMENTS
    vec3 shift = vec3(blue_x.y, unpackHalf2x16(floatBitsToUint(link.a)));
    if (abs(shift.x) + abs(shift.y) + abs(shift.z) > LEAST_SHIFT) {
      for (int axis = 0; axis < 3; axis++) {
        light += shift[axis] * texelFetch(pyramid_values, texel(node + 1 + axis), 0).rgb;
      }
    }
#endif
    sum += vec3(red_green, blue_x.x) * light;
  }
  imageStore(scattered_values, texel(place), vec4(sum / FACTOR_SCALE, 1.0));
}
