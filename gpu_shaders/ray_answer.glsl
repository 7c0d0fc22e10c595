// SPDX-License-Identifier: GPL-3.0-or-later
// A group's 64 answers, as little to read back as possible (Carr, Hall & Hart 2002, section 6.1). Nearest hits: a texel
// each. Whether occluded: one bit each, 16 to a number (whole numbers up to 2^24 are exact), one texel for the group.
#ifdef OCCLUDED
shared uint occluded_bits[4];
#endif

void write_answer(int ray, NearestHit hit)
{
#ifdef OCCLUDED
  uint place = gl_LocalInvocationID.x;
  if (place < 4u) {
    occluded_bits[place] = 0u;
  }
  barrier();
  if (hit.signed_number != 0.0) {
    atomicOr(occluded_bits[place >> 4], 1u << (place & 15u));
  }
  barrier();
  if (place == 0u) {
    imageStore(answers, texel(ray / 64), vec4(float(occluded_bits[0]), float(occluded_bits[1]),
                                              float(occluded_bits[2]), float(occluded_bits[3])));
  }
#else
  imageStore(answers, texel(ray), packed_hit(hit));
#endif
}
