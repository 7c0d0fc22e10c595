// SPDX-License-Identifier: GPL-3.0-or-later
// All pairs of a bucket's rays and the triangles of the cells that the bucket may meet (Carr, Hall & Hart 2002): every
// ray of a bucket meets the same triangles, nearest cells first, and keeps its nearest hit, as their z-buffer did.
//
// ray_origins, ray_directions:   bucket after bucket, bucket_rays (a multiple of a group's 64) for each
// triangle_values:               per triangle its corners, in the order of the cells
// bucket_values:                 per bucket its first pair and the number of its pairs
// pair_values:                   per pair the cell's first triangle, its number of triangles, and the ray parameter
//                                before which no ray of the bucket meets the cell
void main()
{
  int ray = int(gl_GlobalInvocationID.x);
  NearestHit hit = NearestHit(0.0, 0.0, 0.0, 0.0);
  if (ray < rays) {
    vec4 origin = texelFetch(ray_origins, texel(ray), 0);
    vec3 direction = texelFetch(ray_directions, texel(ray * direction_step), 0).xyz;
    hit.distance = origin.w;
    vec4 bucket = texelFetch(bucket_values, texel(ray / bucket_rays), 0);
    int first = int(bucket.x);
    int end = first + int(bucket.y);
    for (int pair = first; pair < end; pair++) {
      vec4 cell = texelFetch(pair_values, texel(pair), 0);
#ifdef OCCLUDED
      if (hit.signed_number != 0.0) {
        break;
      }
#endif
      if (cell.z > hit.distance) {
        break;
      }
      int last = int(cell.x) + int(cell.y);
      for (int triangle = int(cell.x); triangle < last; triangle++) {
        meet_triangle(3 * triangle, origin.xyz, direction, hit);
      }
    }
  }
  write_answer(ray, hit);
}
