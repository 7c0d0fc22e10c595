// SPDX-License-Identifier: GPL-3.0-or-later
// A ray against a triangle, without gaps between triangles that share an edge: edge functions of Pluecker coordinates
// around the ray's origin, as Embree's robust mode has them (Davidovic, Engelhardt, Georgiev, Slusallek, Dachsbacher
// 2012, 3D Rasterization). An edge seen from its other side gives exactly the opposite number, contracted to fused
// multiply-adds or not, so no ray passes between two triangles.
#define FARTHEST 1.0e37
#define EDGE_TOLERANCE 1.1920929e-7

struct NearestHit {
  float distance; // ray parameter; the reach at first
  float signed_number; // triangle + 1, negative where the ray met its back; 0 for none
  float u; // weights of the second and the third corner
  float v;
};

// Volume (times 6) between the ray of direction d from the origin and the edge from p to q.
float edge_volume(vec3 p, vec3 q, vec3 d)
{
  return dot(cross(q - p, q + p), d);
}

// Triangle at texel `first` of triangle_values; hit is replaced by a nearer one.
void meet_triangle(int first, vec3 origin, vec3 direction, inout NearestHit hit)
{
  vec4 corner = texelFetch(triangle_values, texel(first), 0);
  vec3 a = corner.xyz - origin;
  vec3 b = texelFetch(triangle_values, texel(first + 1), 0).xyz - origin;
  vec3 c = texelFetch(triangle_values, texel(first + 2), 0).xyz - origin;
  float weight_b = edge_volume(a, c, direction);
  float weight_c = edge_volume(b, a, direction);
  float weight_a = edge_volume(c, b, direction);
  float total = weight_a + weight_b + weight_c;
  float tolerance = EDGE_TOLERANCE * abs(total);
  float least = min(weight_a, min(weight_b, weight_c));
  float most = max(weight_a, max(weight_b, weight_c));
  vec3 normal = cross(b - a, c - a);
  float along = dot(normal, direction);
  float parameter = dot(normal, a) / along;
  if ((least >= -tolerance || most <= tolerance) && along != 0.0 && total != 0.0 && parameter > 0.0 &&
      parameter <= hit.distance) {
    hit.distance = parameter;
    hit.signed_number = along < 0.0 ? corner.w + 1.0 : -(corner.w + 1.0);
    hit.u = weight_b / total;
    hit.v = weight_c / total;
  }
}

vec4 packed_hit(NearestHit hit)
{
  return vec4(hit.distance, hit.signed_number, hit.u, hit.v);
}
