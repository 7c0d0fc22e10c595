// SPDX-License-Identifier: GPL-3.0-or-later
// Pass one by the texels' own geometry (the fragment variant of Carr et al. 2003, section 4.2.2): the irradiance of a
// point lamp without shadows, times Fresnel's transmission of the boundary.
//
// geometry_values: texels 2 i and 2 i + 1: position and area, normal and index of refraction, of texel i of level 0
void main()
{
  int place = int(gl_GlobalInvocationID.y) * TEXTURE_WIDTH + int(gl_GlobalInvocationID.x);
  if (place >= places) {
    return;
  }
  vec4 position = texelFetch(geometry_values, texel(2 * place), 0);
  vec4 normal = texelFetch(geometry_values, texel(2 * place + 1), 0);
  vec3 towards = lamp.xyz - position.xyz;
  float squared = max(dot(towards, towards), 1e-12);
  float cosine = max(dot(normal.xyz, towards) * inversesqrt(squared), 0.0);
  // Snell's law, and Fresnel's equations for light that is not polarised.
  float inside = sqrt(max(1.0 - (1.0 - cosine * cosine) / (normal.w * normal.w), 0.0));
  float upright = (cosine - normal.w * inside) / max(cosine + normal.w * inside, 1e-6);
  float along = (normal.w * cosine - inside) / max(normal.w * cosine + inside, 1e-6);
  float transmitted = 1.0 - 0.5 * (upright * upright + along * along);
  float irradiance = cosine > 0.0 ? lamp.w * cosine / squared * transmitted : 0.0;
  imageStore(pyramid_values, texel(NODE_TEXELS * place), vec4(vec3(irradiance), position.w));
}
