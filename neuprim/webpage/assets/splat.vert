// A regular polygon around the unit circle, mapped onto the silhouette; cards snap vertices to 1/16 of a pixel, hence the margin.
layout(location = 0) in vec4 r0;
layout(location = 1) in vec4 r1;
layout(location = 2) in vec4 r2;
layout(location = 3) in vec4 r3;
layout(location = 4) in vec4 r4;
layout(location = 5) in vec4 r5;
layout(location = 6) in vec4 r6;
layout(location = 7) in vec4 r7;
layout(location = 8) in vec4 span;
layout(location = 9) in vec4 height;
layout(location = 10) in vec4 r10;
flat out vec4 f0, f1, f2, f3, f4, f5, f6;
flat out vec3 base;
flat out vec2 place; // m, anchor z
flat out ivec2 at, unitAt, movingAt; // texels
uniform vec2 size;

ivec2 texel(int index, int each) {
  int perRow = MAX_WIDTH / max(each, 1);
  return ivec2((index % perRow) * each, index / perRow);
}

void main() {
  int k = gl_VertexID, corner = (k & 1) == 1 ? (k + 1) / 2 : (CORNERS - k / 2) % CORNERS; // in the order of a strip
  float angle = 6.283185307179586 * (float(corner) + 0.5) / float(CORNERS);
  vec2 c = vec2(cos(angle), sin(angle)) / cos(3.141592653589793 / float(CORNERS));
  float skew = span.x, hx = span.w, hy = height.x;
  float dy = (hy * 1.0001 + 0.1) * c.y, dx = (hx * 1.0001 + 0.1 * sqrt(1.0 + skew * skew)) * c.x + skew * dy;
  vec2 pixel = vec2(r0.w, r1.w) + span.yz + vec2(dx, dy);
  gl_Position = vec4(hx < 0.0 ? 2.0 * c : pixel / size * 2.0 - 1.0, 0.0, 1.0);
  f0 = r0;
  f1 = r1;
  f2 = r2;
  f3 = r3;
  f4 = r4;
  f5 = r5;
  f6 = r6;
  base = r10.xyz;
  place = r7.xy;
  at = texel(int(r7.z), NEURON_TEXELS);
  unitAt = texel(int(r7.z), 2 * HIDDEN);
  movingAt = texel(int(r7.w), MOVING);
}
