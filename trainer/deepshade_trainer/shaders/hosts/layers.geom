#version 330
layout(triangles) in;
layout(triangle_strip, max_vertices = 3) out;
flat in int instance[];
flat out int layer;

void main() {
  for (int k = 0; k < 3; k += 1) {
    gl_Position = gl_in[k].gl_Position;
    gl_Layer = instance[0];
    layer = instance[0];
    EmitVertex();
  }
  EndPrimitive();
}
