// One chord: the closed form of its optical depth, and what it adds to the pixel. Names and formulas are those of neuprim/core/render/cpu.
flat in vec4 f0, f1, f2, f3, f4, f5, f6;
flat in vec3 base;
flat in vec2 place;
flat in ivec2 at, unitAt, movingAt;
uniform sampler2D neurons, units, moving;
uniform vec4 lens; // 1/fx, 1/fy, cx, cy
uniform vec2 limits; // alpha_min, alpha_max
uniform int mode;
uniform float plane; // depth of the slice
out vec4 result;
const float TAU = 6.283185307179586;

float cosTurns(float z) { return COS_POLY; } // cos(2 pi r), z = r^2, |r| <= 1/2
float sincTurns(float z) { return SINC_POLY; } // sin(2 pi r)/(2 pi r)
float edgeTurns(float z) { return EDGE_POLY; } // B_p(2 pi r)

float wave(float u) { // cos(2 pi u): a card's own may be wrong by 5e-4
  float r = u - round(u);
  return cosTurns(r * r);
}

float profile(float v) { // B_p: the chord's integral of one cosine over that of 1; v in turns over half a chord
  float k = round(v), r = v - k, s = sincTurns(r * r);
#if EDGE == 0
  return k == 0.0 ? s : s * r / v;
#else
  float z = TAU * v, c = cosTurns(r * r);
  s *= r / v;
  #if EDGE == 1
  return k == 0.0 ? edgeTurns(v * v) : 3.0 * (s - c) / (z * z);
  #else
  return k == 0.0 ? edgeTurns(v * v) : 15.0 * ((3.0 - z * z) * s - 3.0 * c) / (z * z * z * z);
  #endif
#endif
}

float field(vec3 q) { // offset and cosines at a point, whitened
  float total = f5.w;
  vec4 w, b;
  EACH_NEURON(total += w.w * wave(dot(w.xyz, q) + PHASE);)
  return total;
}

vec3 tint(vec3 q) { // f6.rgb, or a colour network at the middle of the chord
#if HIDDEN == 0
  return f6.rgb;
#else
  vec3 total = base;
  vec4 w, b, o;
  EACH_UNIT(total += o.rgb * wave(dot(w.xyz, q) + PHASE);)
  return max(total, 0.0) * f6.rgb;
#endif
}

void main() {
  vec2 d = gl_FragCoord.xy - vec2(f0.w, f1.w); // exact: the anchor was rounded before it was used
  float slide = d.x * f2.w + d.y * f3.w;
  vec3 g = d.x * f1.xyz + d.y * f2.xyz, e = f0.xyz + g, x = f3.xyz + d.x * f4.xyz + d.y * f5.xyz + slide * g;
  float ia = 1.0 / dot(e, e), tm = -dot(x, e) * ia;
  vec3 p = x + tm * e;
  float D = 1.0 - dot(p, p);
  if (!(D > 0.0)) discard;
  float h = sqrt(D * ia), cut = f4.w - slide;
  if (mode == SLICE) {
    float t = (plane - place.y) / place.x - slide;
    vec3 y = p + (t - tm) * e;
    float inside = 1.0 - dot(y, y);
    if (!(inside > 0.0) || t < cut) discard;
    result = vec4(f6.w * pow(inside, float(EDGE)) * field(y) / place.x);
    return;
  }
  float t0 = max(tm - h, cut), t1 = tm + h, hc = 0.5 * (t1 - t0), middle = 0.5 * (t0 + t1);
  if (!(hc > 0.0)) discard;
  vec3 q = p + (middle - tm) * e;
  if (mode == ELLIPSOIDS) { // the first one by the order of centres, lit from the camera
    vec3 normal = p + (t0 - tm) * e;
    result = vec4(tint(q) * (0.35 + 0.65 * abs(dot(normalize(normal), normalize(e)))), 1.0);
    return;
  }
  vec2 s = (gl_FragCoord.xy - lens.zw) * lens.xy;
  float total;
#if EDGE > 0
  if (cut > tm - h) { // cut by the near plane, which is rare: 16 points of Gauss and Legendre
    float nodes[8] = float[8](NODES), weights[8] = float[8](WEIGHTS);
    total = 0.0;
    for (int j = 0; j < 16; j++) {
      float t = middle + ((j & 1) == 0 ? 1.0 : -1.0) * nodes[j >> 1] * hc;
      vec3 y = p + (t - tm) * e;
      total += weights[j >> 1] * pow(max(1.0 - dot(y, y), 0.0), float(EDGE)) * field(y);
    }
  } else
#endif
  {
    vec3 v = e * hc;
    vec4 w, b;
    total = f5.w;
    EACH_NEURON(total += w.w * wave(dot(w.xyz, q) + PHASE) * profile(dot(w.xyz, v));)
#if EDGE == 0
    total *= 2.0;
#elif EDGE == 1
    total *= 4.0 / 3.0 * D;
#else
    total *= 16.0 / 15.0 * D * D;
#endif
  }
  float depth = total * hc * sqrt(1.0 + dot(s, s)) * f6.w;
  if (!(depth > 0.0)) discard;
  float alpha = min(depth < 0.01 ? depth * (1.0 - depth * (0.5 - depth * (1.0 / 6.0 - depth / 24.0))) : 1.0 - exp(-depth), limits.y);
  if (alpha < limits.x) discard;
  vec3 colour = mode == DEPTH ? vec3(place.y + place.x * (middle + slide)) : tint(q);
  result = vec4(colour * alpha, alpha);
}
