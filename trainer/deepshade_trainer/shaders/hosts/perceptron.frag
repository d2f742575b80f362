#version 330
// Ambient occlusion of one mesh from normals around a pixel (Erra et al. 2017).
// The block holds, without gaps: WIDE rows of 48 weights (points from the right on,
// counter-clockwise as seen, x y z of each), WIDE biases, HIGH rows of WIDE weights, HIGH biases,
// HIGH weights, one bias. All but the last fill vec4s, so that std140 leaves no gap either.
layout(std140) uniform Perceptron {
  vec4 weights[COUNT];
  float bias;
};
uniform sampler2D normals;  // object space, 0 where there is no surface
uniform float reach;        // pixels: CIRCLE, or 0 for the pixel alone
uniform float down;         // 1 where row 0 is the top, -1 where it is the bottom
uniform ivec2 widths = ivec2(WIDE, HIGH);  // no constants: unrolled loops compile for minutes
out float openness;

vec3 normalAt(ivec2 at) {
  bool inside = all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, textureSize(normals, 0)));
  return inside ? texelFetch(normals, at, 0).xyz : vec3(0);
}

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  vec3 own = normalAt(here);
  vec4 seen[12];
  for (int k = 0; k < 4; k++) {
    vec3 n[4];
    for (int j = 0; j < 4; j++) {
      float turn = 6.28318530718 * float(4 * k + j) / 16.0;
      vec2 offset = reach * vec2(cos(turn), -down * sin(turn));
      n[j] = normalAt(here + ivec2(round(offset)));
    }
    seen[3 * k] = vec4(n[0], n[1].x);
    seen[3 * k + 1] = vec4(n[1].yz, n[2].xy);
    seen[3 * k + 2] = vec4(n[2].z, n[3]);
  }
  int at = 0;
  float first[WIDE];
  for (int j = 0; j < widths.x; j++) {
    first[j] = weights[12 * WIDE + j / 4][j % 4];
    for (int k = 0; k < 12; k++) { first[j] += dot(weights[at++], seen[k]); }
    first[j] = tanh(first[j]);
  }
  at += WIDE / 4;
  float answer = bias;
  int ends = at + WIDE / 4 * HIGH;
  for (int j = 0; j < widths.y; j++) {
    float second = weights[ends + j / 4][j % 4];
    for (int k = 0; k < widths.x; k += 4) {
      second += dot(weights[at++], vec4(first[k], first[k + 1], first[k + 2], first[k + 3]));
    }
    answer += weights[ends + (HIGH + j) / 4][j % 4] * tanh(second);
  }
  float covered = clamp(1e4 * dot(own, own), 0.0, 1.0);
  openness = clamp(mix(1.0, answer, covered), 0.0, 1.0);
}
