// What turns numbers into colours, on the graphics card. Light is exposed before a curve bends it.

export const VERTEX = `#version 300 es
void main() {  // one triangle that covers everything
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0., 1.);
}`;

/** Tone curves by number, as the shader knows them. */
export const CURVES = ['sRGB, clipped', 'PBR Neutral', 'ACES (fit)', 'False colour, stops'];

export const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;

struct Side {
  vec4 box;      // x, y, width, height within the frame
  ivec2 size;    // in texels: less than the box where it is a smaller picture of it
  int channels;
  int kind;      // light, factor, direction, range
  vec2 range;
  bool srgb;     // 8 bits for eyes, already curved
  ivec4 order;
};
uniform sampler2DArray pixelsA, pixelsB;
uniform Side a, b;
uniform vec2 origin;     // of the frame, in canvas pixels from the upper left corner
uniform float zoom;      // canvas pixels per pixel
uniform float height;    // of the canvas
uniform float exposure;  // a factor
uniform int curve;
uniform int mode;        // 0 a, 1 b, 2 wipe, 3 difference
uniform float wipe;      // where, in canvas pixels
uniform vec3 surround;
out vec4 colour;

const int MOST = 8;  // samples a side, when many pixels fall on one

bool finite(vec4 v) { return !any(isnan(v)) && !any(isinf(v)); }

// A texel's values; w is 1, or 0 outside of the picture.
vec4 texel(sampler2DArray pixels, Side side, ivec2 p) {
  if (any(lessThan(p, ivec2(0))) || any(greaterThanEqual(p, side.size))) return vec4(0.);
  vec4 v = vec4(texelFetch(pixels, ivec3(p, side.order.x), 0).rrr, 1.);
  if (side.srgb) v.rgb = texelFetch(pixels, ivec3(p, 0), 0).rgb;
  else if (side.channels > 1) {
    v.g = texelFetch(pixels, ivec3(p, side.order.y), 0).r;
    v.b = side.channels > 2 ? texelFetch(pixels, ivec3(p, side.order.z), 0).r : 0.;
  }
  return v;
}

// Values of where the eye looks. Far away the mean of what falls on this spot, by up to MOST x MOST
// samples; near by the pixel itself; in between a blend of neighbours. w is how much of it is
// there, and negative where a number isn't finite.
vec4 look(sampler2DArray pixels, Side side, vec2 frame) {
  vec2 texels = vec2(side.size) / side.box.zw;
  vec2 at = (frame - side.box.xy) * texels;
  float near = zoom / texels.x;
  if (near >= 4. || near == 1.) {
    vec4 v = texel(pixels, side, ivec2(floor(at)));
    return finite(v) ? v : vec4(0., 0., 0., -1.);
  }
  vec4 sum = vec4(0.);
  bool odd = false;
  if (near > 1.) {
    vec2 corner = floor(at - .5), part = at - .5 - corner;
    for (int k = 0; k < 4; k++) {
      ivec2 step = ivec2(k & 1, k >> 1);
      vec2 w = mix(1. - part, part, vec2(step));
      vec4 v = texel(pixels, side, ivec2(corner) + step);
      if (finite(v)) sum += v * w.x * w.y; else odd = true;
    }
  } else {
    int n = min(MOST, int(ceil(1. / near)));
    for (int k = 0; k < n * n; k++) {
      vec2 spot = (vec2(k % n, k / n) + .5) / float(n) - .5;
      vec4 v = texel(pixels, side, ivec2(floor(at + spot / near)));
      if (finite(v)) sum += v / float(n * n); else odd = true;
    }
  }
  if (sum.w <= 0.) return vec4(0., 0., 0., odd ? -1. : 0.);
  return vec4(sum.rgb / sum.w, sum.w);
}

vec3 encode(vec3 c) {  // IEC 61966-2-1
  c = clamp(c, 0., 1.);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1. / 2.4)) - .055, step(.0031308, c));
}

vec3 decode(vec3 c) {
  return mix(c / 12.92, pow((c + .055) / 1.055, vec3(2.4)), step(.04045, c));
}

// Khronos PBR Neutral tone mapper, as its specification defines it (2024).
vec3 neutral(vec3 c) {
  const float start = .8 - .04, saturation = .15;
  float low = min(c.r, min(c.g, c.b));
  c -= low < .08 ? low - 6.25 * low * low : .04;
  float peak = max(c.r, max(c.g, c.b));
  if (peak < start) return c;
  float d = 1. - start, squeezed = 1. - d * d / (peak + d - start);
  return mix(c * squeezed / peak, vec3(squeezed), 1. - 1. / (saturation * (peak - squeezed) + 1.));
}

// The fit of ACES by Narkowicz, 2015.
vec3 aces(vec3 c) { return c * (2.51 * c + .03) / (c * (2.43 * c + .59) + .14); }

// Stops from middle grey (.18), -6 to 6: violet, blue, cyan, grey, yellow, red, white.
vec3 stops(vec3 c) {
  const vec3 ramp[7] = vec3[7](vec3(.16, .05, .3), vec3(.1, .25, .75), vec3(.1, .7, .75),
    vec3(.5), vec3(.95, .85, .2), vec3(.9, .25, .1), vec3(1.));
  float y = dot(max(c, 0.), vec3(.2126, .7152, .0722));
  if (y <= 0.) return vec3(0.);
  float at = clamp(log2(y / .18) / 2. + 3., 0., 6.);
  int k = min(5, int(at));
  return mix(ramp[k], ramp[k + 1], at - float(k));
}

vec3 shown(vec3 v, Side side) {
  if (side.kind == 2) return v == vec3(0.) ? vec3(0.) : v * .5 + .5;
  if (side.kind == 3) {
    v = (v - side.range.x) / (side.range.y - side.range.x);
    return side.channels == 1 ? v.rrr : side.channels == 2 ? vec3(v.rg, .5) : v;
  }
  if (side.kind == 1 && curve != 3) return v * exposure;
  if (side.srgb && exposure == 1. && curve == 0) return v;  // untouched
  v = (side.srgb ? decode(v) : max(v, 0.)) * exposure;
  if (curve == 3) return stops(v);
  if (curve == 1) v = neutral(v);
  if (curve == 2) v = aces(v);
  return encode(v);
}

// Red where a is brighter, blue where b is, grey where they are equal.
vec3 difference(vec3 one, vec3 other) {
  if (a.channels == 1) one = one.rrr;
  if (b.channels == 1) other = other.rrr;
  float d = dot(one - other, vec3(1. / 3.)) * exposure * 2.;
  vec3 base = vec3(.22);
  return mix(base, d > 0. ? vec3(1., .35, .22) : vec3(.25, .55, 1.), min(1., abs(d)));
}

void main() {
  vec2 canvas = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec2 at = (canvas - origin) / zoom;
  bool second = mode == 1 || (mode == 2 && canvas.x >= wipe);
  vec4 one = second ? look(pixelsB, b, at) : look(pixelsA, a, at);
  vec3 c;
  if (mode == 3) {
    vec4 other = look(pixelsB, b, at);
    c = difference(one.rgb, other.rgb);
    one.w = one.w < 0. || other.w < 0. ? -1. : min(one.w, other.w);
  } else if (second) c = shown(one.rgb, b);
  else c = shown(one.rgb, a);
  if (one.w < 0.) c = vec3(1., 0., 1.);  // not a number
  c = mix(surround, clamp(c, 0., 1.), abs(one.w));
  if (zoom >= 12. && one.w > 0.) {  // lines between pixels
    vec2 edge = fract(at) * zoom;
    if (edge.x < 1. || edge.y < 1.) c = mix(c, vec3(.5), .35);
  }
  colour = vec4(c, 1.);
}`;
