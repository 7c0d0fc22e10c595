// SPDX-License-Identifier: GPL-3.0-or-later
// One level of the pyramid: each node is the mean of its four children, weighted by their areas.
//
// level_range: where the children begin in the list of nodes, where this level begins, and its number of nodes
void main()
{
  int index = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (index >= level_range.z) {
    return;
  }
  vec4 sum = vec4(0.0);
  for (int child = 0; child < 4; child++) {
    vec4 value = imageLoad(pyramid_values, texel(level_range.x + 4 * index + child));
    sum += vec4(value.rgb * value.a, value.a);
  }
  imageStore(pyramid_values, texel(level_range.y + index), vec4(sum.a > 0.0 ? sum.rgb / sum.a : vec3(0.0), sum.a));
}
