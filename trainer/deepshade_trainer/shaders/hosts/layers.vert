#version 330
flat out int instance;

void main() {  // one triangle that covers the target, once for each layer
  instance = gl_InstanceID;
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
