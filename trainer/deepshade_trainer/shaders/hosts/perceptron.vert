#version 330
// A triangle that covers the picture: draw three vertices, of no buffer.
void main() {
  gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1);
}
