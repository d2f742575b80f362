StructuredBuffer<float> data_a : register(t0);
StructuredBuffer<float> data_b : register(t1);
StructuredBuffer<float> data_c : register(t2);
RWStructuredBuffer<float> made : register(u3);
cbuffer Numbers : register(b4) { int4 numbers[16]; };

float a(int i) { return data_a[i]; }
float b(int i) { return data_b[i]; }
float c(int i) { return data_c[i]; }
int p(int k) { return numbers[k / 4][k % 4]; }
float f(int k) { return asfloat(p(k)); }
float pick(float no, float yes, bool which) { return which ? yes : no; }
void put(int i, float found) {
  if (p(5) == 1) { found = clamp(found, f(6), f(7)); }
  made[p(3) + (i / p(1)) * p(2) + i % p(1)] = found;
}

KERNEL
[numthreads(64, 1, 1)]
void main(uint3 id : SV_DispatchThreadID) {
  run(int(id.x) + int(id.y) * p(4));
}
