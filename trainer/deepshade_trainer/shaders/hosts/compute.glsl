#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer A { float data_a[]; };
layout(std430, binding = 1) readonly buffer B { float data_b[]; };
layout(std430, binding = 2) readonly buffer C { float data_c[]; };
layout(std430, binding = 3) writeonly buffer Made { float made[]; };
layout(std140, binding = 0) uniform Numbers { ivec4 numbers[16]; };

float a(int i) { return data_a[i]; }
float b(int i) { return data_b[i]; }
float c(int i) { return data_c[i]; }
int p(int k) { return numbers[k / 4][k % 4]; }
float f(int k) { return intBitsToFloat(p(k)); }
float pick(float no, float yes, bool which) { return which ? yes : no; }
void put(int i, float found) {
  if (p(5) == 1) { found = clamp(found, f(6), f(7)); }
  made[p(3) + (i / p(1)) * p(2) + i % p(1)] = found;
}

KERNEL
void main() {
  run(int(gl_GlobalInvocationID.x) + int(gl_GlobalInvocationID.y) * p(4));
}
