// SPDX-License-Identifier: GPL-3.0-or-later
// One level of the pyramid: each node is the mean of its four children, weighted by their areas. With MOMENTS also the
// mean of (place - centre) (light - mean light) along each axis, from which links take the light at a place within.
//
// level_range: where the children begin in the list of nodes, where this level begins, its number of nodes, and the
//              level of the children: those of level 0 have no moments
// centre_values: per node its centre
void main()
{
  int index = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (index >= level_range.z) {
    return;
  }
  int node = level_range.y + index;
  int first = level_range.x + 4 * index;
  vec4 light[4];
  vec4 sum = vec4(0.0);
  for (int child = 0; child < 4; child++) {
    light[child] = imageLoad(pyramid_values, texel(NODE_TEXELS * (first + child)));
    sum += vec4(light[child].rgb * light[child].a, light[child].a);
  }
  vec3 mean = sum.a > 0.0 ? sum.rgb / sum.a : vec3(0.0);
  imageStore(pyramid_values, texel(NODE_TEXELS * node), vec4(mean, sum.a));
#ifdef MOMENTS
  vec3 centre = texelFetch(centre_values, texel(node), 0).xyz;
  vec3 moment[3] = vec3[3](vec3(0.0), vec3(0.0), vec3(0.0));
  for (int child = 0; child < 4; child++) {
    float share = sum.a > 0.0 ? light[child].a / sum.a : 0.0;
    vec3 apart = texelFetch(centre_values, texel(first + child), 0).xyz - centre;
    for (int axis = 0; axis < 3; axis++) {
      vec3 own = vec3(0.0);
      if (level_range.w > 0) {
        own = imageLoad(pyramid_values, texel(NODE_TEXELS * (first + child) + 1 + axis)).rgb;
      }
      moment[axis] += share * (own + apart[axis] * (light[child].rgb - mean));
    }
  }
  for (int axis = 0; axis < 3; axis++) {
    imageStore(pyramid_values, texel(NODE_TEXELS * node + 1 + axis), vec4(moment[axis], 0.0));
  }
#endif
}
