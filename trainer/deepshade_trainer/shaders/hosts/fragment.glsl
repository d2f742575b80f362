#version 330
uniform sampler2DArray data_a;
uniform sampler2DArray data_b;
uniform sampler2DArray data_c;
layout(std140) uniform Numbers { ivec4 numbers[16]; };
flat in int layer;
out float made;

// A buffer is an array texture: rows of 512 numbers, layers of 512 rows.
ivec3 place(int i) { return ivec3(i & 511, (i >> 9) & 511, i >> 18); }
float a(int i) { return texelFetch(data_a, place(i), 0).r; }
float b(int i) { return texelFetch(data_b, place(i), 0).r; }
float c(int i) { return texelFetch(data_c, place(i), 0).r; }
int p(int k) { return numbers[k / 4][k % 4]; }
float f(int k) { return intBitsToFloat(p(k)); }
float pick(float no, float yes, bool which) { return which ? yes : no; }

KERNEL
void main() {
  int at = (layer << 18) + (int(gl_FragCoord.y) << 9) + int(gl_FragCoord.x) - p(3);
  if (at < 0) { discard; }
  int i = (at / p(2)) * p(1) + at % p(2);
  if (at % p(2) >= p(1) || i >= p(0)) { discard; }
  float found = value(i);
  if (p(5) == 1) { found = clamp(found, f(6), f(7)); }
  made = found;
}
