// SPDX-License-Identifier: GPL-3.0-or-later
// One ray per invocation through a tree of boxes (prt_addon/tracing/bounding_hierarchy.py).
//
// ray_origins:       per ray its origin and its reach
// ray_directions:    per ray its direction; the first for all where direction_step is 0
// pair_codes:        with PAIRS, which rays are asked for among all pairs of directions and origins: four to a texel,
//                    direction * origins + origin
// asked_bits:        with MASKED, the same as one bit for each pair from `first` on, packed as answers are
// node_values:       per inner node the boxes and places of its two children
// triangle_values:   per triangle its corners
// Far ends of boxes grow by three roundings (Ize 2013, Robust BVH Ray Traversal), so no box is missed by rounding.
#define BOX_TOLERANCE 1.0000004

vec3 safe_inverse(vec3 d)
{
  vec3 least = vec3(d.x < 0.0 ? -1.0e-18 : 1.0e-18, d.y < 0.0 ? -1.0e-18 : 1.0e-18, d.z < 0.0 ? -1.0e-18 : 1.0e-18);
  return 1.0 / vec3(abs(d.x) < 1.0e-18 ? least.x : d.x, abs(d.y) < 1.0e-18 ? least.y : d.y,
                    abs(d.z) < 1.0e-18 ? least.z : d.z);
}

// Where a ray enters a box, or FARTHEST where it meets none of it before `reach`.
float box_entry(vec3 low, vec3 high, vec3 origin, vec3 inverse, float reach)
{
  vec3 one = (low - origin) * inverse;
  vec3 other = (high - origin) * inverse;
  vec3 first = min(one, other);
  vec3 last = max(one, other);
  float enters = max(max(first.x, first.y), max(first.z, 0.0));
  float leaves = min(last.x, min(last.y, last.z)) * BOX_TOLERANCE;
  return (enters <= leaves && enters <= reach) ? enters : FARTHEST;
}

void meet_leaf(int first, int count, vec3 origin, vec3 direction, inout NearestHit hit)
{
  for (int k = 0; k < count; k++) {
    meet_triangle(3 * (first + k), origin, direction, hit);
  }
}

NearestHit walk(vec3 origin, vec3 direction, float reach)
{
  NearestHit hit = NearestHit(reach, 0.0, 0.0, 0.0);
  vec3 inverse = safe_inverse(direction);
  int waiting[STACK];
  int top = 0;
  int node = 0;
  while (node >= 0) {
    vec4 left_low = texelFetch(node_values, texel(4 * node), 0);
    vec4 left_high = texelFetch(node_values, texel(4 * node + 1), 0);
    vec4 right_low = texelFetch(node_values, texel(4 * node + 2), 0);
    vec4 right_high = texelFetch(node_values, texel(4 * node + 3), 0);
    float left = box_entry(left_low.xyz, left_high.xyz, origin, inverse, hit.distance);
    float right = box_entry(right_low.xyz, right_high.xyz, origin, inverse, hit.distance);
    if (left < FARTHEST && left_high.w > 0.0) {
      meet_leaf(int(left_low.w), int(left_high.w), origin, direction, hit);
      left = FARTHEST;
    }
    if (right < FARTHEST && right_high.w > 0.0) {
      meet_leaf(int(right_low.w), int(right_high.w), origin, direction, hit);
      right = FARTHEST;
    }
#ifdef OCCLUDED
    if (hit.signed_number != 0.0) {
      break;
    }
#endif
    bool right_first = right < left;
    int nearer = int(right_first ? right_low.w : left_low.w);
    int farther = int(right_first ? left_low.w : right_low.w);
    if (max(left, right) < FARTHEST) {
      waiting[top++] = farther;
    }
    if (min(left, right) < FARTHEST) {
      node = nearer;
    }
    else {
      node = -1;
      if (top > 0) {
        node = waiting[--top];
      }
    }
  }
  return hit;
}

void main()
{
  int ray = int(gl_GlobalInvocationID.x);
  NearestHit hit = NearestHit(0.0, 0.0, 0.0, 0.0);
  bool asked = ray < rays;
#ifdef MASKED
  if (asked) {
    uint bits = uint(texelFetch(asked_bits, texel(ray / 64), 0)[(ray % 64) / 16]);
    asked = ((bits >> uint(ray % 16)) & 1u) != 0u;
  }
#endif
  if (asked) {
#if defined(MASKED)
    vec4 origin = texelFetch(ray_origins, texel((first + ray) % origins), 0);
    vec3 direction = texelFetch(ray_directions, texel((first + ray) / origins), 0).xyz;
#elif defined(PAIRS)
    int code = int(texelFetch(pair_codes, texel(ray / 4), 0)[ray % 4]);
    vec4 origin = texelFetch(ray_origins, texel(code % origins), 0);
    vec3 direction = texelFetch(ray_directions, texel(code / origins), 0).xyz;
#else
    vec4 origin = texelFetch(ray_origins, texel(ray), 0);
    vec3 direction = texelFetch(ray_directions, texel(ray * direction_step), 0).xyz;
#endif
    hit = walk(origin.xyz, direction, origin.w);
  }
  write_answer(ray, hit);
}
