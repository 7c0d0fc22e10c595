// SPDX-License-Identifier: GPL-3.0-or-later
// One Jacobi iteration of matrix radiosity B = E + rho F B (Carr et al. 2003, section 3), one receiver per invocation,
// all channels at once: B <- B + (E + rho F B - B) / (1 - rho F_pp).
//
// entry_values:      texel k * receivers + p: two entries of row p of F, (column, value, column, value). Neighbouring
//                    invocations read neighbouring texels.
// row_values:        texel p: how many of those texels row p has, and its diagonal F_pp
// albedo_values, emittance_values, radiosity_values: texel p
// next_values:       texel p: the new radiosity; the fourth number is the squared residual of the old one
void main()
{
  int receiver = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (receiver >= receivers) {
    return;
  }
  vec2 row = texelFetch(row_values, texel(receiver), 0).xy;
  int texels = int(row.x);
  vec3 gathered = vec3(0.0);
  for (int k = 0; k < texels; k++) {
    vec4 pair = texelFetch(entry_values, texel(k * receivers + receiver), 0);
    gathered += pair.y * texelFetch(radiosity_values, texel(int(pair.x)), 0).rgb;
    gathered += pair.w * texelFetch(radiosity_values, texel(int(pair.z)), 0).rgb;
  }
  vec3 albedo = texelFetch(albedo_values, texel(receiver), 0).rgb;
  vec3 before = texelFetch(radiosity_values, texel(receiver), 0).rgb;
  vec3 residual = texelFetch(emittance_values, texel(receiver), 0).rgb + albedo * gathered - before;
  vec3 after = before + residual / (vec3(1.0) - albedo * row.y);
  imageStore(next_values, texel(receiver), vec4(after, dot(residual, residual)));
}
