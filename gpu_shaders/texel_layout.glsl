// SPDX-License-Identifier: GPL-3.0-or-later
// Value `index` of a list laid out row after row in a 2D texture of TEXTURE_WIDTH texels (render_data.TEXTURE_WIDTH).
// 1D textures end at 16384 texels and cannot be read back; a million points need two dimensions.
ivec2 texel(int index)
{
  return ivec2(index % TEXTURE_WIDTH, index / TEXTURE_WIDTH);
}
