// SPDX-License-Identifier: GPL-3.0-or-later
// The albedo of a fragment: the image's colour at its place, else interpolated from the points.
//
// An image is sampled as Cycles does: 8 bit sRGB images are interpolated (and weighed by their alpha) as they are
// stored and decoded afterwards, which the sampler can't do; nor are its settings, shared with Blender, ours to change.
// Where a pixel covers several of the image's, the mean of these is linear light, as Cycles' samples are: that is the
// sampler's mipmaps. texture_factor.w holds the switches, see image_textures.switches_of.
#ifdef TEXTURED
vec3 to_stored(vec3 linear)
{
  vec3 low = linear * 12.92;
  vec3 high = 1.055 * pow(max(linear, vec3(0.0)), vec3(1.0 / 2.4)) - 0.055;
  return mix(high, low, vec3(lessThan(linear, vec3(0.0031308))));
}

vec3 to_linear(vec3 stored)
{
  vec3 low = stored / 12.92;
  vec3 high = pow((max(stored, vec3(0.0)) + 0.055) / 1.055, vec3(2.4));
  return mix(high, low, vec3(lessThan(stored, vec3(0.04045))));
}

// A column or row of an image of `size` of them beyond its edges; -1 for none.
int wrapped(int index, int size, int extension)
{
  if (extension == 1) {
    return clamp(index, 0, size - 1);
  }
  if (extension == 2) {
    return (index < 0 || index >= size) ? -1 : index;
  }
  int period = extension == 3 ? 2 * size : size;
  int inside = index - period * int(floor(float(index) / float(period)));
  return inside < size ? inside : period - 1 - inside;
}

vec3 stored_colour(ivec2 at, ivec2 size, int switches)
{
  ivec2 inside = ivec2(wrapped(at.x, size.x, switches / 8), wrapped(at.y, size.y, switches / 8));
  if (inside.x < 0 || inside.y < 0) {
    return vec3(0.0);
  }
  vec4 found = texelFetch(albedo_image, inside, 0);
  vec3 colour = switches % 2 == 1 ? to_stored(found.rgb) : found.rgb;
  return (switches / 2) % 2 == 1 ? colour * found.a : colour;
}

vec3 image_colour()
{
  int switches = int(texture_factor.w + 0.5);
  ivec2 size = textureSize(albedo_image, 0);
  vec2 at = texture_place * vec2(size);
  vec2 across = dFdx(at);
  vec2 along = dFdy(at);
  vec3 colour;
  if ((switches / 4) % 2 == 1) {
    vec2 low = floor(at - 0.5);
    vec2 part = at - 0.5 - low;
    ivec2 first = ivec2(low);
    vec3 lower = mix(stored_colour(first, size, switches), stored_colour(first + ivec2(1, 0), size, switches), part.x);
    vec3 upper = mix(stored_colour(first + ivec2(0, 1), size, switches),
                     stored_colour(first + ivec2(1, 1), size, switches), part.x);
    colour = mix(lower, upper, part.y);
  }
  else {
    colour = stored_colour(ivec2(floor(at)), size, switches);
  }
  colour = switches % 2 == 1 ? to_linear(colour) : colour;
  // From one pixel of the image per pixel of the picture to two.
  float covered = sqrt(max(dot(across, across), dot(along, along)));
  float coarse = clamp(covered - 1.0, 0.0, 1.0);
  if (coarse > 0.0) {
    int extension = switches / 8;
    vec2 place = texture_place;
    vec2 turned = abs(place - 2.0 * floor(place * 0.5 + 0.5));
    place = extension == 0 ? fract(place) : (extension == 3 ? turned : clamp(place, vec2(0.0), vec2(1.0)));
    vec4 found = textureGrad(albedo_image, place, across / vec2(size), along / vec2(size));
    bool outside = extension == 2 && place != texture_place;
    vec3 mean = outside ? vec3(0.0) : found.rgb * ((switches / 2) % 2 == 1 ? found.a : 1.0);
    colour = mix(colour, mean, coarse);
  }
  return colour;
}
#endif

vec3 fragment_albedo()
{
#ifdef TEXTURED
  return clamp(image_colour() * texture_factor.rgb, vec3(0.0), vec3(1.0));
#else
  return surface_albedo;
#endif
}
