@group(0) @binding(0) var<storage, read> data_a: array<f32>;
@group(0) @binding(1) var<storage, read> data_b: array<f32>;
@group(0) @binding(2) var<storage, read> data_c: array<f32>;
@group(0) @binding(3) var<storage, read_write> made: array<f32>;
@group(0) @binding(4) var<uniform> numbers: array<vec4<i32>, 16>;

fn a(i: i32) -> f32 { return data_a[i]; }
fn b(i: i32) -> f32 { return data_b[i]; }
fn c(i: i32) -> f32 { return data_c[i]; }
fn p(k: i32) -> i32 { return numbers[k / 4][k % 4]; }
fn f(k: i32) -> f32 { return bitcast<f32>(p(k)); }
fn put(i: i32, found: f32) {
  made[p(3) + (i / p(1)) * p(2) + i % p(1)] = select(found, clamp(found, f(6), f(7)), p(5) == 1);
}

KERNEL
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
  _ = data_a[0] + data_b[0] + data_c[0];  // every layout has all bindings
  run(i32(id.x) + i32(id.y) * p(4));
}
