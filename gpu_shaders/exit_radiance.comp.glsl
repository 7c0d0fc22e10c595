// SPDX-License-Identifier: GPL-3.0-or-later
// Exit radiance of one (point, row) per invocation: mean + sum of weights times basis vectors, each already multiplied
// by the light (clustered PCA, Sloan et al. 2003, section 6).
//
// encoding_values:   per point ceil((vectors + 1) / 4) texels. The first number is the point's cluster: it stands in
//                    the place of the mean's weight, which is always 1. Then come the weights of vectors 1, 2, ...
// constant_values:   texel (cluster * (vectors + 1) + vector) * rows + row; a mean's fourth number tells how many
//                    vectors its cluster has, where their number is adapted to the cluster
// exit_values:       texel point * rows + row
// (Metal reserves words such as constant, vertex and thread: they are no names here.)
void main()
{
  int index = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (index >= points * rows) {
    return;
  }
  int receiver = index / rows;
  int row = index % rows;
  int first_texel = receiver * ((vectors + 4) / 4);
  vec4 numbers = texelFetch(encoding_values, texel(first_texel), 0);
  int mean = int(numbers.x) * (vectors + 1) * rows + row;
  vec4 first_constant = texelFetch(constant_values, texel(mean), 0);
  vec3 radiance = first_constant.rgb;
  int own_vectors = int(first_constant.a);
  for (int k = 1; k <= own_vectors; k++) {
    int component = k % 4;
    if (component == 0) {
      numbers = texelFetch(encoding_values, texel(first_texel + k / 4), 0);
    }
    radiance += numbers[component] * texelFetch(constant_values, texel(mean + k * rows), 0).rgb;
  }
  imageStore(exit_values, texel(index), vec4(radiance, 1.0));
}
