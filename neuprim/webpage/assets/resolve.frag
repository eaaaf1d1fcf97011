// The picture out of (sum of w colour, T): background, depth as colours, the display's curve.
uniform sampler2D image, depths; // depths: (sum of w z, ..., T), of shadows per pixel
uniform highp sampler2DArray maps; // the same out of the light, a layer per slab
uniform vec3 background;
uniform bool linear; // whether values are linear light
uniform int mode;
uniform vec2 range;
uniform float top;
uniform bool shaded;
uniform mat4 toScene; // (pixel x z, pixel y z, z, 1) -> scene
uniform mat4 toLight[6]; // scene -> each of the light's cameras: one, or one along each axis
uniform int cameras;
uniform vec3 source; // where the light is
uniform vec3 light; // focal, near, and how far behind a depth image light fades
out vec4 result;

vec3 ramp(float t) { // dark blue, green, yellow
  t = clamp(t, 0.0, 1.0);
  return mix(mix(vec3(0.17, 0.04, 0.33), vec3(0.13, 0.57, 0.55), min(2.0 * t, 1.0)), vec3(0.99, 0.91, 0.15), max(2.0 * t - 1.0, 0.0));
}

vec3 display(vec3 c) { // sRGB
  if (!linear) return c;
  return mix(12.92 * c, 1.055 * pow(max(c, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(c, vec3(0.0031308))));
}

float arriving(vec3 point) { // as arrivingAt of shadow.js
  int camera = 0;
  if (cameras > 1) { // as facing of shadow.js
    vec3 away = point - source, sizes = abs(away);
    camera = sizes.x >= sizes.y && sizes.x >= sizes.z ? 0 : sizes.y >= sizes.z ? 1 : 2;
    if (away[camera] < 0.0) camera += 3;
  }
  vec3 x = (toLight[camera] * vec4(point, 1.0)).xyz;
  ivec3 size = textureSize(maps, 0);
  size.z /= cameras;
  if (!(x.z > light.y)) return 1.0;
  vec2 uv = light.x * x.xy / x.z + 0.5 * vec2(size.xy) - 0.5;
  if (any(lessThanEqual(uv, vec2(-1.0))) || any(greaterThanEqual(uv, vec2(size.xy)))) return 1.0;
  ivec2 corner = ivec2(floor(uv));
  vec2 part = uv - vec2(corner);
  float found = 1.0;
  for (int slab = 0; slab < size.z; slab++) {
    float alpha = 0.0, nearness = 0.0;
    for (int k = 0; k < 4; k++) {
      ivec2 step = ivec2(k & 1, k >> 1), texel = corner + step;
      if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, size.xy))) continue;
      vec4 seen = texelFetch(maps, ivec3(texel, camera * size.z + slab), 0);
      float opacity = 1.0 - seen.a;
      if (!(opacity > 0.0)) continue;
      vec2 share = mix(1.0 - part, part, vec2(step));
      alpha += share.x * share.y * opacity;
      nearness += share.x * share.y * opacity / max(seen.r / opacity, light.y);
    }
    float behind = x.z - alpha / max(nearness, 1e-12), s = clamp(behind / light.z, 0.0, 1.0);
    found *= 1.0 - alpha * s * s * (3.0 - 2.0 * s);
  }
  return found;
}

void main() {
  ivec2 size = textureSize(image, 0), at = ivec2(gl_FragCoord.xy);
  ivec2 from = ivec2(at.x, FLIPPED == 1 ? size.y - 1 - at.y : at.y); // rows run downwards, as in image files
  vec4 v = texelFetch(image, from, 0);
  vec3 c = v.rgb;
  if (shaded && v.a < 1.0) {
    vec4 d = texelFetch(depths, from, 0);
    float z = d.r / (1.0 - d.a);
    c *= arriving((toScene * vec4((vec2(from) + 0.5) * z, z, 1.0)).xyz);
  }
#if FLIPPED == 0
  result = vec4(c, v.a); // numbers, not a picture
#else
  vec3 behind = display(background);
  if (mode == ALPHA) c = vec3(1.0 - v.a);
  else if (mode == DEPTH) c = v.a < 0.999 ? ramp((range.y - v.r / (1.0 - v.a)) / (range.y - range.x)) : behind;
  else if (mode == SLICE) c = v.r > 0.0 ? ramp(sqrt(v.r / top)) : behind;
  else c = display(c + v.a * background);
  result = vec4(clamp(c, 0.0, 1.0), 1.0);
#endif
}
